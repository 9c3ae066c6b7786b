"""Frames ↔ samples and estimates: DBC mapping, protection, captures, publishing."""
