"""Results → one HTML page with pictures."""
