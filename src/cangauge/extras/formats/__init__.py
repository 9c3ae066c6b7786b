"""Readers and writers of further formats."""
