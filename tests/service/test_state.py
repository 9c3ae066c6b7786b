"""The state file: restarts, refused files, failing disks."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import pytest

from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service import state as state_file
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.state import FILE_NAME, STATE_VERSION, StateKeeper, read_state, state_path
from cangauge.types import Estimate, Reason, Sample, Status
from live import LoggedLines, leaf_model, short_log, waits

MODEL = leaf_model()
VEHICLE = Vehicle.load("generic")
EPOCH_S = 1_700_000_000.0
KNOWN = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
DRIVE = [each._replace(time_s=each.time_s + EPOCH_S) for each in samples_of(short_log(200.0))]


@dataclass
class Machine:
    """Services one after another on the same file; `start` begins the next one."""

    path: Path
    wall_s: float = EPOCH_S
    model: Model = MODEL
    settings: PipelineSettings = KNOWN
    bus: str = "virtual x"
    logged: LoggedLines = field(default_factory=lambda: LoggedLines("cangauge.service.state"))

    def start(self) -> Self:
        self.logged.__exit__()
        self.logged = LoggedLines("cangauge.service.state").__enter__()
        self.encoder = FrameEncoder(VEHICLE)
        self.pipeline = Pipeline(VEHICLE, self.model, self.settings)
        clock = lambda: self.wall_s  # noqa: E731
        self.keeper = StateKeeper(self.path, self.pipeline, self.bus, 86400.0, wall_s=clock)
        self.keeper.__enter__()
        return self

    def drive(self, samples: Iterable[Sample]) -> list[Estimate]:
        found: list[Estimate] = []
        for sample in samples:
            handled = map(self.pipeline.handle, self.encoder.encode(sample))
            found += [self.pipeline.latest for is_complete in handled if is_complete]
            self.wall_s = max(self.wall_s, sample.time_s)
        return found

    def stop(self) -> None:
        self.keeper.__exit__()

    @property
    def text(self) -> str:
        return "\n".join(self.logged.lines)


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the last write its time: how long it may take is one test's subject."""
    monkeypatch.setattr(state_file, "CLOSE_WITHIN_S", 60.0)


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    machine = Machine(tmp_path / FILE_NAME)
    yield machine
    machine.logged.__exit__()


def kept(machine: Machine, samples: int = 1000) -> list[Estimate]:
    """Let a service drive and end; return its estimates."""
    found = machine.start().drive(DRIVE[:samples])
    machine.stop()
    return found


