"""Threads of the linear algebra: one, unless the user asks for more.

cangauge solves thousands of small systems. Threads do not make these faster, and where another
process has the other core, they wait for each other: a diagnosis then takes many times as long.
The libraries read these variables when they are loaded.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Final

THREADS: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


def one_thread(environment: MutableMapping[str, str]) -> None:
    """Ask for one thread, where the user has not said how many; before numpy is imported."""
    for name in THREADS:
        environment.setdefault(name, "1")
