"""What pydantic found wrong with a file → one line in our own words.

TOML files checked against pydantic models, with errors that name file, field, value, cure.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterator
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Final, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from cangauge._io import MAX_TOML_BYTES, MAX_TOML_KEY, read_bounded
from cangauge.errors import InputError, closest

# --- What pydantic found wrong with a file → one line in our own words

_Detail = Any  # pydantic_core.ErrorDetails, a TypedDict

_BOUNDS: Final = ("gt", "ge", "lt", "le")
_KINDS: Final = {
    "float": "a number",
    "int": "a whole number",
    "string": "a text",
    "bool": "true or false",
    "list": "a list",
    "tuple": "a list",
    "dict": "a table",
    "model": "a table",
}
_FIXED: Final = {
    **{
        f"{kind}_{how}": f"must be {what}"
        for kind, what in _KINDS.items()
        for how in ("type", "parsing")
    },
    "finite_number": "must be a finite number",
    "int_from_float": "must be a whole number",
    "int_parsing_size": "must be a whole number of a usual size",
}
"""By pydantic's name of the error."""
_UNION_TAGS: Final = {"bool", "int", "float", "str", "constrained-int", "constrained-float"}


def schema_error(
    error: ValidationError,
    model: type[BaseModel],
    source: str | PathLike[str],
    cure: str | None = None,
) -> InputError:
    """Return the error for the first thing that is wrong: file, field, value and cure.

    A misspelt key is told rather than the missing one that it was meant to be.

    Parameters
    ----------
    error : pydantic.ValidationError
    model : type of BaseModel
        What the data were checked against.
    source : path-like
    cure : str, optional
        Where nothing better is known.
    """
    details = sorted(
        error.errors(include_url=False), key=lambda each: each["type"] != "extra_forbidden"
    )
    first = details[0]
    place = _place(first["loc"])
    field = ".".join(map(str, place)) or None
    kind, value = first["type"], first["input"]
    if kind == "missing":
        return InputError("is missing", source=source, field=field, cure=cure or "add it")
    if kind == "extra_forbidden":
        keys = _keys_at(model, place[:-1])
        near = closest(str(place[-1]), keys)
        known = f"known are {', '.join(sorted(keys))}" if keys else cure
        return InputError(
            "unknown key",
            source=source,
            field=field,
            cure=f"did you mean {near}?" if near else known,
        )
    shown = value if isinstance(value, str | int | float | bool) else None
    return InputError(
        _problem(first, model, place), source=source, field=field, value=shown, cure=cure
    )


def _problem(detail: _Detail, model: type[BaseModel], place: tuple[int | str, ...]) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    fixed = _FIXED.get(kind)
    if fixed is not None:
        return fixed
    if kind in {"greater_than", "greater_than_equal", "less_than", "less_than_equal"}:
        return _outside(_bounds_at(model, place) | {k: context[k] for k in _BOUNDS if k in context})
    if kind in {"too_long", "too_short"}:
        least, most = context.get("min_length"), context.get("max_length")
        return f"must have at least {least}" if most is None else f"must have at most {most} items"
    if kind == "literal_error":
        return f"must be {context['expected']}"
    text: str = detail["msg"].removeprefix("Value error, ")
    return text[0].lower() + text[1:]


def _outside(bounds: dict[str, Any]) -> str:
    low, high = bounds.get("ge"), bounds.get("le")
    if low is not None and high is not None:
        return f"must lie within {low:g} … {high:g}"
    words = {"gt": "more than", "ge": "at least", "lt": "less than", "le": "at most"}
    told = [f"{words[name]} {bounds[name]:g}" for name in _BOUNDS if name in bounds]
    return f"must be {' and '.join(told)}"


def _place(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """Return where, without the names that pydantic adds for the members of a union."""
    while len(loc) > 1 and loc[-1] in _UNION_TAGS:
        loc = loc[:-1]
    return loc


def _bounds_at(model: type[BaseModel], place: tuple[int | str, ...]) -> dict[str, Any]:
    """Return all bounds of a number at a place: pydantic names only the one that was left."""
    owner = _walk(model, place[:-1])
    if not (_is_model(owner) and place[-1] in owner.model_fields):
        return {}
    field = owner.model_fields[str(place[-1])]
    found: dict[str, Any] = {}
    for part in (*field.metadata, *_metadata(field.annotation)):
        for name in _BOUNDS:
            value = getattr(part, name, None)
            if isinstance(value, int | float):
                found[name] = value
    return found


def _metadata(annotation: Any) -> Iterator[Any]:
    for part in get_args(annotation):
        if get_origin(annotation) is Annotated and part is not get_args(annotation)[0]:
            yield part
            yield from getattr(part, "metadata", ())
        else:
            yield from _metadata(part)


def _keys_at(model: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the model knows at a place."""
    owner = _walk(model, place)
    return list(owner.model_fields) if _is_model(owner) else []


def _walk(model: type[BaseModel], place: tuple[int | str, ...]) -> Any:
    """Return what is expected at a place: walks down fields, tables and lists."""
    current: Any = model
    for part in place:
        if _is_model(current):
            if part not in current.model_fields:
                return None
            current = current.model_fields[str(part)].annotation
        else:
            # A table's key or a list's index: what they hold is the last argument.
            inner = [each for each in get_args(current) if each is not Ellipsis]
            current = inner[-1] if inner else None
        current = _plain(current, _is_model)
    return current


def _plain(annotation: Any, wanted: Callable[[Any], bool]) -> Any:
    """Return the member of an optional or annotated type that can be walked into."""
    if get_origin(annotation) in {Union, UnionType, Annotated}:
        members = [each for each in get_args(annotation) if each is not type(None)]
        return next((each for each in members if wanted(each)), members[0])
    return annotation


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


# --- TOML files checked against pydantic models, with errors that name file, field, value, cure

_KEY_PART: Final = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+"""
_LONG_KEY: Final = re.compile(rf"(?<![\w-])(?:{_KEY_PART}){{{MAX_TOML_KEY}}}")

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    InputError
        If it is absent, too large or not TOML (with line and column).
    """
    path = Path(path)
    data = read_bounded(path, MAX_TOML_BYTES, "a TOML file")
    try:
        text = data.decode("utf-8-sig")
        if _LONG_KEY.search(text):
            raise ValueError(f"a key of more than {MAX_TOML_KEY} parts")  # noqa: TRY301 - as tomllib
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError; what is not UTF-8; numbers of 5,000 digits
        raise InputError(f"not TOML: {error}", source=path) from error
    except RecursionError as error:
        raise InputError("not TOML: nested too deeply", source=path) from error


def validated(model: type[Model], data: object, source: str | PathLike[str]) -> Model:
    """Return `data` as a model.

    Raises
    ------
    InputError
        For the first thing that is wrong: a missing or unknown key, a wrong type, a bad value.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise schema_error(error, model, source) from error
