"""Numerical engines shared by fit and diagnosis."""
