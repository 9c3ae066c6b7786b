"""Fits, estimates, diagnoses and health of the logs of a fleet, on Dask.

==========  ======================================================================================
sources     glob or manifest → logs with their vehicle; a log of any storage → `Log`
dataset     one row per log as a Parquet data set by vehicle; which logs are done; logs set aside
jobs        what is computed of a log: estimate, gap, health
fit         information of each log → the model of all logs, in two passes
run         a job over all logs on a Dask scheduler: resumed, and robust against lost workers
==========  ======================================================================================

Dask and fsspec are the extra `fleet`. The user's view is in docs/fleet.md.
"""
