"""Commands declared by their docstrings: arguments, options, units and bounds from *Parameters*.

The function of a command has plain types, and its docstring says the rest::

    log : LOG
        Recorded log.
    output : -o, --output OUT.csv|.parquet
        Table of estimates.
    initial_soc : P|auto (0 … 100 %)
        SoC at the first row.

Positional parameters are arguments, keyword-only ones options; those in `SHARED` need no entry. The
line after a name holds flags (default: the name), the placeholder of the value, and its bounds with
their unit. A file to write (`Written`) must have one of the placeholder's suffixes. Where a number
has words beside it, as in `P|auto (0 … 100 %)`, the command gets the number or the word. A
parameter that is a dataclass stands for its fields, `**options` for keys of the configuration of
`cangauge run`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Union, get_args, get_origin, get_type_hints

import typer

from cangauge._files import require_suffix
from cangauge.errors import InputError

Command = Callable[..., None]
Keys = Callable[[], list[inspect.Parameter]]
_WRITTEN: Final = "a file to write"
Written = Annotated[Path, _WRITTEN]
"""Path of a file to write."""
_SECTION: Final = re.compile(r"\n\nParameters\n-+\n(.*?)(?=\n\n\w+\n---|\Z)", re.DOTALL)
_ENTRY: Final = re.compile(r"^(\w+) : (.*)\n((?:    .*\n?)+)", re.MULTILINE)
_SPEC: Final = re.compile(
    r"(?P<flags>(?:--?[\w/-]+(?:, )?)*) ?(?P<metavar>[^ (]*)"
    r"(?: ?\((?P<low>\S+) … (?P<high>\S+)(?: (?P<unit>[^)]+))?\))?"
)


def command(*omitted: str, keys: Keys | None = None) -> Callable[[Command], Command]:
    """Return the decorator of a command, which typer then reads.

    Parameters
    ----------
    *omitted : str
        Fields of dataclasses that are no options of this command, but keep their defaults.
    keys : callable, optional
        Returns the parameters that `**options` stands for.
    """

    def decorate(function: Command) -> Command:
        text, entries = _parameters(function)
        entries = SHARED | entries
        hints = get_type_hints(function, include_extras=True)
        groups: dict[str, tuple[type, list[str]]] = {}
        made: list[inspect.Parameter] = []
        for parameter in inspect.signature(function).parameters.values():
            kind = hints[parameter.name]
            if parameter.kind is parameter.VAR_KEYWORD:
                made += [] if keys is None else keys()
            elif isinstance(kind, type) and is_dataclass(kind):
                of_group = list(_of_group(kind, omitted))
                groups[parameter.name] = kind, [each.name for each in of_group]
                made += of_group
            else:
                made.append(_declared(parameter, kind, *entries[parameter.name]))

        def run(**given: Any) -> None:
            for name, (kind, names) in groups.items():
                given[name] = kind(**{each: given.pop(each) for each in names})
            named = {k: v for k, v in given.items() if k not in arguments}
            function(*(given[name] for name in arguments), **named)

        arguments = [p.name for p in made if p.kind is p.POSITIONAL_OR_KEYWORD]
        run.__doc__ = text
        run.__signature__ = inspect.Signature(made)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in made}
        return run

    return decorate


def _parameters(documented: Any) -> tuple[str, dict[str, tuple[str, str]]]:
    """Split a docstring into the text of the help page, and specification and help by name."""
    doc = inspect.getdoc(documented) or ""
    found = _SECTION.search(doc)
    if found is None:
        return doc, {}
    return doc[: found.start()] + doc[found.end() :], _entries(found[1])


def _entries(section: str) -> dict[str, tuple[str, str]]:
    return {name: (spec, " ".join(text.split())) for name, spec, text in _ENTRY.findall(section)}


SHARED: Final = _entries("""
model : -m, --model MODEL
    Model file of `cangauge fit`.
capacity_ah : A (0.001 … 1e5 Ah)
    Charge from 100 to 0 %. Default: the model's.
