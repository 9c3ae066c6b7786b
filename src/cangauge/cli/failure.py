"""What `--json` prints of a command that failed: one object too, so that it can be parsed."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from cangauge.cli.output import emit_json


def emit_failure(error: Mapping[str, Any], exit_code: int) -> None:
    """Print `{"error": {…}, "exit_code": …}` on stdout if the command line asks for `--json`.

    Parameters
    ----------
    error : mapping
        As of `CangaugeError.to_dict`.
    exit_code : int
        What the process will exit with.
    """
    if not _json_asked(sys.argv[1:]) or sys.stdout is None:
        return
    try:
        emit_json({"error": error, "exit_code": exit_code})
    except OSError:
        # Nobody reads stdout, or its disk is full. The exit code stays that of the failure, also
        # when Python flushes stdout once more at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _json_asked(arguments: Sequence[str]) -> bool:
    """Whether `--json` is among them: what is wrong may be the very line that says so."""
    options = arguments[: arguments.index("--")] if "--" in arguments else arguments
    return any(word.partition("=")[0] == "--json" for word in options)
