"""Log files of any known format → `Log` with canonical units."""
