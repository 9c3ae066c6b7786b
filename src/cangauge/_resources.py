"""The installation's data files, and the threads of the linear algebra."""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

from cangauge.errors import InputError

_PACKAGE = Path(__file__).parent
# An installed wheel has the data inside the package, a checkout at its top level.
_ROOTS = (_PACKAGE / "share", _PACKAGE.parent.parent)

THREADS: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
"""Environment variables that BLAS libraries read when they are loaded."""


def shared_file(folder: str, name: str) -> Path:
    """Return the path of a data file that ships with cangauge.

    Parameters
    ----------
    folder : {"dbc", "replay"}
    name : str
        File name in that folder.

    Raises
    ------
    InputError
        If it is absent (a broken installation).
    """
    for root in _ROOTS:
        path = root / folder / name
        if path.is_file():
            return path
    problem = "this file of the installation is missing"
    raise InputError(problem, source=f"{folder}/{name}", cure="reinstall cangauge")


def one_thread(environment: MutableMapping[str, str]) -> None:
    """Limit BLAS to one thread where the user has not set it; before numpy is imported.

    cangauge solves thousands of small systems, which gain nothing from threads. On busy cores,
    threads that wait for each other slow a diagnosis down many times.
    """
    for name in THREADS:
        environment.setdefault(name, "1")
