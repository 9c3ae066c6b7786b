"""Inference shared by fit and diagnosis: rows of logs, error model, least squares, linearization.

Import from its modules; the package itself imports nothing, since `rows` is needed without the
solvers of `least_squares`.
"""
