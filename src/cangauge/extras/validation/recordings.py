"""Recorded logs of the withheld check, and the models of healthy logs.

Healthy logs to inject faults into, split into those that identify the model, references and
held-out ones; and laboratory cases, where the cause is what the laboratory changed:

- `cold-bmw_i3`: winter trips of a car against the model of its summer trips. Each trip is left out
  in turn; one more case has all of them.
- `cold-lg_hg2`: drive cycles of a cell at 0 and 10 °C against 25 °C.
- `hysteresis-a123_lfp`: slow discharge and charge of an LFP cell against drive cycles. The cycles
  discharge the cell, so the model fits the slow discharge but not the slow charge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from cangauge.errors import InputError
from cangauge.extras.validation.twin.injection import (
    fit_surrogate_pack,
    scaled_to_pack,
    with_initial_soc,
)
from cangauge.extras.validation.twin.pack import Pack
from cangauge.extras.validation.twin.recording import rms
from cangauge.identify.fit import Identification, fit
from cangauge.identify.rows import fit_rows
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.coulomb_counting import capacity_from_reference
from cangauge.model.model_file import Model

_MIN_DURATION_S: Final = 600.0
_I3_REFERENCES: Final = 8
_I3_CELLS: Final = 96
_I3_TRAINING: Final = tuple(f"TripA{number:02d}.csv.gz" for number in range(1, 22, 2))
_I3_HELD_OUT: Final = tuple(f"TripA{number:02d}.csv.gz" for number in range(2, 23, 2))

LG_25C: Final = (
    "25degC__551_LA92", "25degC__551_Mixed1", "25degC__551_Mixed2", "25degC__551_US06",
    "25degC__552_Mixed3", "25degC__552_Mixed5", "25degC__552_Mixed7", "25degC__552_Mixed8",
)  # fmt: skip
LG_SERIES, LG_PARALLEL = 96, 17
LG_CAPACITY_AH: Final = 2.78
"""Capacity of a cell in these files, by a full discharge at 25 °C [Ah]."""

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
"""Capacity of the cell at C/30 and 25 °C [Ah]."""
_A123_SOC_PCT: Final = (10.0, 92.0)
"""Without the ends: the error of a 13-coefficient model at the knees of LFP exceeds hysteresis."""

LABORATORY_CAUSES: Final[Mapping[str, tuple[str, int]]] = {
    "cold-bmw_i3": ("resistance_temperature", len(WINTER) + 1),
    "cold-lg_hg2": ("resistance_temperature", len(_LG_COLD)),
    "hysteresis-a123_lfp": ("hysteresis", len(_A123_SLOW)),
}
"""Protocol → effect and number of cases."""


@dataclass(frozen=True, eq=False)
class RecordedSet:
    """Recorded logs of one healthy pack, each at least with its initial SoC.

    Parameters
    ----------
    name : str
    training, references, held_out : sequence of Log
        Logs that identify the model, references of the diagnosis, logs to inject faults into.
    capacity_ah : float
    cells : int
        Cells in series.
    """

    name: str
    training: Sequence[Log]
    references: Sequence[Log]
    held_out: Sequence[Log]
    capacity_ah: float
    cells: int

    def fit_surrogate_pack(self) -> Pack:
        """Fit the pack that faults are injected into, to all logs."""
        return fit_surrogate_pack(
            [*self.training, *self.references, *self.held_out],
            capacity_ah=self.capacity_ah,
            cells=self.cells,
            name=self.name,
        )


def recorded_set(name: str, data: Path | None, seed: int) -> RecordedSet:
    """Read recorded logs of a healthy pack and split them, at random where there is a choice.

    Parameters
    ----------
    name : {"bmw_i3", "lg_hg2"}
        Summer trips of a car (IEEE DataPort), or drive cycles of a cell at 25 °C scaled to a pack
        of 96 × 17 cells (Kollmeyer, McMaster).
    data : Path
        Folder that contains a folder of this name.
    seed : int

    Raises
    ------
    InputError
        If the folder or a file does not exist.
    """
    folder = folder_of(name, data)
    rng = np.random.default_rng([seed, 7])
    if name == "bmw_i3":
        training = summer_training(folder)
        long = [log for log in training if log.duration_s > _MIN_DURATION_S]
        chosen = np.sort(rng.permutation(len(long))[:_I3_REFERENCES])
        return RecordedSet(
            name,
            training,
            [long[k] for k in chosen],
            summer_held_out(folder),
            capacity_from_reference(training),
            _I3_CELLS,
        )
    logs = [_as_pack(folder / f"{item}.parquet") for item in LG_25C]
    order = rng.permutation(len(logs))
    one, three, four = order[:1], order[1:4], order[4:]
    return RecordedSet(
        name,
        [logs[k] for k in one],
        [logs[k] for k in three],
        [logs[k] for k in four],
        LG_CAPACITY_AH * LG_PARALLEL,
        LG_SERIES,
    )


def is_folder(path: Path) -> bool:
    """Whether there is such a folder; a name too long for the file system names none."""
    try:
        return path.is_dir()
    except OSError:
        return False


def folder_of(name: str, data: Path | None) -> Path:
    """Return the folder of one set of recorded logs; raise InputError if it does not exist."""
    if data is None or not is_folder(data / name):
        raise InputError(
            f"no folder {name} of recorded logs",
            field="--data",
            value=str(data or ""),
            cure="name the folder that contains it (the README lists the sources)",
        )
    return data / name


@cache
def _read(path: Path) -> Log:
    return read_log(path)


def summer_training(folder: Path) -> list[Log]:
    """Return the summer trips of the car that identify its model."""
    return [_read(folder / name) for name in _I3_TRAINING]


def summer_held_out(folder: Path) -> list[Log]:
    """Return the other summer trips of more than ten minutes."""
    trips = [_read(folder / name) for name in _I3_HELD_OUT]
    return [trip for trip in trips if trip.duration_s > _MIN_DURATION_S]


@cache
def _as_pack(path: Path) -> Log:
    log = scaled_to_pack(read_log(path), series=LG_SERIES, parallel=LG_PARALLEL)
    return with_initial_soc(log, 100.0)


@dataclass(frozen=True, eq=False)
class LaboratoryCase:
    """A laboratory case.

    Parameters
    ----------
    references, logs : sequence of Log
    capacity_ah : float
    model : Model
    floor_v : float
        RMS error of the model on healthy logs held out [V].
    held_out : mapping of str to sequence of Log
        Logs to evaluate the extended model on: with the effect ("left_out") or without ("clean").
    """

    references: Sequence[Log]
    logs: Sequence[Log]
    capacity_ah: float
    model: Model
    floor_v: float
    held_out: Mapping[str, Sequence[Log]] = field(default_factory=dict)


def laboratory_case(protocol: str, number: int, data: Path | None) -> LaboratoryCase:
    """Return a laboratory case.

    Parameters
    ----------
    protocol : str
        One of `LABORATORY_CAUSES`.
    number : int
        Number of the case, from 0.
    data : Path
        Folder of the recorded logs.

    Raises
    ------
    InputError
        If the logs do not exist.
    """
    folder = folder_of(protocol.partition("-")[2], data)
    if protocol == "cold-bmw_i3":
        return _winter(folder, number)
    if protocol == "cold-lg_hg2":
        return _cold_cell(folder, number)
    return _hysteresis(folder, number)


def _winter(folder: Path, number: int) -> LaboratoryCase:
    training = summer_training(folder)
    capacity = capacity_from_reference(training)
    known = fit(training, capacity_ah=capacity)
    trips = [read_log(folder / f"Trip{name}.csv.gz") for name in WINTER]
    left_out = trips[number : number + 1]
    clean = summer_held_out(folder)
    return LaboratoryCase(
        training,
        [trip for trip in trips if trip not in left_out],
        capacity,
        known.model,
        model_rmse_v(known, clean),
        {"left_out": left_out} if left_out else {"clean": clean},
    )


def _cold_cell(folder: Path, number: int) -> LaboratoryCase:
    def read(names: Sequence[str]) -> list[Log]:
        return [with_initial_soc(read_log(folder / f"{name}.parquet"), 100.0) for name in names]

    references = read(_LG_REFERENCES)
    known = fit(read(_LG_TRAINED), capacity_ah=LG_CAPACITY_AH)
    return LaboratoryCase(
        references,
        read(_LG_COLD[number]),
        LG_CAPACITY_AH,
        known.model,
        model_rmse_v(known, references),
    )


def _hysteresis(folder: Path, number: int) -> LaboratoryCase:
    def read(name: str) -> Log:
        return read_log(folder / f"A123_{name}.csv.gz")

    drives = [_middle(read(name), ends_full=False) for name in _A123_DRIVES]
    known = fit(drives, capacity_ah=_A123_CAPACITY_AH)
    at = _A123_SLOW[number]
    discharge = _middle(read(f"OCV_{at}_S1"), ends_full=False)
    charge = _middle(read(f"OCV_{at}_S3"), ends_full=True)
    return LaboratoryCase(
        drives,
        [discharge, charge],
        _A123_CAPACITY_AH,
        known.model,
        model_rmse_v(known, [discharge]),
    )


def _middle(log: Log, *, ends_full: bool) -> Log:
    """Return the rows in the middle of the SoC, of a log that starts or ends full."""
    steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s) / 3600.0
    taken = 100.0 / _A123_CAPACITY_AH * np.concatenate(([0.0], np.cumsum(steps)))
    soc = 100.0 - taken + (taken[-1] if ends_full else 0.0)
    low, high = _A123_SOC_PCT
    inside = np.flatnonzero((soc >= low) & (soc <= high))
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    return with_initial_soc(log.rows(rows), float(soc[rows][0]))


def model_rmse_v(known: Identification, logs: Sequence[Log]) -> float:
    """Return the RMS error of a model on healthy logs that it was not fitted to [V].

    The SoC is counted from the initial SoC of each log.
    """
    errors = []
    for log in logs:
        rows = fit_rows(log, known.model.capacity_ah)
        errors.append(known.model.predict(log).residual_v[rows.at])
    return rms(np.concatenate(errors))
