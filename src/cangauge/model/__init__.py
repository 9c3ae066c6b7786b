"""The voltage model, its delay line and its file."""
