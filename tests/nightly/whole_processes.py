"""A service as a process, for the tests that kill, stop and starve it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import pytest

from cangauge.bus.open import BusAddress
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.state import StateKeeper, read_state
from cangauge.types import Status
from live import COMMAND, PATIENCE_S, leaf_model, leaf_model_path, short_log

SEEDS = 20
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="root mounts")
YEAR_S = 365.0 * 86400.0
VEHICLE, MODEL = Vehicle.load("generic"), leaf_model()
DRIVE = list(samples_of(short_log(2000.0, 1.0)))
SHIFT = (
    "import time; was = time.time; time.time = lambda: was() + {};"
    "import cangauge.service.state; time.time = was;"
)
"""Code that sets the clock off by which the age of a state is told [s]; the kernel's is right."""
LIMIT = "import resource; resource.setrlimit(resource.RLIMIT_AS, ({0}, {0}));"
"""Code that limits the address space of a process [bytes]. With 180 MB OpenBLAS tried for ever to
allocate its buffers while it was loaded: no line of ours runs then."""


class Life:
    """A service on a bus, from its start to its end."""

    def __init__(
        self,
        address: BusAddress,
        folder: Path,
        *,
        code: str = "",
        **keys: str,
    ) -> None:
        options = ", ".join(f"{name} = {value}" for name, value in address.options.items())
        given = {
            "model": f'"{leaf_model_path()}"',
            "interface": f'"{address.interface}"',
            "channel": f'"{address.channel}"',
            "bus_options": f"{{ {options} }}",
            "state": '"FOLDER/cangauge-state.json"',
            "state_every_s": "1.0",
            "status_socket": '"off"',
        } | keys
        folder.mkdir(exist_ok=True)
        self.config = folder.parent / f"{folder.name}.toml"
        lines = [f"{key} = {value}\n" for key, value in given.items()]
        # Beside the folder, which may be full.
        self.config.write_text("".join(lines).replace("FOLDER", str(folder)))
        self.log = folder.parent / f"{folder.name}.txt"
        with self.log.open("ab") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code + COMMAND, "run", "--config", str(self.config)],
                stderr=stderr,
                stdout=subprocess.DEVNULL,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def text(self) -> str:
        return self.log.read_text(errors="replace")

    def end(self, kind: int = signal.SIGTERM) -> int:
        self.process.send_signal(kind)
        return self.process.wait(PATIENCE_S)


def clean(text: str) -> bool:
    return "Traceback" not in text and "duplicate_sender" not in text


def errors(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("error: ")]


def write_state(path: Path, address: BusAddress, seed: int) -> None:
    """Write the state of a drive that has ended now, from which a SoC is valid at once."""
    seconds = 150 + 10 * seed
    began_s = time.time() - seconds
    settings = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0, initial_soc_std_pct=0.5))
    pipeline, encoder = Pipeline(VEHICLE, MODEL, settings), FrameEncoder(VEHICLE)
    path.parent.mkdir(exist_ok=True)
    keeper = StateKeeper(path, pipeline, str(address), 86400.0)
    keeper.__enter__()
    for sample in DRIVE[:seconds]:
        for frame in encoder.encode(sample._replace(time_s=sample.time_s + began_s), 60.0):
            pipeline.handle(frame)
    assert pipeline.latest.status == Status.VALID
    keeper.__exit__()


@contextmanager
def full_disk(folder: Path, size_kb: int) -> Iterator[Callable[[], object]]:
    """Mount a small disk; yield what makes it large."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "x", folder], check=True)
    try:
        yield lambda: subprocess.run(["mount", "-o", "remount,size=20000k", folder], check=True)
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def saved_s(folder: Path) -> float:
    """Return when the state of a folder was saved, 0 if there is none."""
    state = folder / "cangauge-state.json"
    return read_state(state).saved_s if state.exists() else 0.0
