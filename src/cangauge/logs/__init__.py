"""Files → canonical log: one reader a file."""
