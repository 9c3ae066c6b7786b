"""Fuzzing target: one kind of input.

`run` returns whether an input is accepted. It may refuse an input by a `CangaugeError`; any other
exception is a finding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from random import Random

from cangauge.errors import CangaugeError

MAX_MESSAGE = 2000


class FindingError(Exception):
    """An accepted input has a wrong result."""


@dataclass(frozen=True)
class Target:
    """One kind of input.

    Parameters
    ----------
    name : str
    make : callable
        Random generator → input.
    run : callable
        Input → whether it is accepted.
    weight : int
        Number of inputs that one call counts as.
    share : float
        Share of the inputs of a run.
    seeds : callable, optional
        Valid files; None for other inputs.
    """

    name: str
    make: Callable[[Random], bytes]
    run: Callable[[bytes], bool]
    share: float
    weight: int = 1
    seeds: Callable[[], dict[str, bytes]] | None = None


def attempt(target: Target, data: bytes) -> bool:
    """Run a target and return whether the input is accepted; raise findings."""
    with refusable():
        return target.run(data)
    return False


@contextmanager
def refusable() -> Iterator[None]:
    """Allow a `CangaugeError` whose message is one printable line."""
    try:
        yield
    except CangaugeError as error:
        line = str(error)
        if not line or not line.isprintable() or len(line) > MAX_MESSAGE:
            raise FindingError(f"a message of {len(line)} characters: {line[:100]!r}") from error
