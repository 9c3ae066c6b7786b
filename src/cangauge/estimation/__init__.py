"""Samples → estimates.

`estimator` is the entry: it counts charge (`counting`) on every sample and updates a filter of SoC
hypotheses (`start`, `ekf`) with the voltage. `settings` are the user's choices,
`validity` which samples count, `state` what survives a restart, and `offline`
runs an estimator over a whole log.
"""
