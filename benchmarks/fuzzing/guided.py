"""Coverage-guided fuzzing by atheris (optional: `pip install atheris`)."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

from fuzzing.mutate import mutate
from fuzzing.target import Target, attempt

SEEDS = 200


def guided(target: Target, seconds: float) -> int:
    """Fuzz one target for a time [s], guided by the coverage of cangauge.

    atheris ends the process: with exit status 0 without a finding, else with a traceback and the
    input saved as `crash-…` in the working directory.
    """
    try:
        import atheris  # noqa: PLC0415 - optional, and not for every Python
    except ModuleNotFoundError:
        sys.stderr.write("error: atheris is not installed here; pip install atheris\n")
        return 2
    _instrument(atheris.instrument_func)

    def one(data: bytes) -> None:
        attempt(target, data)

    def mutator(data: bytes, max_size: int, seed: int) -> bytes:
        rng = Random(seed)  # noqa: S311 - no secret
        if rng.randrange(3) == 0:
            return bytes(atheris.Mutate(data, max_size))
        return mutate(rng, data, text=b"\x00" not in data[:64])[:max_size]

    with tempfile.TemporaryDirectory() as folder:
        for number in range(SEEDS):
            path = Path(folder) / str(number)
            path.write_bytes(target.make(Random(number)))  # noqa: S311 - no secret
        for name, data in (target.seeds() if target.seeds else {}).items():
            (Path(folder) / name).write_bytes(data)
        arguments = [sys.argv[0], folder, f"-max_total_time={seconds:.0f}", "-max_len=20000",
                     "-timeout=20", "-rss_limit_mb=2048"]  # fmt: skip
        atheris.Setup(arguments, one, custom_mutator=mutator)
        atheris.Fuzz()
    return 0


def _instrument(instrument: Callable[[Any], object]) -> None:
    """Instrument every imported function of cangauge."""
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] != "cangauge":
            continue
        own = [each for each in vars(module).values() if getattr(each, "__module__", "") == name]
        methods = [each for kind in own if isinstance(kind, type) for each in vars(kind).values()]
        for function in own + methods:
            if hasattr(function, "__code__"):
                instrument(function)
