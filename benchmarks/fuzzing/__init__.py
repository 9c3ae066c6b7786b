"""Fuzzing of everything that reads what others wrote: corpus, mutations, targets, supervision.

`benchmarks/fuzz.py` is the command; `tests/fuzz` runs a small part of it under hypothesis.
"""
