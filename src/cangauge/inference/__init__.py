"""Inference shared by fit and diagnosis: rows of logs, error model, least squares, linearization.

The package imports nothing, so that `rows` loads without the solvers of `least_squares`.
"""
