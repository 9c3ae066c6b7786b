"""Frames ↔ samples and estimates: buses, captures, DBC mapping, protection, publishing."""
