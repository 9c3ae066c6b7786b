"""What the model misses on clean days: the floor that gaps are counted in.

Recorded logs that faults are put into: which identify, which are references, which held out.

Physical effects in recorded logs: nothing is put in, the cause is what the laboratory changed.

- `cold-bmw_i3`: winter trips of a car against the model of its summer trips. Each trip is left
  out in turn, the others are diagnosed; one more case has all of them.
- `cold-lg_hg2`: drive cycles of a cell at 0 and 10 °C against 25 °C.
- `hysteresis-a123_lfp`: a slow discharge and a slow charge of an LFP cell against drive cycles,
  which discharge: the model is as good on the discharge as on the drives and off on the charge.

What is drawn: how many cases of which cause in which protocol, each with its own seed.

Names and order of the cases are shuffled, so that neither tells the cause. Seeds for development
are even and final ones are odd: what a method was tuned on can never be among the final cases.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge.errors import InputError
from cangauge.identify.fit import Identification, fit
from cangauge.inference.rows import FitOptions, fit_rows
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.charge import capacity_from_reference
from cangauge.validation.twin.case import CaseLogs
from cangauge.validation.twin.faults import fault_kinds
from cangauge.validation.twin.recorded import RecordedSet, scaled_to_pack, with_start

# --- What the model misses on clean days: the floor that gaps are counted in


def identify(logs: Sequence[Log], capacity_ah: float) -> Identification:
    """Return the model of clean logs, as `cangauge fit` makes it.

    Parameters
    ----------
    logs : sequence of Log
    capacity_ah : float
        Capacity that the gauge assumes [Ah].
    """
    return fit(logs, capacity_ah=capacity_ah)


def missed_v(known: Identification, logs: Sequence[Log]) -> float:
    """Return the RMS error of a model on clean logs [V], by the SoC counted from their start.

    Parameters
    ----------
    known : Identification
    logs : sequence of Log
        Not those that it was identified on.
    """
    model = known.voltage_model
    options = FitOptions(
        capacity_ah=known.model.capacity_ah,
        rate_hz=known.model.rate_hz,
        delay_s=tuple(known.model.delays_s),
    )
    errors = [
        rows.voltage_v - model.voltage(rows.soc_pct, rows.temperature_c, rows.delayed_current_a)
        for rows in (fit_rows(log, options) for log in logs)
    ]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


# --- Recorded logs that faults are put into: which identify, which are references, which hel…

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


# --- Physical effects in recorded logs: nothing is put in, the cause is what the laboratory …

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
        known.model.to_json(),
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
        known.model.to_json(),
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
        known.model.to_json(),
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


# --- What is drawn: how many cases of which cause in which protocol, each with its own seed

EFFECTS: Final = tuple(kind.id for kind in fault_kinds())
OUTSIDE_EFFECTS: Final = tuple(kind.id for kind in fault_kinds(outside=True))

CASES_A_WORLD: Final = 4
"""Cases that share a pack, its training and its references."""


@dataclass(frozen=True)
class Planned:
    """One case to draw.

    Parameters
    ----------
    name : str
        Neutral.
    seed : int
    effects : tuple of str
        Ids of the twin's faults; empty for a healthy pack.
    """

    name: str
    seed: int
    effects: tuple[str, ...]


@dataclass(frozen=True)
class Group:
    """Cases of one protocol that share a pack.

    Parameters
    ----------
    protocol : str
    world_seed : int
    cases : tuple of Planned
    """

    protocol: str
    world_seed: int
    cases: tuple[Planned, ...]


@dataclass(frozen=True)
class Sizes:
    """How many cases a protocol has.

    Parameters
    ----------
    per_effect, healthy : int
        Cases of each named effect, and of none.
    per_outside : int
        Cases of each effect that no diagnosis is expected to know.
    pairs : int
        Cases of two named effects at once.
    effects : int
        How many of the named effects, drawn at random; all without a smaller number.
    physical : int
        Cases of recorded logs with a physical effect, which are always the same.
    """

    per_effect: int = 0
    healthy: int = 0
    per_outside: int = 0
    pairs: int = 0
    effects: int = len(EFFECTS)
    physical: int = 0

    @property
    def cases(self) -> int:
        """How many in all."""
        named = min(self.effects, len(EFFECTS)) * self.per_effect
        outside = len(OUTSIDE_EFFECTS) * self.per_outside
        return named + outside + self.healthy + self.pairs + self.physical


FULL: Final[dict[str, Sizes]] = {
    "simulated": Sizes(per_effect=20, healthy=300),
    "outside": Sizes(per_outside=6),
    "two-effects": Sizes(pairs=40),
    "equation": Sizes(per_effect=10, healthy=100),
    "published": Sizes(per_effect=5, healthy=50),
    "pybamm": Sizes(per_effect=2, healthy=10),
    "real-bmw_i3": Sizes(per_effect=5, healthy=40),
    "real-lg_hg2": Sizes(per_effect=5, healthy=20),
    **{name: Sizes(physical=number) for name, (_, number) in CAUSES.items()},
}

SMALL: Final[dict[str, Sizes]] = {
    "simulated": Sizes(per_effect=1, healthy=2, effects=5),
    "two-effects": Sizes(pairs=1),
    "real-bmw_i3": Sizes(per_effect=1, healthy=1, effects=2),
    "real-lg_hg2": Sizes(per_effect=1, healthy=1, effects=1),
}


def plan(protocols: dict[str, Sizes], *, seed: int, final: bool) -> tuple[Group, ...]:
    """Return everything that is to be drawn.

    Parameters
    ----------
    protocols : dict of str to Sizes
    seed : int
        Of the plan; nothing else is random.
    final : bool
        Take the seeds that are kept for the figures of a release.
    """
    groups: list[Group] = []
    drawn = {
        protocol: _groups(protocol, sizes, seed=seed, final=final)
        for protocol, sizes in protocols.items()
    }
    total = sum(len(cases) for group in drawn.values() for _, cases in group)
    rng = _rng("names", seed, final=final)
    names = iter([f"case_{number + 1:05d}" for number in rng.permutation(total)])
    for protocol, parts in drawn.items():
        groups += [
            Group(
                protocol,
                world_seed,
                tuple(Planned(next(names), case_seed, effects) for case_seed, effects in cases),
            )
            for world_seed, cases in parts
        ]
    return tuple(groups[k] for k in rng.permutation(len(groups)))


_Cases = list[tuple[int, tuple[str, ...]]]


def _groups(protocol: str, sizes: Sizes, *, seed: int, final: bool) -> list[tuple[int, _Cases]]:
    rng = _rng(protocol, seed, final=final)
    if sizes.physical:
        cause = CAUSES[protocol][0]
        return [(number, [(number, (cause,))]) for number in range(sizes.physical)]
    causes = list(_causes(sizes, rng))
    seeds = _seeds(rng, len(causes), final=final)
    order = rng.permutation(len(causes))
    cases = [(seeds[k], causes[k]) for k in order]
    parts = [cases[at : at + CASES_A_WORLD] for at in range(0, len(cases), CASES_A_WORLD)]
    return list(zip(_seeds(rng, len(parts), final=final), parts, strict=True))


def _causes(sizes: Sizes, rng: np.random.Generator) -> Iterator[tuple[str, ...]]:
    chosen = rng.permutation(len(EFFECTS))[: sizes.effects]
    for k in sorted(chosen.tolist()):
        yield from ((EFFECTS[k],),) * sizes.per_effect
    yield from ((),) * sizes.healthy
    for effect in OUTSIDE_EFFECTS:
        yield from ((effect,),) * sizes.per_outside
    for _ in range(sizes.pairs):
        first, second = rng.choice(len(EFFECTS), size=2, replace=False).tolist()
        yield (EFFECTS[first], EFFECTS[second])


def _rng(protocol: str, seed: int, *, final: bool) -> np.random.Generator:
    return np.random.default_rng([int(final), seed, *protocol.encode()])


def _seeds(rng: np.random.Generator, number: int, *, final: bool) -> list[int]:
    """Return distinct seeds, even for development, odd for the final figures."""
    seeds: list[int] = []
    taken: set[int] = set()
    while len(seeds) < number:
        value = 2 * int(rng.integers(2**30)) + int(final)
        if value not in taken:
            taken.add(value)
            seeds.append(value)
    return seeds


def is_outside(effects: Sequence[str]) -> bool:
    """Whether a cause is one that no diagnosis is expected to know."""
    return any(effect in OUTSIDE_EFFECTS for effect in effects)


ROUGH_S: Final = {
    "simulated": 6.0,
    "outside": 6.0,
    "two-effects": 6.0,
    "equation": 6.0,
    "published": 6.0,
    "pybamm": 53.0,
    "real-bmw_i3": 12.0,
    "real-lg_hg2": 25.0,
    "cold-bmw_i3": 60.0,
    "cold-lg_hg2": 30.0,
    "hysteresis-a123_lfp": 12.0,
}
"""Seconds that drawing and diagnosing a case take, roughly."""

OPEN_SET_S: Final = 2.0
OPEN_SET_OF: Final = {"full": 10, "small": 1}
"""So many cases of each simulated effect are diagnosed again with it out of the library."""

NEEDS_DATA: Final = tuple(name for name in FULL if name.startswith("real-") or name in CAUSES)


def open_set_of(part: str, per_effect: int | None) -> int:
    """Return how many cases of each effect the open set has."""
    usual = OPEN_SET_OF[part]
    return usual if per_effect is None else min(usual, per_effect)


def seconds_of(sizes: dict[str, Sizes], open_set: int) -> float:
    """Return roughly how long a plan takes on one core [s]."""
    again = open_set * sizes["simulated"].effects if "simulated" in sizes else 0
    return sum(ROUGH_S[name] * item.cases for name, item in sizes.items()) + OPEN_SET_S * again
