"""The process that diagnoses: gets logs, model and a request, knows nothing else.

`python -m cangauge.validation.worker` reads one request a line (JSON) from stdin and writes one
answer a line to stdout:

    {"model": PATH, "logs": [PATH…], "references": [PATH…], "leave_out": [EFFECT…],
     "extended": PATH or null}

    {"seconds": s, "peak_mib": MiB or null, "result": {"gap": …, "cause": …}}  or  {"error": text}

It calls what `cangauge gap` calls, and keeps of its JSON what is scored.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from cangauge._io import write_text_atomic
from cangauge.diagnosis import diagnose
from cangauge.logs.read import read_log
from cangauge.model.model_file import load_model, model_json

SCORED = ("gap", "cause")


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Return the diagnosis of one request, or why there is none."""
    _forget_peak()
    began = time.perf_counter()
    try:
        model = load_model(Path(request["model"]))
        found = diagnose(
            [read_log(Path(path)) for path in request["logs"]],
            model,
            [read_log(Path(path)) for path in request["references"]],
            leave_out=request.get("leave_out", ()),
        )
        if request.get("extended") is not None:
            write_text_atomic(Path(request["extended"]), model_json(found.extended_model))
        whole = found.to_dict(request.get("extended"), soc_error=False)
    except Exception as error:  # noqa: BLE001 - a case that crashes counts as wrong; the next goes on
        return {
            "error": f"{type(error).__name__}: {error}",
            "where": traceback.format_exc(limit=-4),
            "seconds": time.perf_counter() - began,
        }
    return {
        "seconds": time.perf_counter() - began,
        "peak_mib": _peak_mib(),
        "result": {key: whole[key] for key in SCORED},
    }


def serve(requests: TextIO, answers: TextIO) -> None:
    """Answer every line until the input ends."""
    for line in requests:
        answers.write(json.dumps(answer(json.loads(line))) + "\n")
        answers.flush()


def _forget_peak() -> None:
    """Let the peak of the memory start anew, where the system can (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _peak_mib() -> float | None:
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024.0
    return None


def main() -> None:
    """Serve stdin; whatever else is printed goes to stderr."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    serve(sys.stdin, answers)


if __name__ == "__main__":
    main()
