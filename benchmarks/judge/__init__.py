"""Second opinions on corrupted gauges: see `python -m judge --help`."""
