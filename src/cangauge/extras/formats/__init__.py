"""Logs and captures beyond the canonical log, plain tables and python-can's formats.

The core loads them by name: readers of captures join by entry points.
"""
