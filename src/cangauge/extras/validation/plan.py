"""Plan of the withheld check: protocols → cases, each with a seed and a cause.

Names and order of the cases are shuffled, so that neither reveals the cause. Seeds of cases for
development are even, those of final cases odd: a case that a method was tuned on is never final.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.extras.validation.recordings import LABORATORY_CAUSES
from cangauge.extras.validation.twin.faults import fault_kinds

EFFECTS: Final = tuple(kind.id for kind in fault_kinds())
OUTSIDE_EFFECTS: Final = tuple(kind.id for kind in fault_kinds(outside=True))

_CASES_PER_SCENARIO: Final = 4
"""Cases that share a pack, its training logs and its references."""

_Cases = list[tuple[int, tuple[str, ...]]]


@dataclass(frozen=True)
class PlannedCase:
    """One case to draw.

    Parameters
    ----------
    name : str
        Without information on the cause.
    seed : int
    effects : tuple of str
        Ids of the faults; empty for a healthy pack.
    """

    name: str
    seed: int
    effects: tuple[str, ...]


@dataclass(frozen=True)
class Group:
    """Cases of one protocol that share a pack."""

    protocol: str
    scenario_seed: int
    cases: tuple[PlannedCase, ...]


@dataclass(frozen=True)
class Sizes:
    """Numbers of cases of a protocol.

    Parameters
    ----------
    per_effect, healthy : int
        Cases of each effect, and healthy ones.
    per_outside : int
        Cases of each fault outside the effects library.
    pairs : int
        Cases of two effects at once.
    effects : int
        Number of effects, drawn at random; by default all.
    laboratory : int
        Laboratory cases, which are always the same.
    """

    per_effect: int = 0
    healthy: int = 0
    per_outside: int = 0
    pairs: int = 0
    effects: int = len(EFFECTS)
    laboratory: int = 0

    @property
    def cases(self) -> int:
        """Number of cases in all."""
        named = min(self.effects, len(EFFECTS)) * self.per_effect
        outside = len(OUTSIDE_EFFECTS) * self.per_outside
        return named + outside + self.healthy + self.pairs + self.laboratory


FULL: Final[dict[str, Sizes]] = {
    "simulated": Sizes(per_effect=20, healthy=300),
    "outside": Sizes(per_outside=6),
    "two-effects": Sizes(pairs=40),
    "equation": Sizes(per_effect=10, healthy=100),
    "published": Sizes(per_effect=5, healthy=50),
    "pybamm": Sizes(per_effect=2, healthy=10),
    "real-bmw_i3": Sizes(per_effect=5, healthy=40),
    "real-lg_hg2": Sizes(per_effect=5, healthy=20),
    **{name: Sizes(laboratory=number) for name, (_, number) in LABORATORY_CAUSES.items()},
}

SMALL: Final[dict[str, Sizes]] = {
    "simulated": Sizes(per_effect=1, healthy=2, effects=5),
    "two-effects": Sizes(pairs=1),
    "real-bmw_i3": Sizes(per_effect=1, healthy=1, effects=2),
    "real-lg_hg2": Sizes(per_effect=1, healthy=1, effects=1),
}

_SECONDS_PER_CASE: Final = {
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
"""Rough time to draw and diagnose a case on one core [s]."""

_OPEN_SET_SECONDS_PER_CASE: Final = 2.0
_OPEN_SET_PER_EFFECT: Final = {"full": 10, "small": 1}
"""Simulated cases of each effect that are diagnosed again without it in the library."""

NEEDS_DATA: Final = tuple(
    name for name in FULL if name.startswith("real-") or name in LABORATORY_CAUSES
)


def plan(protocols: dict[str, Sizes], *, seed: int, final: bool) -> tuple[Group, ...]:
    """Plan the cases of some protocols.

    Parameters
    ----------
    protocols : dict of str to Sizes
    seed : int
    final : bool
        Use the seeds that are reserved for published figures.
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
                scenario_seed,
                tuple(PlannedCase(next(names), case_seed, effects) for case_seed, effects in cases),
            )
            for scenario_seed, cases in parts
        ]
    return tuple(groups[k] for k in rng.permutation(len(groups)))


def _groups(protocol: str, sizes: Sizes, *, seed: int, final: bool) -> list[tuple[int, _Cases]]:
    rng = _rng(protocol, seed, final=final)
    if sizes.laboratory:
        cause = LABORATORY_CAUSES[protocol][0]
        return [(number, [(number, (cause,))]) for number in range(sizes.laboratory)]
    causes = list(_causes(sizes, rng))
    seeds = _seeds(rng, len(causes), final=final)
    order = rng.permutation(len(causes))
    cases = [(seeds[k], causes[k]) for k in order]
    parts = [
        cases[at : at + _CASES_PER_SCENARIO] for at in range(0, len(cases), _CASES_PER_SCENARIO)
    ]
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
    """Draw distinct seeds: even ones for development, odd ones for published figures."""
    seeds: list[int] = []
    taken: set[int] = set()
    while len(seeds) < number:
        value = 2 * int(rng.integers(2**30)) + int(final)
        if value not in taken:
            taken.add(value)
            seeds.append(value)
    return seeds


def is_outside(effects: Sequence[str]) -> bool:
    """Whether one of the effects is outside the effects library."""
    return any(effect in OUTSIDE_EFFECTS for effect in effects)


def open_set_size(part: str, per_effect: int | None) -> int:
    """Return the number of cases of each effect in the open set."""
    usual = _OPEN_SET_PER_EFFECT[part]
    return usual if per_effect is None else min(usual, per_effect)


def estimated_seconds(sizes: dict[str, Sizes], open_set: int) -> float:
    """Return the rough time of a plan on one core [s]."""
    again = open_set * sizes["simulated"].effects if "simulated" in sizes else 0
    return (
        sum(_SECONDS_PER_CASE[name] * item.cases for name, item in sizes.items())
        + _OPEN_SET_SECONDS_PER_CASE * again
    )
