"""Effects that extend the voltage model, one file per family; see `base` and `library`."""
