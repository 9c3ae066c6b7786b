"""The sealed file: every cause in one file whose hash is shown before the diagnosis starts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from cangauge.atomic import write_text_atomic
from cangauge.errors import InputError

LABELS: Final = "labels.json"
SCHEMA: Final = 1


def seal(labels: Sequence[dict[str, Any]], folder: Path) -> str:
    """Write all causes and return the file's SHA-256.

    Parameters
    ----------
    labels : sequence of dict
        Each with the `name` of its case.
    folder : Path
        One that the diagnosis is not told of.
    """
    ordered = sorted(labels, key=lambda label: label["name"])
    path = folder / LABELS
    write_text_atomic(path, json.dumps({"schema": SCHEMA, "labels": ordered}, indent=1) + "\n")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def unseal(folder: Path, sha256: str) -> dict[str, dict[str, Any]]:
    """Return the causes by the name of their case; for the scorer alone.

    Parameters
    ----------
    folder : Path
    sha256 : str
        What was shown before the diagnosis started.

    Raises
    ------
    InputError
        If the file is not the one that was sealed.
    """
    path = folder / LABELS
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"the sealed file cannot be read: {error.strerror}", source=path
        ) from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise InputError(
            "the sealed file is not the one whose hash was shown before the diagnosis",
            source=path,
            value=found,
            cure="draw the cases anew",
        )
    whole = json.loads(content)
    return {label["name"]: label for label in whole["labels"]}
