"""Capture formats beyond those of python-can; they join by entry points."""
