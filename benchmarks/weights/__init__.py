"""Weights of the diagnosis: drawn cases, their evidence, maximum likelihood, scores."""