alarm : P (0 … 1)
    Report a fault where the probability of none is at most this.
report : FILE.html|.htm
    Write a report as one self-contained page.
json_output : --json
    Print exactly one JSON object on stdout, also for an error.
""")
"""Parameters that mean the same in several commands: a docstring need not repeat them."""


def _of_group(kind: type, omitted: tuple[str, ...]) -> Iterator[inspect.Parameter]:
    _, entries = _parameters(kind)
    hints = get_type_hints(kind, include_extras=True)
    for each in fields(kind):
        if each.name not in omitted:
            default = inspect.Parameter.empty if each.default is MISSING else each.default
            named = inspect.Parameter(each.name, inspect.Parameter.KEYWORD_ONLY, default=default)
            yield _declared(named, hints[each.name], *entries[each.name])


def _declared(
    parameter: inspect.Parameter, kind: Any, specification: str, text: str
) -> inspect.Parameter:
    """Return the parameter as typer reads it."""
    spec = _SPEC.fullmatch(specification)
    if spec is None:
        raise ValueError(f"{parameter.name} : {specification} is no specification")
    options: dict[str, Any] = {"metavar": spec["metavar"] or None, "help": text}
    suffixes = re.findall(r"\.\w+", spec["metavar"]) if _is_written(kind) else []
    if spec["low"] is not None:
        bounds = f"within {spec['low']} … {spec['high']} {spec['unit'] or ''}".rstrip()
        options["help"] += f" ({bounds})"
    if suffixes or spec["low"] is not None:
        options["callback"] = _checked(spec, suffixes)
    if parameter.kind is parameter.KEYWORD_ONLY:
        flags = spec["flags"] or f"--{parameter.name.replace('_', '-')}"
        info = typer.Option(*flags.split(", "), **options)
    else:
        info = typer.Argument(show_default=False, **options)
    return parameter.replace(annotation=Annotated[_plain(kind), info])


def _checked(spec: re.Match[str], suffixes: list[str]) -> Any:
    """Return the callback that checks suffix or bounds, and makes numbers of text."""
    words = [word for word in spec["metavar"].split("|") if word.islower()]

    def check(param: typer.CallbackParam, value: Any) -> Any:
        if isinstance(value, list):
            return [check(param, each) for each in value]
        if value is None or value in words:
            return value
        option = param.opts[-1]
        if suffixes:
            require_suffix(value, *suffixes, field=option)
            return value
        low, high, unit = float(spec["low"]), float(spec["high"]), spec["unit"] or ""
        return within(_number(value, words, option, unit), low, high, option=option, unit=unit)

    return check


def _number(value: Any, words: list[str], option: str, unit: str) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError as error:
        word = " or ".join(words)
        cure = f"give a number{f' of {unit}' if unit else ''}, or {word}"
        raise InputError(
            f"neither a number nor {word}", field=option, value=value, cure=cure
        ) from error


def within(value: Any, low: float, high: float, *, option: str, unit: str = "") -> Any:
    """Return a number within low … high; else (NaN too) raise InputError."""
    if not low <= value <= high:
        raise InputError(
            f"must lie within {low:g} … {high:g} {unit}".rstrip(), field=option, value=value
        )
    return value


def _is_written(kind: Any) -> bool:
    return _WRITTEN in getattr(kind, "__metadata__", ()) or any(map(_is_written, get_args(kind)))


def _plain(kind: Any) -> Any:
    """Return the type that typer reads: text where a number or a word may stand."""
    origin = get_origin(kind)
    if origin is Annotated:
        return get_args(kind)[0]
    if origin is list:
        return list[_plain(get_args(kind)[0])]  # type: ignore[misc]
    if origin in {Union, UnionType}:
        parts = [_plain(part) for part in get_args(kind) if part is not NoneType]
        one = parts[0] if len(parts) == 1 else str
        return one | None if NoneType in get_args(kind) else one
    return kind
