"""Packs whose logs take faults: recorded and simulated, in two parts that share no log.

`diagnosis/weights.json` is fitted to the part "weights". The part "frozen" is scored once
(`frozen.json`). Both hold logs of the same real packs, except `a123` and `leaf`, which are in
"weights" alone; the held-out scores of the fit leave a whole data set out instead.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from cangauge.bus.recording import read_log
from cangauge.logs.log import Log

PARTS = ("weights", "frozen")
LG_SERIES, LG_PARALLEL, LG_AH = 96, 17, 2.78
"""96 × 17 cells; capacity of a cell by full discharges at 25 °C [Ah]."""
A123_AH, A123_PARALLEL = 2.07, 20
"""Capacity of a cell at C/30 and 25 °C [Ah]; 20 in parallel."""
MODULE_AH, MODULES = 55.1, 16
"""Mean of the four full discharges [Ah]; 16 modules of 3 cells in series as a pack of 48."""
I3_AH = 61.75
"""Median charge per 100 % of the car's own SoC, trips A and B [Ah] (data/README.md)."""
SHORTEST_S = 600.0
PIECE_S = 1800.0
"""Length of the pieces that recordings of hours are cut into [s]."""

ODD_A = tuple(f"TripA{k:02d}" for k in range(1, 23, 2))
EVEN_A = tuple(f"TripA{k:02d}" for k in range(2, 23, 2))
ODD_B = ("TripB03", "TripB05", "TripB17", "TripB19")
EVEN_B = ("TripB06", "TripB16", "TripB18", "TripB20")
LG = {
    "weights": {
        "lg_25": "25degC__551_LA92 25degC__551_Mixed1 25degC__551_Mixed2 25degC__551_US06",
        "lg_cold": "0degC__589_Mixed1 0degC__589_Mixed2 0degC__590_Mixed5 10degC__567_Mixed1"
        " 10degC__567_US06 10degC__571_Mixed5",
    },
    "frozen": {
        "lg_25": "25degC__552_Mixed3 25degC__552_Mixed5 25degC__552_Mixed7 25degC__552_Mixed8",
        "lg_cold": "0degC__589_LA92 0degC__589_US06 0degC__590_Mixed7 0degC__590_Mixed8"
        " 10degC__567_Mixed2 10degC__571_Mixed7 10degC__571_Mixed8",
        "lg_40": "40degC__556_LA92 40degC__556_Mixed1 40degC__556_Mixed2 40degC__556_US06"
        " 40degC__557_Mixed3",
    },
}
SIMULATED = {"weights": range(100, 103), "frozen": range(200, 203)}
"""Seeds of the twin's packs."""


@dataclass(frozen=True)
class PackLogs:
    """Healthy logs of one pack.

    Parameters
    ----------
    name : str
        Of the data set; all simulated packs are one.
    world : {"trips", "cells", "simulated"}
    logs : list of Log
        Each with its start in `soc_pct`.
    capacity_ah : float
    cells : int
        In series.
    references : tuple of int
        Fewest and most references of a case.
    """

    name: str
    world: str
    logs: list[Log]
    capacity_ah: float
    cells: int
    references: tuple[int, int]


def thinned(log: Log, step_s: float) -> Log:
    """Return means over steps of time, so that a log of 10 Hz takes a fault quickly."""
    at = np.floor((log.time_s - log.time_s[0]) / step_s).astype(int)
    _, first, number = np.unique(at, return_index=True, return_counts=True)
    mean = [
        np.add.reduceat(x, first) / number
        for x in (log.current_a, log.voltage_v, log.temperature_c)
    ]
    soc = None if log.soc_pct is None else log.soc_pct[first]
    time_s = (at[first] + 0.5) * step_s
    return Log(time_s, *mean, soc, name=log.name, source=log.source)


def started(log: Log, start_pct: float) -> Log:
    """Return the log with an assumed SoC at its first row alone."""
    soc = np.full(len(log.time_s), np.nan)
    soc[0] = start_pct
    return replace(log, soc_pct=soc)


def as_pack(log: Log, series: int, parallel: int, start_pct: float) -> Log:
    """Return the log of a cell as that of a pack of equal cells."""
    scaled = replace(log, current_a=parallel * log.current_a, voltage_v=series * log.voltage_v)
    return started(scaled, start_pct)