def rewritten(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a state's content, its hash being right again."""
    content = json.loads(path.read_text())["content"]
    change(content)
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    digest = hashlib.sha256(text.encode()).hexdigest()
    head = {"format": "cangauge-state", "version": STATE_VERSION, "sha256": digest}
    path.write_text(json.dumps({**head, "content": content}))


def numbers(estimates: list[Estimate]) -> list[Any]:
    """What must agree bit for bit; signal health does not outlive the service."""
    return [(*each[:7], each.samples) for each in estimates]


def test_a_restart_at_once_is_no_restart(machine: Machine) -> None:
    whole = Machine(machine.path.with_name("other.json")).start().drive(DRIVE)
    first = kept(machine, 1003)
    json.loads(machine.path.read_text(), parse_constant=pytest.fail)  # no NaN: plain JSON
    machine.start()
    assert machine.keeper.restored
    assert "continuing from" in machine.text
    latest = machine.pipeline.latest  # stale until the first sample
    assert (latest.soc_pct, latest.status) == (first[-1].soc_pct, Status.INVALID)
    assert latest.reasons & Reason.INPUT_STALE
    again = machine.drive(DRIVE[1003:])
    assert repr(numbers(first + again)) == repr(numbers(whole))
    assert again[-1] == whole[-1]


def test_the_state_is_written_only_after_new_samples(machine: Machine) -> None:
    machine.start().keeper.checkpoint()
    machine.drive(DRIVE[:50])
    assert not machine.path.exists()
    machine.keeper.checkpoint()
    assert waits(machine.path.exists)
    first = machine.path.read_bytes()
    machine.wall_s += 3600.0
    machine.stop()
    assert machine.path.read_bytes() == first
    assert read_state(machine.path).estimator.soc_pct == machine.pipeline.latest.soc_pct


@pytest.mark.parametrize(
    ("clock_s", "stamps_s"),
    [(3600.0, 0.0), (-86400.0, 0.0), (3600.0, -EPOCH_S), (5.0, 1e8)],
    ids=["stood", "set back", "from zero after an hour", "far ahead"],
)
def test_stamps_of_another_clock_after_a_restart(
    machine: Machine, clock_s: float, stamps_s: float
) -> None:
    last = kept(machine)[-1]
    machine.wall_s += clock_s
    machine.start()
    # Written in the future, by a clock that is wrong now or was then.
    assert ("of unknown age" in machine.text) is (clock_s < 0.0)
    found = machine.drive([each._replace(time_s=each.time_s + stamps_s) for each in DRIVE[1000:]])
    assert len(found) == 1000
    assert not any(each.reasons & Reason.IMPLAUSIBLE_INPUT for each in found)
    assert found[0].soc_pct == pytest.approx(last.soc_pct, abs=0.5)
    assert found[-1].soc_pct == pytest.approx(last.soc_pct - 1.0, abs=1.0)


def test_after_a_reboot_the_pause_may_have_been_long(machine: Machine) -> None:
    """Without a battery-backed clock a night looks like a second."""
    kept(machine)
    same = machine.start().pipeline.latest.soc_std_pct
    rewritten(machine.path, lambda content: content.update(boot_id="another"))
    machine.start().drive(DRIVE[1000:1001])
    assert machine.pipeline.latest.soc_std_pct >= same
    assert machine.pipeline.latest.soc_std_pct > 5.0


def test_a_state_of_another_release_gives_its_soc(machine: Machine) -> None:
    last = kept(machine)[-1]
    rewritten(machine.path, lambda content: content["estimator"].update(writer="later", block=""))
    machine.start()
    assert machine.keeper.restored
    assert "of another release, method or capacity, of which the SoC alone is kept" in machine.text
    latest = machine.pipeline.latest
    assert (latest.soc_pct, latest.status) == (last.soc_pct, Status.INVALID)
    found = machine.drive(DRIVE[1000:])
    assert found[-1].soc_pct == pytest.approx(last.soc_pct - 1.0, abs=1.0)


def test_a_replayed_log_goes_on_and_another_one_begins_anew(machine: Machine) -> None:
    machine.settings = replace(machine.settings, time_source="replay-clock")

    def play(service: Machine, samples: list[Sample]) -> Estimate:
        for sample in samples:
            service.pipeline.handle(clock_frame(round((sample.time_s - EPOCH_S) * 1e6)))
            for frame in service.encoder.encode(sample):
                service.pipeline.handle(frame)
        return service.pipeline.latest

    whole = play(Machine(machine.path.with_name("b"), settings=machine.settings).start(), DRIVE)
    play(machine.start(), DRIVE[:1000])
    machine.stop()
    machine.wall_s += 300.0  # which has no say
    assert play(machine.start(), DRIVE[1000:]) == whole
    assert play(machine.start(), DRIVE[:100]).samples == 100
    assert machine.pipeline.counts["beginnings"] == 1


# --- Refused


def check_refused(machine: Machine, reason: str) -> None:
    machine.start()
    assert not machine.keeper.restored
    assert len(machine.logged.lines) == 1
    assert machine.text.startswith("warning: state refused")
    assert reason in machine.text
    assert machine.path.with_name(machine.path.name + ".refused").exists()
    assert not machine.path.exists()
    machine.drive(DRIVE[:700])
    machine.stop()
    assert machine.start().keeper.restored


def test_a_state_of_another_use_is_refused(machine: Machine) -> None:
    kept(machine)
    machine.wall_s += 86400.0 + 60.0
    check_refused(machine, "24.0 h old, more than the limit of 24 h")
    machine.model = Model.model_validate(MODEL.model_dump() | {"capacity_ah": 51.4})
    check_refused(machine, f"of another model ({MODEL.name})")
    machine.bus = "virtual y"
    check_refused(machine, "of another bus (virtual x)")
    rewritten(machine.path, lambda content: content.update(battery="", vehicle_name="moped"))
    check_refused(machine, "of another battery (moped)")
    rewritten(machine.path, lambda content: content.update(time_source="replay-clock"))
    check_refused(machine, "of another time source (replay-clock)")


def flip(path: Path) -> None:
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)


