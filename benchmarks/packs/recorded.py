"""Recorded packs: logs that train models of a pack, and logs that judge them.

Constants may be chosen on packs of the role "development" only. A log that a judged pack is scored
on is in no development pack. But the models of judged packs are trained on development logs too;
of `leaf_module` and `a123_lfp` alone development knows no log at all.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

import cangauge

MIN_S = 870.0
"""Shorter logs train, but are not judged: a wrong start has ten minutes to be found out [s]."""
PIECE_S = 1800.0
"""Length of the pieces that recordings of hours are cut into [s], as a usual trip."""
LG_CELLS, LG_PARALLEL, LG_CELL_AH = 96, 17, 2.78
"""Pack that the LG HG2 cell is scaled to; full discharge of the cell at 25 °C [Ah]."""
LEAF_MODULES, LEAF_AH = 16, 55.1
"""Modules of six cells in series; mean of four full discharges at 0.3 to 2.75 C [Ah]."""
A123_CELLS, A123_PARALLEL, A123_CELL_AH = 96, 20, 2.07
"""Pack that the A123 cell is scaled to; its discharge at C/30 and 25 °C [Ah]."""
SIZES = (1, 2, 3, 5, 10)
WINTER = ("B03", "B05", "B06", "B16", "B17", "B18", "B19", "B20")


@dataclass(frozen=True)
class Pack:
    """Logs of a pack that train models, and logs at 1 Hz that judge them.

    `chemistry` and `cells` are told to the estimators. `capacity_ah` None: the charge per 100 % of
    the training logs' reference. `sizes`: numbers of training logs. `group`: packs of another
    group are other packs.
    """

    name: str
    group: str
    role: str
    chemistry: str
    cells: int
    training: Sequence[cangauge.Log]
    judged: Sequence[cangauge.Log]
    capacity_ah: float | None = None
    sizes: Sequence[int] = SIZES

    def draws(self, size: int, number: int, seed: int) -> Iterator[tuple[int, list, list]]:
        """Yield number, training and judged logs of at most `number` different draws."""
        drawn = set()
        for draw in range(number):
            rng = np.random.default_rng([seed, zlib.crc32(self.name.encode()), size, draw])
            chosen = frozenset(rng.permutation(len(self.training))[:size].tolist())
            training = [self.training[k] for k in sorted(chosen)]
            judged = [log for log in self.judged if log.name not in {one.name for one in training}]
            if chosen not in drawn and len(training) == size and judged:
                drawn.add(chosen)
                yield draw, training, judged

    def months(self, size: int) -> tuple[list, list]:
        """Return the first training logs and all later ones, at 1 Hz, in time order."""
        logs = {log.name: log for log in [*self.training, *self.judged]}
        ordered = [one_hz(logs[name]) for name in sorted(logs)]
        return ordered[:size], ordered[size:]

    def capacity_of(self, training: Sequence[cangauge.Log]) -> float:
        """Return the capacity of models of some training logs [Ah]."""
        return self.capacity_ah or _capacity_from_reference(training)


def counted_ah(log: cangauge.Log) -> np.ndarray:
    """Return the charge drawn since the first row [Ah], by trapezoids."""
    steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s)
    return np.concatenate([[0.0], np.cumsum(steps)]) / 3600.0


def load(folder: Path, names: Sequence[str] | None = None) -> list[Pack]:
    """Read the recorded packs of a folder, those named or all whose folder is there."""
    readers = [(name, group, read) for name, (group, read) in PACKS.items()]
    return [
        replace(read(folder / group, name), name=name, group=group)
        for name, group, read in readers
        if (folder / group).is_dir() and (not names or name in names)
    ]


def _capacity_from_reference(logs: Sequence[cangauge.Log]) -> float:
    covariance = variance = 0.0
    for log in logs:
        known = np.isfinite(log.soc_pct)
        if known.any() and np.ptp(log.soc_pct[known]) >= 1.0:
            soc, out = log.soc_pct[known], counted_ah(log)[known]
            covariance += float(np.sum((soc - soc.mean()) * (out - out.mean())))
            variance += float(np.sum((soc - soc.mean()) ** 2))
    return -100.0 * covariance / variance


def _i3(folder: Path, trips: Sequence[str], role: str) -> Pack:
    def read(trip: str) -> cangauge.Log:
        return cangauge.read_log(folder / f"Trip{trip}.csv.gz")

    odd = [read(f"A{number:02d}") for number in range(1, 22, 2)]
    return Pack("", "", role, "oxide", 96, odd, _judged(map(read, trips)))


def _i3_months(folder: Path) -> Pack:
    logs = [cangauge.read_log(path) for path in sorted(folder.glob("Trip*.csv.gz"))]
    judged = [log for log in logs if log.name.removeprefix("Trip")[:3] not in _ODD]
    return Pack("", "", "judged", "oxide", 96, logs, judged, sizes=())


def _car1(folder: Path, role: str) -> Pack:
    pieces = []
    for path in sorted(folder.glob("car1_*.csv.gz")):
        log = cangauge.read_log(path)
        number = max(1, round((log.time_s[-1] - log.time_s[0]) / PIECE_S))
        edges = np.linspace(log.time_s[0], log.time_s[-1], number + 1)[1:-1]
        bounds = [0, *np.searchsorted(log.time_s, edges).tolist(), len(log)]
        pieces += [
            replace(log.rows(slice(low, high)), name=f"{log.name}_{part}")
            for part, (low, high) in enumerate(pairwise(bounds), start=1)
        ]
    is_dev = role == "development"
    training, judged = (pieces[::2], pieces[::2]) if is_dev else (pieces, pieces[1::2])
    return Pack("", "", role, "oxide", 96, training, _judged(judged))


def _lg(folder: Path, trained: str, judged: str, role: str, sizes: Sequence[int] = SIZES) -> Pack:
    def read(patterns: str) -> list[cangauge.Log]:
        paths = sorted({path for pattern in patterns.split() for path in folder.glob(pattern)})
        drives = [path for path in paths if "_Cap_" not in path.name]
        return [_as_pack(path, LG_CELLS, LG_PARALLEL, LG_CELL_AH, 100.0) for path in drives]

    capacity_ah = LG_CELL_AH * LG_PARALLEL
    training = read(trained)
    return Pack(
        "", "", role, "oxide", LG_CELLS, training, _judged(read(judged)), capacity_ah,
        sizes or (len(training),),
    )  # fmt: skip


def _leaf(folder: Path) -> Pack:
    paths = sorted(folder.glob("module123-*.csv.gz"))
    logs = [_as_pack(path, LEAF_MODULES, 1, LEAF_AH, 100.0) for path in paths]
    return Pack("", "", "judged", "oxide", 96, logs, _judged(logs), LEAF_AH, (1, 2, 3))


def _a123(folder: Path) -> Pack:
    logs = [
        _as_pack(path, A123_CELLS, A123_PARALLEL, A123_CELL_AH, start_pct)
        for script, start_pct in (("s1", 100.0), ("s3", 0.0))
        for path in sorted(folder.glob(f"A123_DYN_*_{script}.csv.gz"))
    ]
    capacity_ah = A123_CELL_AH * A123_PARALLEL
    return Pack("", "", "judged", "lfp", A123_CELLS, logs, _judged(logs), capacity_ah, (1, 2, 3, 5))


def _as_pack(
    path: Path, series: int, parallel: int, capacity_ah: float, start_pct: float
) -> cangauge.Log:
    """Return the log of a cell as that of a pack of equal cells, its SoC counted from the start."""
    log = cangauge.read_log(path)
    soc_pct = np.clip(start_pct - 100.0 * counted_ah(log) / capacity_ah, 0.0, 100.0)
    return replace(
        log,
        current_a=parallel * log.current_a,
        voltage_v=series * log.voltage_v,
        soc_pct=soc_pct,
    )


def _judged(logs: Iterable[cangauge.Log]) -> list[cangauge.Log]:
    """Return the logs that are long enough: the first row of each second, as on a slow bus."""
    return [one_hz(log) for log in logs if log.time_s[-1] - log.time_s[0] >= MIN_S]


def one_hz(log: cangauge.Log) -> cangauge.Log:
    """Return the first row of each second."""
    return first_of_each(log, 1.0)


def first_of_each(log: cangauge.Log, seconds: float) -> cangauge.Log:
    """Return the first row of each interval [s]."""
    number = np.floor((log.time_s - log.time_s[0]) / seconds + 1e-6)
    return log.rows(np.flatnonzero(np.diff(number, prepend=-1.0) > 0.0))


STOP_S, NIGHT_S = (600.0, 6 * 3600.0), (8 * 3600.0, 96 * 3600.0)
"""Time between drives [s]: where the SoC goes on, and where it does not: the car was charged, or
driven, without a log."""
SAME_PCT = 1.0
"""The SoC goes on if it differs by less [%]."""


def on_one_clock(logs: Sequence[cangauge.Log], seed: Sequence[int]) -> list[cangauge.Log]:
    """Return logs in their order on one clock, with stops and nights of random length between."""
    rng = np.random.default_rng(seed)
    days, end_s, end_pct = [], 0.0, math.nan
    for log in logs:
        soc_pct = log.soc_pct[np.isfinite(log.soc_pct)]
        low, high = STOP_S if abs(soc_pct[0] - end_pct) < SAME_PCT else NIGHT_S
        begin_s = end_s + float(np.exp(rng.uniform(np.log(low), np.log(high))))
        days.append(replace(log, time_s=log.time_s - log.time_s[0] + begin_s))
        end_s, end_pct = days[-1].time_s[-1], float(soc_pct[-1])
    return days


_ODD = [f"A{number:02d}" for number in range(1, 22, 2)]
_EVEN = [f"A{number:02d}" for number in range(2, 23, 2)]
_COLD = "0degC__5*_US06* 0degC__5*_Mixed* 10degC__5*_US06* 10degC__5*_Mixed*"
_COLD_DEV = "0degC__589_Mixed* 0degC__590_Mixed[78]* 10degC__567_Mixed* 10degC__571_Mixed[58]*"
_COLD_JUDGED = "0degC__590_Mixed5* 0degC__589_US06* 10degC__571_Mixed7* 10degC__567_US*"

PACKS: dict[str, tuple[str, Callable[[Path, str], Pack]]] = {
    "i3_dev": ("bmw_i3", lambda at, _: _i3(at, _ODD, "development")),
    "car1_dev": ("batic_car1", lambda at, _: _car1(at, "development")),
    "lg_hg2_dev": (
        "lg_hg2",
        lambda at, _: _lg(at, "25degC__551_*", "25degC__551_*", "development", (1, 2, 3)),
    ),
    "lg_cold_dev": (
        "lg_hg2",
        lambda at, _: _lg(at, "25degC__551_*", _COLD_DEV, "development", (1, 2, 3)),
    ),
    "lg_temps_dev": (
        "lg_hg2",
        lambda at, _: _lg(
            at, f"{_COLD_DEV} 25degC__551_Mixed*", f"{_COLD_DEV} 25degC__551_*", "development",
            (5, 8),
        ),
    ),
    "i3": ("bmw_i3", lambda at, _: _i3(at, _EVEN, "judged")),
    "i3_months": ("bmw_i3", lambda at, _: _i3_months(at)),
    "i3_winter": ("bmw_i3", lambda at, _: _i3(at, WINTER, "judged")),
    "car1": ("batic_car1", lambda at, _: _car1(at, "judged")),
    "lg_hg2": (
        "lg_hg2",
        lambda at, _: _lg(at, "25degC__*", "25degC__552_*", "judged", (1, 2, 3, 5)),
    ),
    "lg_hg2_cold": ("lg_hg2", lambda at, _: _lg(at, _COLD, _COLD_JUDGED, "judged")),
    "lg_hg2_from_25c": (
        "lg_hg2",
        lambda at, _: _lg(at, "25degC__551_*", _COLD_JUDGED, "judged", (3,)),
    ),
    "leaf_module": ("leaf_module_ornl", lambda at, _: _leaf(at)),
    "a123_lfp": ("a123_lfp", lambda at, _: _a123(at)),
} | {
    # The split of the literature: all mixed cycles in, US06 and LA92 out, by temperature.
    f"lg_split_{celsius}c": (
        "lg_hg2",
        lambda at, name: _lg(
            at, "*_Mixed*", " ".join(f"{name[9:-1]}degC__*_{drive}*" for drive in ("US06", "LA92")),
            "judged", (),
        ),
    )
    for celsius in (0, 10, 25, 40)
}  # fmt: skip
"""Pack → folder and reader. `_dev`: the part that constants may be chosen on. `i3_winter` and
`lg_hg2_from_25c` are judged at temperatures that their models have not seen. `i3_months` has all
trips, summer and winter, for `--months` alone."""
MONTHS = ("i3_dev", "car1_dev", "lg_temps_dev", "i3_months", "car1")
"""Cars that are estimated in time order; the order of names is that of time."""
