"""How commands speak: results on stdout, everything else on stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from typing import Any

from rich.console import Console

console = Console(stderr=True, highlight=False)
"""For tables, progress and notes: stderr, so that `--json` alone owns stdout."""


def note(text: str) -> None:
    """Print one line on stderr."""
    sys.stderr.write(text.rstrip() + "\n")
    sys.stderr.flush()


def emit_json(result: Mapping[str, Any]) -> None:
    """Print exactly one JSON object on stdout; NaN and infinities become null."""
    plain = _plain(result)
    text = json.dumps(plain, ensure_ascii=False)
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:  # a terminal of few letters, a file name that is no text
        text = json.dumps(plain)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy's, which is not worth importing for --help
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