def edited(*place: Any, value: Any) -> Callable[[Path], None]:
    def change(content: dict[str, Any]) -> None:
        at: Any = content
        for key in place[:-1]:
            at = at[key]
        at[place[-1]] = value

    return lambda path: rewritten(path, change)


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (lambda path: path.write_bytes(b""), "not a cangauge state"),
    "one bit": (flip, ""),
    "a list": (lambda path: path.write_text("[]"), "not a cangauge state"),
    "nested": (lambda path: path.write_text("[" * 200_000), "not a cangauge state"),
    "large": (lambda path: path.write_bytes(b" " * ((8 << 20) + 1)), "larger than the 8 MB"),
    "version": (lambda path: path.write_text(path.read_text().replace(
        f'"version": {STATE_VERSION}', '"version": 1')), "(got 1)"),
    "hash": (lambda path: path.write_text(path.read_text().replace('"sha256": "', '"sha256": "0')),
             "damaged"),
    "unknown key": (edited("more", value=1), "more"),
    "no soc": (edited("estimator", "soc_pct", value=None), "soc_pct"),
    "a negative deviation": (edited("estimator", "soc_std_pct", value=-1.0), "soc_std_pct"),
    "a word": (edited("estimator", "block", value="many"), "estimator.block"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_is_set_aside_and_replaced(machine: Machine, name: str) -> None:
    act, reason = DAMAGE[name]
    kept(machine, 300)
    act(machine.path)
    check_refused(machine, reason)


def test_a_state_truncated_at_any_byte_is_refused(machine: Machine) -> None:
    kept(machine, 3)
    whole = machine.path.read_bytes()
    for size in range(0, len(whole) - 1, 7):
        machine.path.write_bytes(whole[:size])
        with pytest.raises(InputError):
            read_state(machine.path)


def test_a_refused_state_discards_the_initial_soc(machine: Machine) -> None:
    given = EstimatorSettings(initial_soc_pct=40.0, initial_soc_std_pct=1.0)
    machine.settings = PipelineSettings(estimator=given)
    # It is used at a first start: the drive begins at 80 %, so this shows.
    assert machine.start().drive(DRIVE[:3])[-1].soc_pct == pytest.approx(40.0, abs=2.0)
    machine.stop()
    machine.path.write_bytes(b"")
    machine.start()
    assert "starting from the voltage, since the given initial SoC is outdated" in machine.text
    assert machine.drive(DRIVE[:1000])[-1].soc_pct == pytest.approx(79.0, abs=4.0)
    # Nor does it come back when the configuration is read again.
    machine.pipeline.reconfigure(VEHICLE, machine.model, machine.settings)
    assert machine.drive(DRIVE[1000:1010])[-1].soc_pct == pytest.approx(79.0, abs=4.0)


# --- Paths and disks


def test_where_the_file_is_and_what_is_refused_there(tmp_path: Path) -> None:
    own, foreign = tmp_path / FILE_NAME, tmp_path / "notes.json"
    assert state_path(None, {}) is None
    assert state_path("a.json", {"STATE_DIRECTORY": "/var/lib/x"}) == Path("a.json")
    assert state_path(None, {"STATE_DIRECTORY": f"{tmp_path}:/var/lib/y"}) == own
    assert state_path(str(foreign), {}) == foreign
    with pytest.raises(InputError, match="does not exist"):
        state_path(str(tmp_path / "no" / "state.json"), {})
    foreign.write_text("precious")
    with pytest.raises(InputError, match="not a cangauge state file"):
        state_path(str(foreign), {})
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="FIFO"):
        state_path(str(tmp_path / "pipe"), {})
    for content in (b"", b"\0" * 4096, b"{", b"\xff\xfe{\0"):  # what a disk made of the state
        own.write_bytes(content)
        assert state_path(str(tmp_path), {}) == state_path(str(own), {}) == own


def test_a_full_disk_keeps_the_last_state(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.start().drive(DRIVE[:100])
    machine.keeper.checkpoint()
    assert waits(machine.path.exists)
    before = machine.path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    failures: list[logging.LogRecord] = []
    with monkeypatch.context() as disk:
        disk.setattr(state_file.os, "fsync", full)
        disk.setattr(machine.logged, "handle", failures.append)
        machine.drive(DRIVE[100:110])
        machine.keeper.checkpoint()
        assert waits(lambda: bool(failures))
        assert "No space left" in failures[0].getMessage()
        assert machine.path.read_bytes() == before
    machine.drive(DRIVE[110:120])
    machine.stop()
    assert machine.path.read_bytes() != before
    assert machine.path.stat().st_mode & 0o777 == 0o600
    assert [each.name for each in machine.path.parent.iterdir()] == [FILE_NAME]


def test_a_hanging_disk_delays_nothing(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_file, "CLOSE_WITHIN_S", 0.1)
    free = threading.Event()
    monkeypatch.setattr(state_file.os, "fsync", lambda _: free.wait(300.0))
    machine.start()
    ended = threading.Event()

    def run() -> None:
        for end in (10, 20, 30, 40):
            machine.drive(DRIVE[end - 10 : end])
            machine.keeper.checkpoint()
        machine.stop()
        ended.set()

    threading.Thread(target=run, daemon=True).start()
    assert ended.wait(120.0)  # the disk hangs for 300 s
    free.set()
    assert "was not written in time" in machine.text
