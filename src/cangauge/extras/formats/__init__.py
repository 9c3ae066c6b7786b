"""Readers of logs beyond the canonical log and plain tables; the core loads them by name."""
