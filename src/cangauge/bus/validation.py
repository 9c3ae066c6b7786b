"""TOML files checked against pydantic models, with errors that name file, field, value, cure."""

from __future__ import annotations

import tomllib
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError

from cangauge.bus.database import closest
from cangauge.errors import InputError

MAX_TOML_BYTES: Final = 256 * 1024
MAX_DOTS: Final = 200
"""More dots in a line are refused: time and memory that tomllib takes for a key of n parts grow
with n²; 100,000 of them, well below `MAX_TOML_BYTES`, take all the memory there is."""

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    InputError
        If it is absent, too large or not TOML (with line and column).
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(MAX_TOML_BYTES + 1)
    except FileNotFoundError as error:
        raise InputError("no such file", source=path, cure="check the path") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read: {reason}", source=path) from error
    if len(data) > MAX_TOML_BYTES:
        raise InputError(f"larger than {MAX_TOML_BYTES // 1024} kB", source=path)
    for number, line in enumerate(data.splitlines(), start=1):
        if line.count(b".") > MAX_DOTS:
            raise InputError(f"not TOML: line {number} has more than {MAX_DOTS} dots", source=path)
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except ValueError as error:  # TOMLDecodeError, UnicodeDecodeError, an integer of 5,000 digits
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
        raise _as_input_error(error, model, source) from error


def _as_input_error(
    error: ValidationError, model: type[BaseModel], source: str | PathLike[str]
) -> InputError:
    # A misspelt key is reported rather than the missing one that it was meant to be.
    details = sorted(error.errors(), key=lambda each: each["type"] != "extra_forbidden")
    first = details[0]
    field = ".".join(str(part) for part in first["loc"])
    if first["type"] == "missing":
        return InputError("is missing", source=source, field=field, cure="add it")
    if first["type"] == "extra_forbidden":
        keys = _keys_at(model, first["loc"][:-1])
        near = closest(str(first["loc"][-1]), keys)
        known = f"known are {', '.join(sorted(keys))}" if keys else None
        cure = f"did you mean {near}?" if near else known
        return InputError("unknown key", source=source, field=field, cure=cure)
    problem = first["msg"].removeprefix("Value error, ")
    problem = problem[0].lower() + problem[1:]
    value = first["input"]
    shown = value if isinstance(value, str | int | float | bool) else None
    return InputError(problem, source=source, field=field or None, value=shown)


def _keys_at(model: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the model knows at a place, walking down its fields."""
    current: Any = model
    for part in place:
        if not _is_model(current) or part not in current.model_fields:
            return []
        annotation = current.model_fields[str(part)].annotation
        candidates = (annotation, *getattr(annotation, "__args__", ()))
        current = next((each for each in candidates if _is_model(each)), None)
    return list(current.model_fields) if _is_model(current) else []


def _is_model(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)
