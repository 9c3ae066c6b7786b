"""One service on one line, in a folder of its own, and what a fault may do to it."""

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
from faults.drive import Profile, initial_soc_pct
from faults.line import Line
from faults.process import Process, Target, cangauge

MODEL: Final = "leaf2012_published_model.json"
START_S: Final = 15.0
"""How long a service may take until it publishes; a guest's or a busy machine's interpreter takes
long to start [s]."""
FIRST_START_S: Final = 60.0
"""How long the first start may take, on a machine that does other things too [s]."""
RECONNECT_S: Final = 5.0
"""How long it may take until it uses a bus that is back [s]."""

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
class Setting:
    """How the service is started.

    Parameters
    ----------
    config : dict
        Keys of its configuration besides bus and model.
    vehicle : str
        "generic" or "float".
    with_state : bool
        Give it a state file.
    cold : bool
        Start it in a fresh interpreter.
    target : callable
        The service, or what stands for it in tests of the harness.
    """

    config: dict[str, Any]
    vehicle: str = "generic"
    with_state: bool = False
    cold: bool = False
    target: Target = cangauge


class Stage:
    """One service on one line.

    Parameters
    ----------
    line : Line
    profile : Profile
    setting : Setting
    folder : Path
        For its files; removed by whoever made it.
    rng : Random
        For what a fault chooses at random.
    """

    def __init__(
        self, line: Line, profile: Profile, setting: Setting, folder: Path, rng: Random
    ) -> None:
        self.line = line
        self.profile = profile
        self.folder = folder
        self.rng = rng
        self.config_path = folder / "run.toml"
        self.state_path = folder / "state" / "soc.state"
        self.state_path.parent.mkdir()
        self.excused: list[tuple[float, float]] = []
        self.troubles: list[str] = []
        self._setting = setting
        self._at_end: list[Callable[[], None]] = []
        self.config: dict[str, Any] = {
            "model": str(shared_file("replay", MODEL)),
            "interface": line.interface,
            "channel": line.channel,
            "bus_options": line.options,
            "time_source": "receive" if profile.is_real_time else "replay-clock",
            "initial_soc": initial_soc_pct(profile),
            **vehicle_config(setting.vehicle, folder),
            **setting.config,
        }
        self.write_config()
        self.service = self.another_service("service", with_state=setting.with_state)
        self.others: list[Process] = []

    # --- service --------------------------------------------------------------------------

    def another_service(self, name: str, *, with_state: bool = False) -> Process:
        """Return a service that is not started yet."""
        arguments = ["run", "--config", str(self.config_path)]
        if with_state:
            arguments += ["--state", str(self.state_path)]
        log, setting = self.folder / f"{name}.txt", self._setting
        return Process(arguments, log, setting.target, cold=setting.cold)

    def write_config(self, **changes: object) -> None:
        """Write the configuration, with changes that last."""
        self.config |= changes
        self.config_path.write_text(_toml({k: v for k, v in self.config.items() if v is not None}))

    def start(self) -> None:
        """Start the service; it may need time."""
        self.service.start()
        self.excuse(START_S)

    def restart(self) -> None:
        """End the service by SIGTERM and start it again at once."""
        self.service.stop()
        self.start()

    def kill_and_restart(self) -> None:
        """End the service by SIGKILL and start it again at once."""
        self.service.kill()
        self.start()

    def reload(self) -> None:
        """Tell the service to read its configuration again."""
        self.service.signal(signal.SIGHUP)

    def pause(self) -> None:
        """Stop the service's process for the time being."""
        self.service.signal(signal.SIGSTOP)
        self.excuse(self.profile.seconds)  # shortened by `go_on`

    def go_on(self) -> None:
        """Let it go on."""
        self.service.signal(signal.SIGCONT)
        first, _ = self.excused.pop()
        self.excused.append((first, time.monotonic() + 1.0))

    def end(self) -> None:
        """End everything."""
        for process in (self.service, *self.others):
            process.stop()
        while self._at_end:
            self._at_end.pop()()

    def at_end(self, undo: Callable[[], None]) -> None:
        """Have something undone at the end."""
        self._at_end.append(undo)

    def excuse(self, seconds: float) -> None:
        """Expect no frames for so long from now."""
        now_s = time.monotonic()
        self.excused.append((now_s, now_s + seconds))

    # --- bus ------------------------------------------------------------------------------

    @contextmanager
    def without_bus(self) -> Iterator[None]:
        """Expect no frames within the block, and until the service is back after it."""
        first = time.monotonic()
        yield
        self.excused.append((first, time.monotonic() + RECONNECT_S))

    def wait(self, seconds: float) -> None:
        """Wait, in time of the profile."""
        threading.Event().wait(seconds / self.profile.speed)


def vehicle_config(vehicle: str, folder: Path) -> dict[str, Any]:
    """Return the configuration's keys for a vehicle, writing the files that it needs."""
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
    """Return TOML; JSON's numbers, texts and flat tables are TOML's, but for the table's form."""
    lines, tables = [], []
    for key, value in values.items():
        if isinstance(value, dict):
            tables.append(f"[{key}]\n" + _toml(value))
        else:
            lines.append(f"{key} = {json.dumps(value)}\n")
    return "".join(lines + tables)
