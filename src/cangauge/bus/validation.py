"""TOML files checked against pydantic models, with errors that name file, field, value, cure."""

from __future__ import annotations

import re
import tomllib
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError

from cangauge.errors import InputError
from cangauge.files import read_bounded
from cangauge.limits import MAX_TOML_BYTES, MAX_TOML_KEY
from cangauge.schema import schema_error

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
