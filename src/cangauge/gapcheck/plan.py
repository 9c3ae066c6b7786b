"""What is drawn: how many cases of which cause in which protocol, each with its own seed.

Names and order of the cases are shuffled, so that neither tells the cause. Seeds for development
are even and final ones are odd: what a method was tuned on can never be among the final cases.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cangauge.gapcheck.physical import CAUSES
from cangauge.twin.faults import fault_kinds

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
