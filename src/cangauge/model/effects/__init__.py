"""Effects that extend the voltage model: two tables of `Effect`s; see `base` and `library`."""
