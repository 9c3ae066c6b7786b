"""Fuzzing of all readers of external data: corpus, mutations, targets, supervision.

`benchmarks/fuzz.py` is the command; `tests/nightly/fuzz` runs a small part of it under hypothesis.
"""
