"""Physical effects in recorded logs: nothing is put in, the cause is what the laboratory changed.

- `cold-bmw_i3`: winter trips of a car against the model of its summer trips. Each trip is left
  out in turn, the others are diagnosed; one more case has all of them.
- `cold-lg_hg2`: drive cycles of a cell at 0 and 10 °C against 25 °C.
- `hysteresis-a123_lfp`: a slow discharge and a slow charge of an LFP cell against drive cycles,
  which discharge: the model is as good on the discharge as on the drives and off on the charge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge.gapcheck.floors import identify, missed_v
from cangauge.gapcheck.recorded import (
    LG_CAPACITY_AH,
    folder_of,
    summer_held_out,
    summer_training,
)
from cangauge.identify.charge import capacity_from_reference
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.model_file import model_json
from cangauge.twin.case_files import CaseLogs
from cangauge.twin.inject import with_start

WINTER: Final = ("B03", "B05", "B06", "B16", "B17", "B18", "B19", "B20")
_LG_TRAINED: Final = (
    "25degC__551_LA92", "25degC__551_US06", "25degC__552_Mixed3", "25degC__552_Mixed5",
)  # fmt: skip
_LG_REFERENCES: Final = ("25degC__551_Mixed1", "25degC__551_Mixed2", "25degC__552_Mixed7")
_LG_COLD: Final = (
    ("0degC__589_LA92", "0degC__589_Mixed1", "0degC__589_US06", "0degC__590_Mixed5"),
    ("10degC__567_Mixed1", "10degC__567_US06", "10degC__571_Mixed5", "10degC__571_Mixed7"),
)
_A123_DRIVES: Final = ("DYN_45_P05_s1", "DYN_50_P25_s1", "DYN_50_P45_s1")
_A123_SLOW: Final = ("P05", "P25", "P45")
_A123_CAPACITY_AH: Final = 2.07
"""Charge of a discharge at C/30 and 25 °C of this cell [Ah]."""
_A123_SOC_PCT: Final = (10.0, 92.0)
"""The ends are left away: the knees of a 13-coefficient model of LFP are worse than hysteresis."""

CAUSES: Final[Mapping[str, tuple[str, int]]] = {
    "cold-bmw_i3": ("resistance_temperature", len(WINTER) + 1),
    "cold-lg_hg2": ("resistance_temperature", len(_LG_COLD)),
    "hysteresis-a123_lfp": ("hysteresis", len(_A123_SLOW)),
}
"""Protocol → the effect that is there, and how many cases."""


@dataclass(frozen=True, eq=False)
class PhysicalCase:
    """What the diagnosis sees, what it does not, and what is true."""

    shown: CaseLogs
    model: str
    floor_v: float
    """What the model misses on clean logs held out [V]."""
    judged_on: Mapping[str, Sequence[Log]]
    """Logs that judge the extended model: those left out, and clean ones."""


def physical_case(protocol: str, number: int, data: Path | None) -> PhysicalCase:
    """Return a case of a physical effect.

    Parameters
    ----------
    protocol : str
        One of `CAUSES`.
    number : int
        Which case, from 0.
    data : Path
        Folder of the recorded logs.

    Raises
    ------
    InputError
        If the logs are not there.
    """
    folder = folder_of(protocol.partition("-")[2], data)
    if protocol == "cold-bmw_i3":
        return _winter(folder, number)
    if protocol == "cold-lg_hg2":
        return _cold_cell(folder, number)
    return _hysteresis(folder, number)


def _winter(folder: Path, number: int) -> PhysicalCase:
    training = summer_training(folder)
    capacity = capacity_from_reference(training)
    known = identify(training, capacity)
    trips = [read_log(folder / f"Trip{name}.csv.gz") for name in WINTER]
    left_out = trips[number : number + 1]
    clean = summer_held_out(folder)
    return PhysicalCase(
        CaseLogs([], training, [trip for trip in trips if trip not in left_out], capacity),
        model_json(known.model),
        missed_v(known, clean),
        {"left_out": left_out} if left_out else {"clean": clean},
    )


def _cold_cell(folder: Path, number: int) -> PhysicalCase:
    def read(names: Sequence[str]) -> list[Log]:
        return [with_start(read_log(folder / f"{name}.parquet"), 100.0) for name in names]

    references = read(_LG_REFERENCES)
    known = identify(read(_LG_TRAINED), LG_CAPACITY_AH)
    return PhysicalCase(
        CaseLogs([], references, read(_LG_COLD[number]), LG_CAPACITY_AH),
        model_json(known.model),
        missed_v(known, references),
        {},
    )


def _hysteresis(folder: Path, number: int) -> PhysicalCase:
    def read(name: str) -> Log:
        return read_log(folder / f"A123_{name}.csv.gz")

    drives = [_middle(read(name), ends_full=False) for name in _A123_DRIVES]
    known = identify(drives, _A123_CAPACITY_AH)
    at = _A123_SLOW[number]
    discharge = _middle(read(f"OCV_{at}_S1"), ends_full=False)
    charge = _middle(read(f"OCV_{at}_S3"), ends_full=True)
    return PhysicalCase(
        CaseLogs([], drives, [discharge, charge], _A123_CAPACITY_AH),
        model_json(known.model),
        missed_v(known, [discharge]),
        {},
    )


def _middle(log: Log, *, ends_full: bool) -> Log:
    """Return the rows of a log that starts or ends full within the middle of the charge."""
    steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s) / 3600.0
    taken = 100.0 / _A123_CAPACITY_AH * np.concatenate(([0.0], np.cumsum(steps)))
    soc = 100.0 - taken + (taken[-1] if ends_full else 0.0)
    low, high = _A123_SOC_PCT
    inside = np.flatnonzero((soc >= low) & (soc <= high))
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    return with_start(log.rows(rows), float(soc[rows][0]))


def label_of(case: PhysicalCase, protocol: str, number: int) -> dict[str, Any]:
    """Return the truth of a case, as of a drawn one."""
    return {
        "plant": protocol.partition("-")[2],
        "seed": number,
        "effects": [CAUSES[protocol][0]],
        "faults": [],
        "floor_sensor_v": None,
        "gap_counted_in_v": case.floor_v,
        "logs": [{"name": log.name, "hours": log.duration_s / 3600.0} for log in case.shown.logs],
    }
