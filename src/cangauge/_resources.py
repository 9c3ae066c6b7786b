"""Where the data files that ship with cangauge are: `dbc` and `replay`.

Threads of the linear algebra: one, unless the user asks for more.

cangauge solves thousands of small systems. Threads do not make these faster, and where another
process has the other core, they wait for each other: a diagnosis then takes many times as long.
The libraries read these variables when they are loaded.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

from cangauge.errors import InputError

# --- Where the data files that ship with cangauge are: `dbc` and `replay`

_PACKAGE = Path(__file__).parent
# An installed wheel carries them inside the package, a checkout at its top level.
_ROOTS = (_PACKAGE / "share", _PACKAGE.parent.parent)


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
        If it is not there (a broken installation).
    """
    for root in _ROOTS:
        path = root / folder / name
        if path.is_file():
            return path
    raise InputError(
        "this file of the installation is missing",
        source=f"{folder}/{name}",
        cure="install cangauge again",
    )


# --- Threads of the linear algebra: one, unless the user asks for more

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
