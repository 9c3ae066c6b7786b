"""Many logs: the function of a command for each, one row of a Parquet table each."""
