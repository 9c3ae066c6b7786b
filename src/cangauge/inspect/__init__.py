"""What logs hold: signals, rates, gaps, sign of current, what they can identify; pure."""
