"""Diagnosis of the gap between a model and a log: where, which effect, how far it shrinks."""
