"""One kind of input, and how an input may be refused.

A target's `run` returns whether the input was accepted. `InputError` (any `CangaugeError`) is how
it may be refused; whatever else comes out is a finding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from random import Random

from cangauge.errors import CangaugeError

LONGEST_MESSAGE = 2000


class FindingError(Exception):
    """An input was accepted, and what came of it is wrong."""


@dataclass(frozen=True)
class Target:
    """One kind of input.

    Parameters
    ----------
    name : str
    make : callable
        Draws an input from a generator of random numbers; `bytes`, or what `run` takes.
    run : callable
        Takes it; returns whether it was accepted.
    weight : int
        How many inputs one call counts for.
    share : float
        Share of all inputs in a whole run.
    seeds : callable, optional
        Valid files; None for what is no file.
    """

    name: str
    make: Callable[[Random], bytes]
    run: Callable[[bytes], bool]
    share: float
    weight: int = 1
    seeds: Callable[[], dict[str, bytes]] | None = None


def attempt(target: Target, data: bytes) -> bool:
    """Run a target; return whether the input was accepted; anything else is raised."""
    with refusable():
        return target.run(data)
    return False


@contextmanager
def refusable() -> Iterator[None]:
    """Let the inside end by a `CangaugeError` whose message is one readable line."""
    try:
        yield
    except CangaugeError as error:
        line = str(error)
        if not line or not line.isprintable() or len(line) > LONGEST_MESSAGE:
            raise FindingError(f"a message of {len(line)} characters: {line[:100]!r}") from error
