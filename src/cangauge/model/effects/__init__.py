"""Effects that the baseline model lacks: one file each, fit, offline and online side by side."""
