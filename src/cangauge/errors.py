"""The exceptions that cangauge raises on purpose, and the exit codes that they mean.

The names most like one that does not exist: "did you mean …?".
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from itertools import islice
from os import PathLike
from typing import Any, Final

# --- The exceptions that cangauge raises on purpose, and the exit codes that they mean


class CangaugeError(Exception):
    """Anything that cangauge reports in one clear line instead of a traceback (exit code 1)."""

    exit_code = 1
    logged = False
    """Set once the error is logged, to avoid reporting it twice."""

    def to_dict(self) -> dict[str, Any]:
        """Return the message and its parts for `--json`; None is a part that is not known."""
        parts = dict.fromkeys(("source", "field", "value", "cure"))
        return {"message": str(self), **parts}


class InputError(CangaugeError):
    """Bad usage or input (exit code 2): names the file, the field, the value and the cure.

    Parameters
    ----------
    problem : str
        What is wrong, in words ("time runs backwards").
    source : path-like, optional
        The file (or bus, or option) that it was found in.
    field : str, optional
        The column, signal, JSON field or option concerned.
    value : object, optional
        The offending value, as read.
    cure : str, optional
        What the user can do about it.
    """

    exit_code = 2

    def __init__(
        self,
        problem: str,
        *,
        source: str | PathLike[str] | None = None,
        field: str | None = None,
        value: object = None,
        cure: str | None = None,
    ) -> None:
        self.problem = problem
        self.source = None if source is None else str(source)
        self.field = field
        self.value = value
        self.cure = cure
        super().__init__(self._line())

    def to_dict(self) -> dict[str, Any]:
        """Return the message and its parts for `--json`; None is a part that is not known."""
        return {
            "message": str(self),
            "source": self.source,
            "field": self.field and _short(self.field),
            "value": _plain(self.value),
            "cure": self.cure and _short(self.cure, _LONGEST_PROBLEM),
        }

    def _line(self) -> str:
        field = None if self.field is None else _short(self.field)
        source = None if self.source is None else _short(self.source, _LONGEST_PATH)
        where = ": ".join(part for part in (source, field) if part)
        problem = _short(self.problem, _LONGEST_PROBLEM)
        text = f"{where}: {problem}" if where else problem
        if self.value is not None:
            text += f" (got {_shown(self.value)})"
        if self.cure:
            text += f"; {_short(self.cure, _LONGEST_PROBLEM)}"
        # What a file or its name holds must neither break the line nor control a terminal.
        return "".join(
            char if char.isprintable() else char.encode("unicode_escape").decode() for char in text
        )


# What is quoted from a file may be of any length; a message is to be read.
_LONGEST_VALUE = 160
_LONGEST_PROBLEM = 600
_LONGEST_PATH = 1000


def _short(text: str, longest: int = _LONGEST_VALUE) -> str:
    return text if len(text) <= longest else text[:longest] + "…"


def _shown(value: object) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of more than 4300 digits; lists in lists in …
        return f"a huge {type(value).__name__}"
    return _short(text)


def _plain(value: object) -> bool | float | str | None:
    """Return a number or a text as it is, anything else as the message quotes it."""
    if hasattr(value, "tolist"):  # numpy's
        value = value.tolist()
    if value is None or isinstance(value, bool | float):
        return value
    if isinstance(value, int) and value.bit_length() <= 64:
        return value
    return _short(value) if isinstance(value, str) else _shown(value)


# --- The names most like one that does not exist: "did you mean …?"

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
