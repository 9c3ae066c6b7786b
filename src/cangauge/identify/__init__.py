"""Log → model: preprocessing, charge, least squares, energy."""