def first_finite(log: Log) -> Log:
    """Return the rows from the first SoC on."""
    k = int(np.flatnonzero(np.isfinite(log.soc_pct))[0])
    return log.rows(slice(k, None))


def pieces(log: Log) -> list[Log]:
    """Return a recording in pieces of about half an hour."""
    count = max(1, round(log.duration_s / PIECE_S))
    edges = np.linspace(log.time_s[0], log.time_s[-1], count + 1)[1:-1]
    bounds = [0, *np.searchsorted(log.time_s, edges).tolist(), len(log.time_s)]
    return [
        replace(log.rows(slice(a, b)), name=f"{log.name}_{k}")
        for k, (a, b) in enumerate(pairwise(bounds))
    ]


def _i3(data: Path, names: Sequence[str], name: str, references: tuple[int, int]) -> PackLogs:
    trips = [thinned(read_log(data / "bmw_i3" / f"{x}.csv.gz"), 0.5) for x in names]
    logs = [first_finite(x) for x in trips if x.duration_s >= SHORTEST_S]
    return PackLogs(name, "trips", logs, I3_AH, 96, references)


def _lg(data: Path, part: str, name: str) -> PackLogs:
    logs = [
        as_pack(
            thinned(read_log(data / "lg_hg2" / f"{x}.parquet"), 0.5), LG_SERIES, LG_PARALLEL, 100.0
        )
        for x in LG[part][name].split()
    ]
    return PackLogs(name, "cells", logs, LG_AH * LG_PARALLEL, LG_SERIES, (3, 20))


def _car1(data: Path, stretches: Sequence[str]) -> PackLogs:
    every = [read_log(data / "batic_car1" / f"car1_{x}.csv.gz") for x in stretches]
    logs = [first_finite(x) for log in every for x in pieces(log)]
    return PackLogs("car1", "trips", logs, 110.0, 96, (3, 20))


def _a123(data: Path) -> PackLogs:
    logs = []
    for at in ("45_P05", "50_P25", "50_P45"):
        log = as_pack(
            read_log(data / "a123_lfp" / f"A123_DYN_{at}_s1.csv.gz"),
            LG_SERIES,
            A123_PARALLEL,
            100.0,
        )
        soc = 100 - np.cumsum(np.diff(log.time_s, prepend=log.time_s[0]) * log.current_a) / 36 / (
            A123_AH * A123_PARALLEL
        )
        edges = [0, len(soc) // 3, 2 * len(soc) // 3, len(soc)]
        logs += [
            replace(started(log.rows(slice(a, b)), float(soc[a])), name=f"{log.name}_{k}")
            for k, (a, b) in enumerate(pairwise(edges))
        ]
    return PackLogs("a123", "cells", logs, A123_AH * A123_PARALLEL, LG_SERIES, (4, 20))


def _leaf(data: Path) -> PackLogs:
    paths = sorted((data / "leaf_module_ornl").glob("module123-*.csv.gz"))
    logs = [as_pack(read_log(x), MODULES, 1, 100.0) for x in paths]
    return PackLogs("leaf", "cells", logs, MODULE_AH, MODULES * 6, (3, 20))


CAR1 = {"weights": ("02", "03", "05"), "frozen": ("07", "08")}


@cache
def recorded(data: Path, part: str) -> tuple[PackLogs, ...]:
    """Read the recorded packs of a part."""
    out: list[Callable[[], PackLogs]] = [
        lambda: _i3(data, ODD_A if part == "weights" else EVEN_A, "i3", (3, 20)),
        lambda: _i3(data, ODD_B if part == "weights" else EVEN_B, "i3_winter", (3, 20)),
        *[lambda x=x: _lg(data, part, x) for x in LG[part]],
        lambda: _car1(data, CAR1[part]),
    ]
    if part == "weights":
        out += [lambda: _a123(data), lambda: _leaf(data)]
    return tuple(make() for make in out)


PER_K, ENTROPY_PER_K = 0.03, 2e-4
"""Usual change of a pack's resistance per kelvin, relative to it, and of its voltage [1/K]: what a
thermometer that reads wrong makes of a model."""
