"""The names most like one that does not exist: "did you mean …?"."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from itertools import islice
from typing import Final

_LONGEST: Final = 200
_MOST: Final = 20_000


def closest(word: str, names: Iterable[str]) -> str:
    """Return the names most like a word, joined by commas; "" if none is.

    A word that is too long to be a name has none, and only the first names of very many are
    compared: the search takes time with both.
    """
    if len(word) > _LONGEST:
        return ""
    by_lower = {name.lower(): name for name in islice(names, _MOST) if len(name) <= _LONGEST}
    hits = difflib.get_close_matches(word.lower(), by_lower, n=3, cutoff=0.5)
    return ", ".join(by_lower[hit] for hit in hits)
