"""Samples → estimates.

`estimator` is the entry: it counts charge (`counting`) on every sample and updates a filter of SoC
hypotheses (`start`, `ekf`) with the voltage. `settings` are the user's choices, `state` holds what
survives a restart, and `offline` runs an estimator over a whole log. `compiled` runs the same step
in C, from the constants in `core_constants`.
"""
