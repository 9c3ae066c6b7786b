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

from typing import Final

# Defaults of the command line: its help pages import nothing that computes.
LOCAL: Final = "local"
"""Scheduler that is started on this machine."""
VEHICLE_PATTERN: Final = r"(?:vehicle=)?([^/]+)/[^/]+$"
"""Finds the vehicle in the name of a log: its folder."""
REFERENCES: Final = 30
"""References of a diagnosis; more gain little, and learning from a thousand takes 1.9 GB (see
docs/fleet.md)."""
LOGS: Final = 3
"""Latest logs of a vehicle that are diagnosed together."""
