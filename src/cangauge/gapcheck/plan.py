"""What is drawn: how many cases of which cause in which protocol, each with its own seed.

Names and order of the cases are shuffled, so that neither tells the cause. Seeds for development
are even and final ones are odd: what a method was tuned on can never be among the final cases.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from cangauge.twin.case import OUTSIDE
from cangauge.twin.faults import fault_kinds

Protocol = Literal["simulated", "two-effects", "pybamm", "real-bmw_i3", "real-lg_hg2"]
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
    """

    per_effect: int = 0
    healthy: int = 0
    per_outside: int = 0
    pairs: int = 0
    effects: int = len(EFFECTS)


FULL: Final[dict[str, Sizes]] = {
    "simulated": Sizes(per_effect=20, healthy=300),
    "outside": Sizes(per_outside=6),
    "two-effects": Sizes(pairs=40),
    "pybamm": Sizes(per_effect=5, healthy=20),
    "real-bmw_i3": Sizes(per_effect=5, healthy=40),
    "real-lg_hg2": Sizes(per_effect=5, healthy=20),
}

SMALL: Final[dict[str, Sizes]] = {
    "simulated": Sizes(per_effect=1, healthy=2, effects=5),
    "outside": Sizes(),
    "two-effects": Sizes(pairs=1),
    "pybamm": Sizes(),
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
    return any(effect in OUTSIDE_EFFECTS or effect == OUTSIDE for effect in effects)
