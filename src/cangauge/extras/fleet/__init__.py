"""Fits, estimates, diagnoses and health of the logs of a fleet, on Dask.

=========  =======================================================================================
sources    glob or manifest → logs with their vehicle; a log of any storage → `Log`
jobs, gap  what is computed of a log or vehicle: estimate, health, gap
fit        sums of each log → the model of all logs
results    rows in Parquet by vehicle; which tasks are done; logs set aside
run        a job over all tasks on a Dask scheduler: resumed, and robust against lost workers
overview   what the results say of each vehicle
=========  =======================================================================================

Dask and fsspec are the extra `fleet`. The user's view is in docs/fleet.md.
"""
