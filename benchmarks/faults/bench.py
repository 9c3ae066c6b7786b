"""Test bench: one service on one bus, with the actions that a fault may take."""

from __future__ import annotations

import json
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Final

from cangauge._resources import shared_file
from cangauge.service.state import FILE_NAME
from faults.frames import Profile, initial_soc_pct
from faults.line import BusLine
from faults.process import Process, Target, cangauge

MODEL: Final = "leaf2012_published_model.json"
START_S: Final = 15.0
"""Time until a restarted service publishes; long for an interpreter on a busy or virtual
machine [s]."""
FIRST_START_S: Final = 60.0
"""Time until the first start publishes, on a busy machine [s]."""
RECONNECT_S: Final = 5.0
"""Time until the service uses a bus that is back [s]."""

FLOAT_DBC: Final = """VERSION ""
BU_: Pack
BO_ 1024 PACK: 8 Pack
 SG_ current_a : 0|32@1- (1,0) [-1000|1000] "A" Pack
 SG_ voltage_v : 32|32@1- (1,0) [0|1000] "V" Pack
BO_ 1026 PACK_TEMPERATURE: 4 Pack
 SG_ temperature_c : 0|32@1- (1,0) [-50|100] "degC" Pack
SIG_VALTYPE_ 1024 current_a : 1;
SIG_VALTYPE_ 1024 voltage_v : 1;
SIG_VALTYPE_ 1026 temperature_c : 1;
"""
FLOAT_MAP: Final = """name = "float pack"
temperature_source = "room"
[current]
signal = "current_a"
[voltage]
signal = "voltage_v"
[temperature]
signal = "temperature_c"
timeout_s = 10.0
"""


@dataclass(frozen=True)
class ServiceSetup:
    """Setup of the service.

    Parameters
    ----------
    config : dict
        Configuration keys besides bus and model.
    vehicle : str
        "generic" or "float".
    with_state : bool
        Use a state file.
    target : callable
        The service, or a replacement in tests of the harness.
    """

    config: dict[str, Any]
    vehicle: str = "generic"
    with_state: bool = False
    target: Target = cangauge


class Bench:
    """One service on one bus.

    Parameters
    ----------
    line : BusLine
    profile : Profile
    setup : ServiceSetup
    folder : Path
        Folder of its files.
    rng : Random
        Random generator of the fault.
    """

    def __init__(
        self, line: BusLine, profile: Profile, setup: ServiceSetup, folder: Path, rng: Random
    ) -> None:
        self.line = line
        self.profile = profile
        self.folder = folder
        self.rng = rng
        self.config_path = folder / "run.toml"
        self.state_path = folder / "state" / FILE_NAME
        self.state_path.parent.mkdir()
        self.expected_silence_s: list[tuple[float, float]] = []
        self.incidents: list[str] = []
        self._setup = setup
        self._at_end: list[Callable[[], None]] = []
        self.config: dict[str, Any] = {
            "model": str(shared_file("replay", MODEL)),
            "interface": line.interface,
            "channel": line.channel,
            "bus_options": line.options,
            "time_source": "receive" if profile.is_real_time else "replay-clock",
            "initial_soc": initial_soc_pct(profile),
            **vehicle_config(setup.vehicle, folder),
            **setup.config,
        }
        self.write_config()
        self.service = self.another_service("service", with_state=setup.with_state)
        self.others: list[Process] = []

    def another_service(self, name: str, *, with_state: bool = False) -> Process:
        """Return another service, not started yet."""
        arguments = ["run", "--config", str(self.config_path)]
        if with_state:
            arguments += ["--state", str(self.state_path)]
        return Process(arguments, self.folder / f"{name}.txt", self._setup.target)

    def write_config(self, **changes: object) -> None:
        """Write the configuration with permanent changes."""
        self.config |= changes
        self.config_path.write_text(_toml({k: v for k, v in self.config.items() if v is not None}))

    def start(self) -> None:
        """Start the service."""
        self.service.start()
        self.expect_silence(START_S)

    def restart(self) -> None:
        """Stop the service by SIGTERM and start it again."""
        self.service.stop()
        self.start()

    def reload(self) -> None:
        """Reload the configuration."""
        self.service.signal(signal.SIGHUP)

    def suspend(self) -> None:
        """Suspend the process of the service."""
        self.service.signal(signal.SIGSTOP)
        self.expect_silence(self.profile.seconds)  # shortened by `resume`

    def resume(self) -> None:
        """Resume the process of the service."""
        self.service.signal(signal.SIGCONT)
        first, _ = self.expected_silence_s.pop()
        self.expected_silence_s.append((first, time.monotonic() + 1.0))

    def end(self) -> None:
        """Stop all services and undo all actions."""
        for process in (self.service, *self.others):
            process.stop()
        while self._at_end:
            self._at_end.pop()()

    def at_end(self, undo: Callable[[], None]) -> None:
        """Register what undoes an action at the end."""
        self._at_end.append(undo)

    def expect_silence(self, seconds: float) -> None:
        """Expect no published frames for a time from now [s]."""
        now_s = time.monotonic()
        self.expected_silence_s.append((now_s, now_s + seconds))

    @contextmanager
    def without_bus(self) -> Iterator[None]:
        """Expect no published frames within the block and until the service has reconnected."""
        first = time.monotonic()
        yield
        self.expected_silence_s.append((first, time.monotonic() + RECONNECT_S))

    def wait(self, seconds: float) -> None:
        """Wait for a time of the profile [s]."""
        threading.Event().wait(seconds / self.profile.speed)


def vehicle_config(vehicle: str, folder: Path) -> dict[str, Any]:
    """Return the configuration keys of a vehicle; write the files that it needs."""
    if vehicle == "generic":
        return {"vehicle": "generic"}
    dbc, mapping = folder / "float.dbc", folder / "float.toml"
    dbc.write_text(FLOAT_DBC)
    mapping.write_text(FLOAT_MAP)
    return {"dbc": str(dbc), "map": str(mapping)}


def remove(folder: Path) -> None:
    """Remove a folder with all its files."""
    shutil.rmtree(folder, ignore_errors=True)


def _toml(values: dict[str, Any]) -> str:
    """Return TOML: numbers and texts as in JSON, tables with a header."""
    lines, tables = [], []
    for key, value in values.items():
        if isinstance(value, dict):
            tables.append(f"[{key}]\n" + _toml(value))
        else:
            lines.append(f"{key} = {json.dumps(value)}\n")
    return "".join(lines + tables)
