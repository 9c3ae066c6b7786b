"""Recorded logs that faults are put into: which identify, which are references, which held out."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from cangauge.errors import InputError
from cangauge.identify.charge import capacity_from_reference
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.twin.inject import scaled_to_pack, with_start
from cangauge.twin.real_case import RecordedSet

_AT_LEAST_S: Final = 600.0
_REFERENCES: Final = 8
_I3_CELLS: Final = 96
_I3_TRAINING: Final = tuple(f"TripA{number:02d}.csv.gz" for number in range(1, 22, 2))
_I3_HELD_OUT: Final = tuple(f"TripA{number:02d}.csv.gz" for number in range(2, 23, 2))

LG_25C: Final = (
    "25degC__551_LA92", "25degC__551_Mixed1", "25degC__551_Mixed2", "25degC__551_US06",
    "25degC__552_Mixed3", "25degC__552_Mixed5", "25degC__552_Mixed7", "25degC__552_Mixed8",
)  # fmt: skip
LG_SERIES, LG_PARALLEL = 96, 17
LG_CAPACITY_AH: Final = 2.78
"""Charge of a full discharge at 25 °C of one cell in these files [Ah]."""


def recorded_set(name: str, data: Path | None, seed: int) -> RecordedSet:
    """Return recorded logs of a healthy pack, parted at random as far as there is a choice.

    Parameters
    ----------
    name : {"bmw_i3", "lg_hg2"}
        Summer trips of a car (IEEE DataPort), or drive cycles of a cell at 25 °C as those of a
        pack of 96 × 17 cells (Kollmeyer, McMaster).
    data : Path
        Folder that holds a folder of this name.
    seed : int

    Raises
    ------
    InputError
        If the folder or a file is not there.
    """
    folder = folder_of(name, data)
    rng = np.random.default_rng([seed, 7])
    if name == "bmw_i3":
        training = summer_training(folder)
        long = [log for log in training if log.duration_s > _AT_LEAST_S]
        chosen = np.sort(rng.permutation(len(long))[:_REFERENCES])
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


def folder_of(name: str, data: Path | None) -> Path:
    """Return the folder of one set of recorded logs.

    Raises
    ------
    InputError
        If it is not there.
    """
    if data is None or not (data / name).is_dir():
        raise InputError(
            f"no folder {name} of recorded logs",
            field="--data",
            value=str(data or ""),
            cure="name the folder that holds it (the README says where the logs are from)",
        )
    return data / name


@cache
def _read(path: Path) -> Log:
    return read_log(path)


def summer_training(folder: Path) -> list[Log]:
    """Return the summer trips of the car that its model is identified on."""
    return [_read(folder / name) for name in _I3_TRAINING]


def summer_held_out(folder: Path) -> list[Log]:
    """Return the other summer trips, as far as they are long enough to show anything."""
    trips = [_read(folder / name) for name in _I3_HELD_OUT]
    return [trip for trip in trips if trip.duration_s > _AT_LEAST_S]


@cache
def _as_pack(path: Path) -> Log:
    log = scaled_to_pack(read_log(path), series=LG_SERIES, parallel=LG_PARALLEL)
    return with_start(log, 100.0)
