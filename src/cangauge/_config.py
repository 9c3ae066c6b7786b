"""Read TOML files, and check data against pydantic models with errors in one line."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections.abc import Iterator
from os import PathLike
from typing import Any, Final, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ValidationError

from cangauge._files import read_bounded
from cangauge.errors import InputError, closest, in_our_words, located

MAX_TOML_BYTES: Final = 64 * 1024
_LONG_KEY: Final = re.compile(rb"""(?<![\w"'.-])(?:["']?[\w-]+["']?[ \t]*\.[ \t]*){200}""")
_UNION_TAGS: Final = {"bool", "int", "float", "str", "constrained-int", "constrained-float"}
_UNKNOWN_KEY: Final = {"extra_forbidden", "unexpected_keyword_argument"}  # of models, dataclasses

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    InputError
        If it is absent, too large or not TOML (with line and column).
    """
    data = read_bounded(path, MAX_TOML_BYTES, "a TOML file")
    if _LONG_KEY.search(data):  # tomllib's time grows with the square of the parts
        raise InputError("a key has hundreds of parts", source=path, cure="check the file")
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # ValueError: also not UTF-8
        problem = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise InputError(f"not TOML: {problem}", source=path) from error


def validated(model: type[Model], data: object, source: str | PathLike[str]) -> Model:
    """Check `data` against a model; raise InputError for the first error (see `schema_error`)."""
    with located(source):  # an error of a table that compares its values
        try:
            return model.model_validate(data)
        except ValidationError as error:
            raise schema_error(error, model, source) from error


def schema_error(
    error: ValidationError,
    model: type[BaseModel],
    source: str | PathLike[str],
    cure: str | None = None,
) -> InputError:
    """Return the first validation error of a schema's data, with file, field, value and cure.

    An unknown key comes before a missing one: it is often that key, misspelt. `cure` is general
    advice, for errors without a better one.
    """
    errors = error.errors(include_url=False)
    first = next((each for each in errors if each["type"] in _UNKNOWN_KEY), errors[0])
    place = list(first["loc"])
    while len(place) > 1 and place[-1] in _UNION_TAGS:  # pydantic names the member of a union
        place.pop()
    problem = first["msg"]
    value = first["input"]
    if first["type"] == "missing":
        problem = "is missing"
        value = None
        cure = cure or "add it"
    elif first["type"] in _UNKNOWN_KEY:
        problem = "unknown key"
        value = None
        keys = _known_keys(model, place[:-1])
        near = closest(str(place[-1]), keys)
        cure = f"did you mean {near}?" if near else f"known are {', '.join(sorted(keys))}"
    elif first["type"] in {"model_type", "model_attributes_type", "dict_type", "dataclass_type"}:
        problem = "must be a table"
    else:
        problem = in_our_words(problem)
        problem = problem[0].lower() + problem[1:]
    return InputError(
        problem,
        source=source,
        field=".".join(map(str, place)) or None,
        value=value if isinstance(value, str | int | float | bool) else None,
        cure=cure,
    )


def _known_keys(model: type[BaseModel], place: list[int | str]) -> list[str]:
    """Return the keys that the schema allows at a place; list indices and dict keys are skipped."""
    owners: list[Any] = [model]
    for part in place:
        inner = [
            each
            for owner in owners
            if part in _fields(owner)
            for each in _models_in(_fields(owner)[str(part)])
        ]
        owners = inner or owners
    return list(dict.fromkeys(key for owner in owners for key in _fields(owner)))


def _fields(owner: Any) -> dict[str, Any]:
    """Return the annotations of a model or a dataclass by field."""
    if dataclasses.is_dataclass(owner):
        hints = get_type_hints(owner)
        return {field.name: hints[field.name] for field in dataclasses.fields(owner)}
    return {name: field.annotation for name, field in owner.__pydantic_fields__.items()}


def _models_in(annotation: Any) -> Iterator[Any]:
    """Yield the models and dataclasses of an annotation."""
    if isinstance(annotation, type) and (
        hasattr(annotation, "__pydantic_fields__") or dataclasses.is_dataclass(annotation)
    ):
        yield annotation
    for part in get_args(annotation):
        yield from _models_in(part)
