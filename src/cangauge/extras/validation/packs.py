"""Recorded packs: logs that train models of a pack, and logs that judge them.

Constants of the filter may be chosen on packs of the role "development" only. A log that a pack of
the role "judged" is scored on is in no development pack. But its models are trained on development
logs too, and `leaf_module` and `a123_lfp` alone are packs of which development knows no log at all.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, Literal

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.validation.recordings import (
    LG_CAPACITY_AH,
    LG_PARALLEL,
    LG_SERIES,
    WINTER,
    folder_of,
    is_folder,
)
from cangauge.extras.validation.twin.injection import scaled_to_pack
from cangauge.identify.rows import decimate
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.coulomb_counting import counted_soc_pct

Role = Literal["development", "judged"]
Chemistry = Literal["nmc", "lfp"]
"""Layered oxides and spinels (NMC, NCA, LMO blends), whose voltage falls all along; or LFP."""

SIZES: Final = (1, 2, 3, 5, 10)
"""Numbers of training logs of the learning curve."""
MIN_MINUTES: Final = 14.5
"""Shorter logs train, but are not judged: a wrong start has ten minutes to be found out [min]."""
RATE_HZ: Final = 1.0
"""Rate of the judged logs [Hz]: the models', at which a filter uses the voltage. Every row in
between is left out, as on a slow bus; the reference is counted before."""
PIECE_S: Final = 1800.0
"""Length of the pieces that recordings of hours are cut into [s], as a usual trip."""
_MODULE_SERIES: Final = 16
_MODULE_CAPACITY_AH: Final = 55.1
"""Mean of the four full discharges at 0.3 to 2.75 C, 54.9 to 55.4 Ah."""
_MODULE_CELLS: Final = range(20, 26)
_A123_CAPACITY_AH: Final = 2.07
"""Discharge at C/30 and 25 °C [Ah]."""
_A123_PARALLEL: Final = 20


@dataclass(frozen=True, eq=False)
class BenchPack:
    """Logs of a pack that train models, and logs that judge them.

    Parameters
    ----------
    name : str
    role : {"development", "judged"}
        Whether constants may be chosen on it.
    chemistry : {"nmc", "lfp"}
    training : sequence of Log
        Drawn from for the models; each with its reference SoC.
    judged : sequence of Log
        Each with a reference SoC; those in a model's training are left out.
    reference : str
        What the reference SoC is, and its own error.
    capacity_ah : float, optional
        Known capacity [Ah]; by default the training logs' charge per 100 % of their reference.
    sizes : sequence of int
        Numbers of training logs.
    cells_v : mapping of str to array of shape (n, cells)
        Judged log → voltages of cells at its n rows [V], where they are known.
    place : str
        Packs of another place are other packs.
    """

    name: str
    role: Role
    chemistry: Chemistry
    training: Sequence[Log]
    judged: Sequence[Log]
    reference: str
    capacity_ah: float | None = None
    sizes: Sequence[int] = SIZES
    cells_v: Mapping[str, FloatArray] = field(default_factory=dict)
    place: str = ""

    def splits(self, size: int, number: int, seed: int) -> Iterator[tuple[list[Log], list[Log]]]:
        """Yield training and judged logs of at most `number` different draws."""
        seen = set()
        for split in range(number):
            rng = np.random.default_rng([seed, zlib.crc32(self.name.encode()), size, split])
            chosen = frozenset(rng.permutation(len(self.training))[:size].tolist())
            training = [self.training[k] for k in sorted(chosen)]
            names = {log.name for log in training}
            judged = [log for log in self.judged if log.name not in names]
            if chosen not in seen and len(training) == size and judged:
                seen.add(chosen)
                yield training, judged


def load(folder: Path, names: Sequence[str] | None = None) -> list[BenchPack]:
    """Read the recorded packs of a folder.

    Parameters
    ----------
    folder : Path
        Contains `bmw_i3`, `batic_car1`, `lg_hg2`, `leaf_module_ornl` and `a123_lfp`, or some of
        them (the README lists the sources).
    names : sequence of str, optional
        Packs to read; by default all whose folder is there.

    Raises
    ------
    InputError
        If the folder is absent, a name is unknown, or a named pack or every pack is absent.
    """
    if not is_folder(folder):
        raise InputError(
            "the folder does not exist", field="--data", value=str(folder),
            cure="name the folder of the recorded logs",
        )  # fmt: skip
    for name in names or ():
        if name not in PACKS:
            raise InputError(
                "unknown pack", field="--pack", value=name, cure=f"use {', '.join(PACKS)}"
            )
    packs = []
    for name, (place, read) in PACKS.items():
        if names is None and not is_folder(folder / place):
            continue
        if names is None or name in names:
            found = read(folder_of(place, folder))
            packs.append(replace(found, name=name, place=place))
    if not packs:
        raise InputError(
            "no recorded packs in this folder",
            field="--data",
            value=str(folder),
            cure=f"name the folder that contains {', '.join(dict(PACKS.values()))}",
        )
    return packs


def _i3(folder: Path, judged: Sequence[str], role: Role) -> BenchPack:
    odd = [_read(folder / f"TripA{number:02d}.csv.gz") for number in range(1, 22, 2)]
    return BenchPack(
        "i3",
        role,
        "nmc",
        odd,
        _judgeable([_read(folder / f"Trip{name}.csv.gz") for name in judged]),
        "the car's own SoC in steps of 0.1 %, itself counted; its offset is unknown",
    )


def _car1(folder: Path, role: Role) -> BenchPack:
    pieces = [
        piece for path in sorted(folder.glob("car1_*.csv.gz")) for piece in _pieces(_read(path))
    ]
    training = pieces[::2] if role == "development" else pieces
    return BenchPack(
        "car1",
        role,
        "nmc",
        training,
        _judgeable(pieces[::2] if role == "development" else pieces[1::2]),
        "the car's own SoC in steps of 0.1 %, itself counted; its offset is unknown",
    )


def _lg(folder: Path, trained: str, judged: str, role: Role, sizes: Sequence[int]) -> BenchPack:
    def packs(patterns: str) -> list[Log]:
        paths = sorted({path for each in patterns.split() for path in folder.glob(each)})
        drives = [path for path in paths if "_Cap_" not in path.name]
        return [
            as_pack(_read(path), LG_SERIES, LG_PARALLEL, LG_CAPACITY_AH, 100.0) for path in drives
        ]

    return BenchPack(
        "lg_hg2",
        role,
        "nmc",
        packs(trained),
        _judgeable(packs(judged)),
        "counted from full with 2.78 Ah a cell (25 °C; 2.69 to 2.72 Ah at 1 C): its error grows"
        " from 0 % when full to 3 % when empty",
        LG_CAPACITY_AH * LG_PARALLEL,
        sizes,
    )


def _leaf_module(folder: Path) -> BenchPack:
    logs = [
        as_pack(_read(path), _MODULE_SERIES, 1, _MODULE_CAPACITY_AH, 100.0)
        for path in sorted(folder.glob("module123-*.csv.gz"))
    ]
    judged = _judgeable(logs)
    return BenchPack(
        "leaf_module",
        "judged",
        "nmc",
        logs,
        judged,
        "counted from full to the cut-off of the weakest cell with 55.1 Ah (54.9 to 55.4): 0.5 %",
        _MODULE_CAPACITY_AH,
        (1, 2, 3),
        {log.name: module_cells(folder / f"{log.name}.csv.gz", log.time_s) for log in judged},
    )


def module_cells(path: Path, time_s: FloatArray) -> FloatArray:
    """Read the six cell voltages of a module's file at given times, shape (n, 6) [V].

    The file's heading is shorter than its rows; rows without numbers are headings.
    """
    rows = []
    with gzip.open(path, "rt", encoding="latin-1") as file:
        for line in file:
            cells = line.split(",")
            try:
                rows.append([float(cells[at]) for at in (0, *_MODULE_CELLS)])
            except (ValueError, IndexError):
                continue
    table = np.array(sorted(rows))
    return np.column_stack([np.interp(time_s, table[:, 0], each) for each in table.T[1:]])


def _a123(folder: Path) -> BenchPack:
    logs = [
        as_pack(_read(path), LG_SERIES, _A123_PARALLEL, _A123_CAPACITY_AH, start_pct)
        for script, start_pct in (("s1", 100.0), ("s3", 0.0))
        for path in sorted(folder.glob(f"A123_DYN_*_{script}.csv.gz"))
    ]
    return BenchPack(
        "a123_lfp",
        "judged",
        "lfp",
        logs,
        _judgeable(logs),
        "counted from full (drives) or empty (charges) with 2.07 Ah a cell; whole charges take 2.06"
        " to 2.07 Ah: 0.5 %",
        _A123_CAPACITY_AH * _A123_PARALLEL,
        (1, 2, 3, 5),
    )


_EVEN: Final = tuple(f"A{number:02d}" for number in range(2, 23, 2))
_ODD: Final = tuple(f"A{number:02d}" for number in range(1, 22, 2))
_LG_COLD: Final = "0degC__5*_US06* 0degC__5*_Mixed* 10degC__5*_US06* 10degC__5*_Mixed*"
_LG_COLD_JUDGED: Final = "0degC__590_Mixed5* 0degC__589_US06* 10degC__571_Mixed7* 10degC__567_US*"

PACKS: Final[dict[str, tuple[str, Callable[[Path], BenchPack]]]] = {
    "i3_dev": ("bmw_i3", lambda folder: _i3(folder, _ODD, "development")),
    "car1_dev": ("batic_car1", lambda folder: _car1(folder, "development")),
    "lg_hg2_dev": (
        "lg_hg2",
        lambda folder: _lg(folder, "25degC__551_*", "25degC__551_*", "development", (1, 2, 3)),
    ),
    "i3": ("bmw_i3", lambda folder: _i3(folder, _EVEN, "judged")),
    "i3_winter": ("bmw_i3", lambda folder: _i3(folder, WINTER, "judged")),
    "car1": ("batic_car1", lambda folder: _car1(folder, "judged")),
    "lg_hg2": (
        "lg_hg2",
        lambda folder: _lg(folder, "25degC__*", "25degC__552_*", "judged", (1, 2, 3, 5)),
    ),
    "lg_hg2_cold": (
        "lg_hg2",
        lambda folder: _lg(folder, _LG_COLD, _LG_COLD_JUDGED, "judged", SIZES),
    ),
    "lg_hg2_from_25c": (
        "lg_hg2",
        lambda folder: _lg(folder, "25degC__551_*", _LG_COLD_JUDGED, "judged", (3,)),
    ),
    "leaf_module": ("leaf_module_ornl", _leaf_module),
    "a123_lfp": ("a123_lfp", _a123),
}
"""Pack → folder and reader. `_dev`: the part that constants may be chosen on. `i3_winter` and
`lg_hg2_from_25c` are judged at temperatures that their models have not seen."""

DEVELOPMENT: Final = ("i3_dev", "car1_dev", "lg_hg2_dev")


def as_pack(log: Log, series: int, parallel: int, cell_capacity_ah: float, start_pct: float) -> Log:
    """Return the log of a cell as that of a pack of equal cells, with its SoC counted.

    Voltage × `series`, current × `parallel`; all cells are equal, the wiring has no resistance.

    Parameters
    ----------
    log : Log
        Of one cell (or module).
    series, parallel : int
        Cells (or modules) in series and in parallel.
    cell_capacity_ah : float
        Known capacity of the cell [Ah], positive.
    start_pct : float
        Known SoC at the first row [%].
    """
    soc_pct = counted_soc_pct(log, cell_capacity_ah, start_pct)
    return replace(scaled_to_pack(log, series=series, parallel=parallel), soc_pct=soc_pct)


def _read(path: Path) -> Log:
    return read_log(path)


def _pieces(log: Log) -> list[Log]:
    """Return a recording in pieces of about `PIECE_S`."""
    number = max(1, round(log.duration_s / PIECE_S))
    edges = np.linspace(log.time_s[0], log.time_s[-1], number + 1)[1:-1]
    bounds = [0, *np.searchsorted(log.time_s, edges).tolist(), len(log)]
    return [
        replace(log.rows(slice(low, high)), name=f"{log.name}_{part}")
        for part, (low, high) in enumerate(pairwise(bounds), start=1)
    ]


def _judgeable(logs: Sequence[Log]) -> list[Log]:
    """Return the logs that are long enough, at `RATE_HZ`."""
    long = [log for log in logs if log.duration_s >= 60.0 * MIN_MINUTES]
    return [log.rows(decimate(log.time_s, RATE_HZ)) for log in long]
