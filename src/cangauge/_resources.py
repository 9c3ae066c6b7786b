"""The installation's data files."""

from __future__ import annotations

from pathlib import Path

from cangauge.errors import InputError

_PACKAGE = Path(__file__).parent
# An installed wheel has the data inside the package, a checkout at its top level.
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
        If it is absent (a broken installation).
    """
    for root in _ROOTS:
        path = root / folder / name
        if path.is_file():
            return path
    raise InputError(
        "this file of the installation is missing",
        source=f"{folder}/{name}",
        cure="reinstall cangauge",
    )
