"""Diagnosing process: its only inputs are logs, a model and requests.

`python -m cangauge.extras.validation.worker` reads one request a line (JSON) from stdin and writes
one answer a line to stdout:

    {"model": PATH, "logs": [PATH…], "references": [PATH…], "leave_out": [EFFECT…],
     "extended": PATH or null}

    {"seconds": s, "peak_mib": MiB or null, "result": {"gap": …, "cause": …, "ceiling": …}}
    or  {"error": text}

It diagnoses as `cangauge gap` does and returns the part of its JSON that is scored.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

from cangauge.diagnosis import diagnose
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model

_SCORED = ("gap", "cause", "ceiling")


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Return the diagnosis of one request, or its error."""
    _reset_peak_memory()
    began = time.perf_counter()
    try:
        model = Model.load(Path(request["model"]))
        found = diagnose(
            [read_log(Path(path)) for path in request["logs"]],
            model,
            [read_log(Path(path)) for path in request["references"]],
            leave_out=request.get("leave_out", ()),
        )
        if request.get("extended") is not None:
            found.extended_model.save(Path(request["extended"]))
        whole = found.to_dict(request.get("extended"), soc_error=False)
    except Exception as error:  # noqa: BLE001 - a crash counts as a wrong answer
        return {
            "error": f"{type(error).__name__}: {error}",
            "where": traceback.format_exc(limit=-4),
            "seconds": time.perf_counter() - began,
        }
    return {
        "seconds": time.perf_counter() - began,
        "peak_mib": _peak_mib(),
        "result": {key: whole[key] for key in _SCORED},
    }


def _reset_peak_memory() -> None:
    """Reset the peak memory of the process (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _peak_mib() -> float | None:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024.0
    return None


def main() -> None:
    """Answer requests from stdin until it ends; other output goes to stderr."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    for line in sys.stdin:
        answers.write(json.dumps(answer(json.loads(line))) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
