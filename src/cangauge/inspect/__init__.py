"""Contents of logs and captures: signals, rates, gaps, sign of current, identifiability."""
