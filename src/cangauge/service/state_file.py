"""The state file: what the service remembers over a restart. JSON, versioned, with its own hash.

    {"format": "cangauge-state", "version": 1, "sha256": "…", "content": {…}}

The hash is that of the content, written without spaces and with sorted keys. Nothing is believed
before it is checked: size, JSON, format, version, hash, then every field's type and range.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cangauge.errors import InputError
from cangauge.estimate.state import EstimatorState
from cangauge.model.model_file import ModelFile, model_json

STATE_FORMAT: Final = "cangauge-state"
STATE_VERSION: Final = 1
"""To be raised with every change of what an estimator remembers."""

LARGEST_BYTES: Final = 8 << 20
"""A delay line at its fullest takes 0.3 MB."""

Hash = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class StateContent(BaseModel):
    """What the file holds, besides its own hash."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    saved_s: Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
    """Unix time at which it was taken [s]."""
    boot_id: Annotated[str, Field(max_length=64)] | None
    """Which start of the machine it belongs to; None where the system does not tell."""
    model: Hash
    """Fingerprint of the model."""
    model_name: Annotated[str, Field(max_length=200)]
    time_source: Annotated[str, Field(max_length=32)]
    estimator: EstimatorState


def model_fingerprint(model: ModelFile) -> str:
    """Return a hash of all that a model says."""
    return hashlib.sha256(model_json(model).encode()).hexdigest()


def state_text(content: StateContent) -> str:
    """Return the file's text."""
    text = _canonical(content.model_dump(mode="json"))
    head = {"format": STATE_FORMAT, "version": STATE_VERSION, "sha256": _hash(text)}
    return f'{json.dumps(head)[:-1]}, "content": {text}}}\n'


def read_state(path: Path) -> StateContent:
    """Read and check a state file.

    Raises
    ------
    FileNotFoundError
        If there is none.
    InputError
        If it cannot be read, is damaged, or is of another version; one line with the reason.
    """
    data = _parsed(_bytes(path), path)
    if not isinstance(data, dict) or data.get("format") != STATE_FORMAT:
        raise InputError("is no cangauge state", source=path, field="format")
    if data.get("version") != STATE_VERSION:
        raise InputError(
            f"this release keeps version {STATE_VERSION}",
            source=path,
            field="version",
            value=_shown(data.get("version")),
        )
    content = data.get("content")
    if not isinstance(content, dict) or data.get("sha256") != _content_hash(content):
        raise InputError("damaged: its content is not what was written", source=path,
                         field="sha256")  # fmt: skip
    try:
        return StateContent.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            first["msg"].removeprefix("Value error, "),
            source=path,
            field="content." + ".".join(str(part) for part in first["loc"]),
            value=_shown(first["input"]),
        ) from error


def boot_id() -> str | None:
    """Return which start of the machine this is; None where the system does not tell."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()[:64]
    except (OSError, ValueError):
        return None


def _bytes(path: Path) -> bytes:
    try:
        # A pipe or device could keep the service waiting for ever.
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError("is no regular file", source=path)
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size > LARGEST_BYTES:
                raise InputError(f"larger than {LARGEST_BYTES >> 20} MB", source=path)
            return file.read(LARGEST_BYTES + 1)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", source=path) from error


def _parsed(raw: bytes, path: Path) -> object:
    try:
        # Decoded here: of bytes, `json` would also take UTF-16 and UTF-32, which is never written.
        return json.loads(raw.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]
        raise InputError(f"is no JSON: {reason}", source=path) from error


def _canonical(content: dict[str, Any]) -> str:
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _content_hash(content: dict[str, Any]) -> str:
    try:
        return _hash(_canonical(content))
    except (ValueError, RecursionError):  # 1e999 is read as infinity, which no hash is made of
        return ""


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number that a state may hold")


def _shown(value: object) -> str | int | float | None:
    if isinstance(value, str):
        return value[:60]
    return value if isinstance(value, int | float) and abs(value) < 1e15 else None
