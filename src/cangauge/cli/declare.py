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
their unit. An option whose placeholder has suffixes is a file to write with one of them. Where a
number has words beside it, as in `P|auto (0 … 100 %)`, the command gets the number or the word. A
parameter that is a dataclass stands for its fields, `**options` for keys of the configuration of
`cangauge run`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import is_dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Union, get_args, get_origin, get_type_hints

import typer

from cangauge._files import require_suffix
from cangauge.errors import InputError

Command = Callable[..., None]
Keys = Callable[[], list[inspect.Parameter]]
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
        groups: dict[str, tuple[type, list[str]]] = {}
        made: list[inspect.Parameter] = []
        for parameter in _parameters(function):
            kind = parameter.annotation
            if parameter.kind is parameter.VAR_KEYWORD:
                made += [] if keys is None else keys()
            elif isinstance(kind, type) and is_dataclass(kind):
                of_group = [each for each in _parameters(kind) if each.name not in omitted]
                groups[parameter.name] = kind, [each.name for each in of_group]
                made += [each.replace(kind=each.KEYWORD_ONLY) for each in of_group]
            else:
                made.append(parameter)

        def run(**given: Any) -> None:
            for name, (kind, names) in groups.items():
                given[name] = kind(**{each: given.pop(each) for each in names})
            positional = [given.pop(name) for name in arguments]
            function(*positional, **given)

        arguments = [each.name for each in made if each.kind is each.POSITIONAL_OR_KEYWORD]
        run.__doc__ = _SECTION.sub("", inspect.getdoc(function) or "")
        run.__signature__ = inspect.Signature(made)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in made}
        return run

    return decorate


def _entries(section: str) -> dict[str, tuple[str, str]]:
    """Return specification and help by name."""
    return {name: (spec, " ".join(text.split())) for name, spec, text in _ENTRY.findall(section)}


SHARED: Final = _entries("""
model : -m, --model MODEL
    Model file of `cangauge fit`.
chemistry : oxide|lfp
    Chemistry of the cells.
cells : N (1 … 2000)
    Cells in series.
capacity_ah : A (0.001 … 1e5 Ah)
    Charge from 100 to 0 %. Default: the model's.
report : FILE.html|.htm
    Write a report as one self-contained page.
json_output : --json
    Print exactly one JSON object on stdout, also for an error.
""")
"""Parameters that mean the same in several commands: a docstring need not repeat them."""


def _parameters(documented: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the parameters of a function or a dataclass, as typer reads them.

    Dataclasses and `**options` keep their type.
    """
    section = _SECTION.search(inspect.getdoc(documented) or "")
    entries = SHARED | _entries(section[1] if section else "")
    hints = get_type_hints(documented)
    is_group = is_dataclass(documented)
    found = []
    for name, parameter in inspect.signature(documented).parameters.items():
        kind = hints[name]
        if parameter.kind is not parameter.VAR_KEYWORD and not is_dataclass(kind):
            is_option = is_group or parameter.kind is parameter.KEYWORD_ONLY
            kind = _annotated(name, kind, *entries[name], is_option=is_option)
        found.append(parameter.replace(annotation=kind))
    return found


def _annotated(name: str, kind: Any, specification: str, text: str, *, is_option: bool) -> Any:
    """Return the type of a parameter with its option or argument."""
    spec = _SPEC.fullmatch(specification)
    if spec is None:
        raise ValueError(f"{name} : {specification} is no specification")
    options: dict[str, Any] = {"metavar": spec["metavar"] or None, "help": text}
    suffixes = re.findall(r"\.\w+", spec["metavar"]) if is_option else []
    if spec["low"] is not None:
        bounds = f"within {spec['low']} … {spec['high']} {spec['unit'] or ''}".rstrip()
        options["help"] += f" ({bounds})"
    if suffixes or spec["low"] is not None:
        options["callback"] = _checked(spec, suffixes)
    if not is_option:
        return Annotated[_plain(kind), typer.Argument(show_default=False, **options)]
    flags = spec["flags"] or f"--{name.replace('_', '-')}"
    return Annotated[_plain(kind), typer.Option(*flags.split(", "), **options)]


def _checked(spec: re.Match[str], suffixes: list[str]) -> Any:
    """Return the callback that checks suffix or bounds, and makes numbers of text."""
    words = [word for word in spec["metavar"].split("|") if word.islower()]
    unit = spec["unit"] or ""

    def check(param: typer.CallbackParam, value: Any) -> Any:
        if isinstance(value, list):
            return [check(param, each) for each in value]
        if value is None or value in words:
            return value
        option = param.opts[-1]
        if suffixes:
            require_suffix(value, *suffixes, field=option)
            return value
        try:
            number = float(value) if isinstance(value, str) else value
        except ValueError as error:
            word, of = " or ".join(words), f" of {unit}" if unit else ""
            problem, cure = f"neither a number nor {word}", f"give a number{of}, or {word}"
            raise InputError(problem, field=option, value=value, cure=cure) from error
        low, high = float(spec["low"]), float(spec["high"])
        if not low <= number <= high:  # NaN too
            problem = f"must lie within {low:g} … {high:g} {unit}".rstrip()
            raise InputError(problem, field=option, value=number)
        return number

    return check


def _plain(kind: Any) -> Any:
    """Return the type that typer reads: text where a number or a word may stand."""
    if get_origin(kind) is list:
        return list[_plain(get_args(kind)[0])]  # type: ignore[misc]
    if get_origin(kind) not in {Union, UnionType}:
        return kind
    parts = [_plain(part) for part in get_args(kind) if part is not NoneType]
    one = parts[0] if len(parts) == 1 else str
    return one | None if NoneType in get_args(kind) else one
