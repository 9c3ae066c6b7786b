"""Exceptions of cangauge with their exit codes; suggestions for misspelt names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from itertools import islice
from numbers import Real
from os import PathLike
from typing import Any, Final, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class CangaugeError(Exception):
    """An error that is reported in one line instead of a traceback (exit code 1)."""

    exit_code = 1
    logged = False
    """Set once logged, to avoid reporting twice."""
    source: str | None = None
    field: str | None = None
    value: object = None
    cure: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the message and its parts for `--json`; unknown parts are None."""
        return {
            "message": str(self),
            "source": self.source,
            "field": self.field and _short(self.field, _LONGEST_VALUE),
            "value": _json_value(self.value),
            "cure": self.cure and _short(self.cure),
        }


class InputError(CangaugeError):
    """Bad usage or input (exit code 2): names the file, the field, the value and the cure.

    Parameters
    ----------
    problem : str
        The problem in a phrase ("time runs backwards").
    source : path-like, optional
        The file, bus or option.
    field : str, optional
        The column, signal, JSON field or option concerned.
    value : object, optional
        The offending value, as read.
    cure : str, optional
        What the user can do about it.

    Examples
    --------
    >>> print(InputError("is missing", source="car.toml", field="model", cure="add it"))
    car.toml: model: is missing; add it
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
        where = [_short(self.source or "", _LONGEST_PATH), _short(field or "", _LONGEST_VALUE)]
        text = ": ".join(filter(None, [*where, _short(problem)]))
        if value is not None:
            text += f" (got {_quoted(value)})"
        if cure:
            text += f"; {_short(cure)}"
        # Text quoted from a file or its name must neither break the line nor control a terminal.
        super().__init__(
            "".join(
                char if char.isprintable() else char.encode("unicode_escape").decode()
                for char in text
            )
        )


@contextmanager
def located(source: str | PathLike[str] | None, field: str = "") -> Iterator[None]:
    """Name the file of errors raised within, and put `field` before the field that they name."""
    try:
        yield
    except InputError as error:
        raise InputError(
            error.problem,
            source=error.source or source,
            field=".".join(filter(None, [field, error.field])) or None,
            value=error.value,
            cure=error.cure,
        ) from error


_OPTION: Final = re.compile(r"--([a-z]+(?:-[a-z]+)*)(?: (from-soc)|( (?=['\d])))?")
_ARGUMENTS: Final = {
    "temperature": "temperature_c",
    "initial-soc": "initial_soc_pct",
    "initial-soc-std": "initial_soc_std_pct",
    "valid-std": "valid_std_pct",
    "delays": "delay_s",
    "reference": "references",
    "simulated": "simulation",
}
"""Arguments of Python whose names differ from those of the options."""


def naming_arguments(function: Callable[P, T]) -> Callable[P, T]:
    """Let the errors of a function of Python name its arguments in place of the options."""

    def argument(option: re.Match[str]) -> str:
        name = _ARGUMENTS.get(option[1], option[1].replace("-", "_"))
        if option[2]:
            return f'{name}="{option[2]}"'
        return f"{name}=" if option[3] else name

    def named(text: str | None) -> str | None:
        return text and _OPTION.sub(argument, text)

    @wraps(function)
    def call(*arguments: P.args, **options: P.kwargs) -> T:
        try:
            return function(*arguments, **options)
        except InputError as error:
            if "--" not in str(error):
                raise
            raise InputError(
                named(error.problem) or "",
                source=error.source,
                field=named(error.field),
                value=error.value,
                cure=named(error.cure),
            ) from error

    return call


def require_choice(value: object, choices: Iterable[object], field: str) -> None:
    """Raise InputError if a value is none of some; `field` is its argument."""
    known = list(choices)
    if value not in known:
        raise InputError(
            "not a known value",
            field=field,
            value=value,
            cure=f"use one of: {', '.join(map(str, known))}",
        )


def require_number(value: object, field: str) -> None:
    """Raise InputError if a value is no number; `field` is its argument."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise InputError("not a number", field=field, value=value, cure="give it without a unit")


COLDEST_C: Final = -60.0
HOTTEST_C: Final = 120.0
"""Temperatures of a battery lie between [°C]."""


def require_temperature(value_c: float | None) -> None:
    """Raise InputError if the constant temperature that a user gives is none of a battery."""
    if value_c is None:
        return
    require_number(value_c, "--temperature")
    if not COLDEST_C <= value_c <= HOTTEST_C:
        raise InputError(
            f"must lie within {COLDEST_C:g} … {HOTTEST_C:g} °C",
            field="--temperature",
            value=value_c,
        )


# Wording of pydantic, and the shorter one of our messages.
_WORDING: Final = (
    ("Value error, ", ""),
    ("Input should be", "must be"),
    ("greater than or equal to", "at least"),
    ("less than or equal to", "at most"),
    (", unable to parse string as a number", ""),
    (", unable to parse string as an integer", ""),
)


def in_our_words(text: str) -> str:
    """Return a message of pydantic, or of typer, which asks it, in the words of our messages."""
    for theirs, ours in _WORDING:
        text = text.replace(theirs, ours, 1)
    return text


# Text quoted from a file may have any length [characters].
_LONGEST_VALUE: Final = 160
_LONGEST_TEXT: Final = 600
_LONGEST_PATH: Final = 1000


def _short(text: str, longest: int = _LONGEST_TEXT) -> str:
    return text if len(text) <= longest else text[:longest] + "…"


def _quoted(value: object) -> str:
    try:
        return _short(repr(value), _LONGEST_VALUE)
    except (ValueError, RecursionError):  # a number of more than 4300 digits; deeply nested lists
        return f"a huge {type(value).__name__}"


def _json_value(value: Any) -> bool | float | str | None:
    """Return numbers and text unchanged, anything else as quoted in the message."""
    value = value.tolist() if hasattr(value, "tolist") else value  # numpy's
    if isinstance(value, str):
        return _short(value, _LONGEST_VALUE)
    is_small = isinstance(value, int) and value.bit_length() <= 64
    return value if is_small or value is None or isinstance(value, float) else _quoted(value)


def closest(word: str, names: Iterable[str]) -> str:
    """Return up to three names most similar to a word, joined by commas; "" if none is.

    For "did you mean …?". The time of the search grows with length and number of the names, which
    are therefore limited.
    """
    if len(word) > 200:
        return ""
    by_lower = {name.lower(): name for name in islice(names, 20_000) if len(name) <= 200}
    hits = difflib.get_close_matches(word.lower(), by_lower, n=3, cutoff=0.5)
    return ", ".join(by_lower[hit] for hit in hits)
