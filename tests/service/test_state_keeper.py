"""The state file: restarts, refused files, and failing disks."""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from cangauge._logging import RateLimitFilter
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.time_source import ClockFrames
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model
from cangauge.service import state as state_keeper
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.state import (
    FILE_NAME,
    StateContent,
    StateKeeper,
    StateSettings,
    read_state,
    state_path,
)
from cangauge.types import Estimate, Reason, Sample, Status
from live import LoggedLines, leaf_model, short_log

MODEL = leaf_model()
VEHICLE = Vehicle.load("generic")
EPOCH_S = 1_700_000_000.0
STOP_WITHIN_S = state_keeper.STOP_WITHIN_S
PATIENCE_S = 60.0
"""How long a busy disk may take here [s]; only a file that is never written fails a test."""
DRIVE = [each._replace(time_s=each.time_s + EPOCH_S) for each in samples_of(short_log(200.0))]


@dataclass
class Clock:
    """Unix time that a test sets."""

    wall_s: float = EPOCH_S


@dataclass
class Machine:
    """Services one after another on the same file."""

    path: Path
    clock: Clock = field(default_factory=Clock)
    logged: LoggedLines = field(default_factory=lambda: LoggedLines("cangauge.service.state"))
    model: Model = MODEL
    settings: PipelineSettings = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    max_age_s: float = 86400.0

    def start(self) -> Service:
        self.logged.__enter__()
        self.said.clear()
        pipeline = Pipeline(VEHICLE, self.model, self.settings)
        keeper = StateKeeper(
            StateSettings(self.path, self.max_age_s),
            pipeline,
            wall_s=lambda: self.clock.wall_s,
        )
        keeper.__enter__()
        return Service(self, pipeline, keeper)

    @property
    def said(self) -> list[str]:
        return self.logged.lines

    @property
    def text(self) -> str:
        return "\n".join(self.said)


@dataclass
class Service:
    machine: Machine
    pipeline: Pipeline
    keeper: StateKeeper
    encoder: FrameEncoder = field(default_factory=lambda: FrameEncoder(VEHICLE))

    def drive(self, samples: Iterable[Sample]) -> list[Estimate]:
        found = []
        for sample in samples:
            for frame in self.encoder.encode(sample):
                before = self.pipeline.samples
                self.pipeline.handle(frame)
                if self.pipeline.samples != before:
                    found.append(self.pipeline.latest)
            self.machine.clock.wall_s = max(self.machine.clock.wall_s, sample.time_s)
        return found

    def keep(self) -> None:
        self.keeper.checkpoint()
        assert self.keeper.flush(PATIENCE_S)

    def stop(self) -> None:
        self.keeper.__exit__(None, None, None)


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the last writing take its time: how long it may take is one test's subject."""
    monkeypatch.setattr(state_keeper, "STOP_WITHIN_S", PATIENCE_S)


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    machine = Machine(tmp_path / "state.json")
    yield machine
    machine.logged.__exit__()


def kept(machine: Machine, samples: int = 1000) -> list[Estimate]:
    """Let a service drive and end; return its estimates."""
    service = machine.start()
    found = service.drive(DRIVE[:samples])
    service.stop()
    return found


def rewritten(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a state's content, its hash being right again."""
    content = read_state(path).model_dump(mode="json")
    change(content)
    made = StateContent.model_validate(content) if _fits(content) else None
    text = state_keeper.state_text(made) if made else _hashed(content)
    path.write_text(text)


def _fits(content: dict[str, Any]) -> bool:
    try:
        StateContent.model_validate(content)
    except ValueError:
        return False
    return True


def _hashed(content: dict[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    head = {"format": "cangauge-state", "version": 3, "sha256": sha256}
    return json.dumps({**head, "content": content})


def numbers(estimates: list[Estimate]) -> list[Any]:
    """What must agree bit for bit; the stream does not remember the bus's temperature."""
    return [
        (each.time_s, each.soc_pct, each.soc_std_pct, each.soc_newton_pct, each.soc_coulomb_pct,
         each.voltage_model_v, each.residual_v, each.samples)
        for each in estimates
    ]  # fmt: skip


def test_a_service_restarted_at_once_goes_on_bit_for_bit(machine: Machine) -> None:
    whole = Machine(machine.path.with_name("other.json")).start().drive(DRIVE)
    first = kept(machine, 1003)
    service = machine.start()
    assert service.keeper.restored
    assert "continuing from" in machine.text
    again = service.drive(DRIVE[1003:])
    assert numbers(first + again) == numbers(whole)
    assert again[-1] == whole[-1]


def test_a_restored_soc_is_stale_until_the_first_sample(machine: Machine) -> None:
    last = kept(machine)[-1]
    latest = machine.start().pipeline.latest
    assert latest.soc_pct == last.soc_pct
    assert latest.status is Status.INVALID
    assert latest.reasons & Reason.INPUT_STALE


def test_the_state_is_written_only_after_new_samples(machine: Machine) -> None:
    service = machine.start()
    service.keep()
    assert not machine.path.exists()
    service.drive(DRIVE[:50])
    service.keep()
    first = machine.path.read_bytes()
    machine.clock.wall_s += 3600.0
    service.keep()
    assert machine.path.read_bytes() == first
    service.drive(DRIVE[50:60])
    service.stop()
    assert read_state(machine.path).estimator.memory.samples == 60


def test_after_a_long_pause_the_soc_approaches_the_voltage(
    machine: Machine,
) -> None:
    machine.settings = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    last = kept(machine)[-1]
    machine.clock.wall_s += 8 * 3600.0
    # The night's model error is 1.3 V, more than 3 % SoC there: much, and yet within the model's.
    later = [
        each._replace(time_s=each.time_s + 8 * 3600.0, voltage_v=each.voltage_v - 1.3)
        for each in DRIVE[1000:]
    ]
    service = machine.start()
    found = service.drive(later)
    truth_pct = 80.0 - 0.01 * (found[-1].time_s - DRIVE[0].time_s - 8 * 3600.0)
    wrong_pct = [truth_pct - each.soc_newton_pct for each in found[800:]]
    by_voltage_pct = sum(wrong_pct) / len(wrong_pct)
    assert by_voltage_pct > 3.5
    assert abs(found[-1].soc_pct - truth_pct) < 0.7 * by_voltage_pct
    assert abs(found[-1].soc_pct - truth_pct) < 1.5 * found[-1].soc_std_pct
    steps = [abs(b.soc_pct - a.soc_pct) for a, b in itertools.pairwise([last, *found])]
    assert all(step < each.soc_std_pct for step, each in zip(steps, found, strict=True))


def test_a_car_that_was_charged_meanwhile_is_found_out_and_told(machine: Machine) -> None:
    last = kept(machine)[-1]
    before_s = machine.clock.wall_s
    charged = [
        each._replace(time_s=each.time_s - DRIVE[0].time_s + before_s + 8 * 3600.0)
        for each in samples_of(short_log(200.0))
    ]
    # short_log begins at 80 %; the state is made to say 45 % instead, as before the charge.
    rewritten(machine.path, lambda content: _shift_soc(content, 45.0 - last.soc_pct))
    machine.clock.wall_s += 8 * 3600.0
    service = machine.start()
    found = service.drive(charged[: len(charged)])
    assert found[-1].soc_pct == pytest.approx(78.5, abs=4.0)
    assert found[-1].soc_std_pct < 4.0
    service.keep()
    assert "the voltage refutes the restored SoC of 45.0 %" in machine.text
    # Told once.
    service.drive([charged[-1]._replace(time_s=charged[-1].time_s + 1.0)])
    service.keep()
    assert machine.text.count("refutes") == 1


def _shift_soc(content: dict[str, Any], by_pct: float) -> None:
    state = content["estimator"]
    state["estimate"][1] += by_pct
    state["memory"]["coulomb_start_pct"] += by_pct
    for each in state["hypotheses"]["filters"]:
        each["x"][0] += by_pct


def test_a_state_that_the_first_minutes_contradict_does_not_last(machine: Machine) -> None:
    """A foreign state (another pack, the same model) after a pause too short to be charged in."""
    kept(machine)
    rewritten(machine.path, lambda content: _shift_soc(content, -35.0))
    service = machine.start()
    rest = list(samples_of(short_log(700.0)))[1000:]
    found = service.drive(each._replace(time_s=each.time_s + EPOCH_S + 5.0) for each in rest)
    assert any(each.reasons & Reason.INNOVATION_LARGE for each in found)
    assert found[-1].soc_pct == pytest.approx(73.0, abs=4.0)


@pytest.mark.parametrize(
    ("clock_s", "stamps_s"),
    [(3600.0, 0.0), (-86400.0, 0.0), (3600.0, -EPOCH_S), (0.2, -EPOCH_S), (5.0, 1e8)],
    ids=["stood", "set back", "from zero after an hour", "from zero", "far ahead"],
)
def test_stamps_of_another_clock_after_the_restart(
    machine: Machine, clock_s: float, stamps_s: float
) -> None:
    last = kept(machine)[-1]
    machine.clock.wall_s += clock_s
    service = machine.start()
    found = service.drive([each._replace(time_s=each.time_s + stamps_s) for each in DRIVE[1000:]])
    assert len(found) == 1000
    assert not any(each.reasons & Reason.IMPLAUSIBLE_INPUT for each in found)
    assert found[0].soc_pct == pytest.approx(last.soc_pct, abs=0.5)
    assert found[-1].soc_pct == pytest.approx(last.soc_pct - 1.0, abs=1.0)


def test_after_the_machine_was_off_its_clock_is_not_believed(machine: Machine) -> None:
    """Without a battery-backed clock a night looks like a second."""
    kept(machine)
    rewritten(machine.path, lambda content: content.update(boot_id="another"))
    service = machine.start()
    service.drive(DRIVE[1000:1001])
    assert service.pipeline.estimator.verdict == "open"


@pytest.mark.parametrize("change", [{"method": "coulomb"}, {"capacity_ah": 55.0}])
def test_a_changed_setting_keeps_the_soc(machine: Machine, change: dict[str, Any]) -> None:
    last = kept(machine)[-1]
    machine.settings = PipelineSettings(EstimatorSettings(**change))
    service = machine.start()
    assert service.keeper.restored
    found = service.drive(DRIVE[1000:1010])
    assert found[-1].soc_pct == pytest.approx(last.soc_pct, abs=0.1)


def test_a_replayed_log_goes_on_and_another_one_begins_anew(machine: Machine) -> None:
    machine.settings = replace(machine.settings, time_source="replay-clock")
    clock = ClockFrames()

    def play(service: Service, samples: list[Sample]) -> Estimate:
        for sample in samples:
            service.pipeline.handle(clock.at(round((sample.time_s - EPOCH_S) * 1e6)))
            for frame in service.encoder.encode(sample):
                service.pipeline.handle(frame)
        return service.pipeline.latest

    whole = play(Machine(machine.path.with_name("b"), settings=machine.settings).start(), DRIVE)
    service = machine.start()
    play(service, DRIVE[:1000])
    service.stop()
    machine.clock.wall_s += 300.0  # which has no say
    assert play(machine.start(), DRIVE[1000:]) == whole
    service = machine.start()
    fresh = play(service, DRIVE[:100])
    assert service.pipeline.counts.beginnings == 1
    assert fresh.samples == 100


# --- refused ----------------------------------------------------------------------------------


def check_refused(machine: Machine, reason: str) -> None:
    service = machine.start()
    assert not service.keeper.restored
    assert len(machine.said) == 1
    assert "state refused" in machine.text
    assert reason in machine.text
    assert "\n" not in machine.said[0]
    aside = machine.path.with_name(machine.path.name + ".refused")
    assert aside.exists()
    assert not machine.path.exists()
    found = service.drive(DRIVE[:1000])
    assert found[-1].soc_pct == pytest.approx(79.0, abs=3.0)
    service.stop()
    assert machine.start().keeper.restored


def test_an_old_one_is_refused(machine: Machine) -> None:
    kept(machine)
    machine.clock.wall_s += 86400.0 + 60.0
    check_refused(machine, "24.0 h old, more than the limit of 24 h")


def test_another_models_is_refused(machine: Machine) -> None:
    kept(machine)
    machine.model = Model.model_validate(MODEL.model_dump() | {"capacity_ah": 51.4})
    check_refused(machine, f"of another model ({MODEL.name})")


def test_another_time_sources_is_refused(machine: Machine) -> None:
    kept(machine)
    rewritten(machine.path, lambda content: content.update(time_source="replay-clock"))
    check_refused(machine, "saved with time source replay-clock, now it is receive")


def overwrite(**changes: Any) -> Callable[[Path], None]:
    def act(path: Path) -> None:
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return act


def edited(*place: Any, value: Any) -> Callable[[Path], None]:
    def change(content: dict[str, Any]) -> None:
        at: Any = content
        for key in place[:-1]:
            at = at[key]
        at[place[-1]] = value

    return lambda path: rewritten(path, change)


def flip(path: Path) -> None:
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (lambda path: path.write_bytes(b""), "not JSON"),
    "zeros": (lambda path: path.write_bytes(bytes(4096)), "not JSON"),
    "noise": (lambda path: path.write_bytes(bytes(range(256)) * 9), "not JSON"),
    "half": (lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
             "not JSON"),
    "one bit": (flip, ""),
    "utf-16": (lambda path: path.write_bytes(path.read_text("utf-8").encode("utf-16")),
               "not JSON"),
    "utf-32": (lambda path: path.write_bytes(path.read_text("utf-8").encode("utf-32")),
               "not JSON"),
    "byte order mark": (lambda path: path.write_text(path.read_text("utf-8"), "utf-8-sig"),
                        "not JSON"),
    "a list": (lambda path: path.write_text("[]"), "not a cangauge state"),
    "a model": (lambda path: path.write_text('{"format": "cangauge-model"}'),
                "not a cangauge state"),
    "nested": (lambda path: path.write_text("[" * 200_000), "nested too deeply"),
    "large": (lambda path: path.write_bytes(b" " * ((8 << 20) + 1)), "larger than 8 MB"),
    "a huge number": (lambda path: path.write_text("9" * 10_000), "not JSON"),
    "not a number": (lambda path: path.write_text("NaN"), "not JSON"),
    "version": (overwrite(version=2), "this release reads version 3 (got 2)"),
    "no version": (overwrite(version=None), "this release reads version 3"),
    "hash": (overwrite(sha256="0" * 64), "damaged"),
    "no content": (overwrite(content=None), "damaged"),
    "infinite": (lambda path: path.write_text(
        '{"format": "cangauge-state", "version": 3, "sha256": "", "content": {"a": 1e999}}'),
        "damaged"),
    "unknown key": (edited("more", value=1), "content.more"),
    "a state too many": (edited("estimator", "hypotheses", "filters", 0, "x", value=[1.0] * 9),
                         "filter has 4 states"),
    "no filter": (edited("estimator", "hypotheses", "filters", value=[]), "hypotheses.filters"),
    "a current too many": (edited("estimator", "line", "current_a", value=[0.0]),
                           "one current per time"),
    "a word": (edited("estimator", "memory", "samples", value="many"),
               "content.estimator.memory.samples"),
    "effects": (edited("estimator", "online", value=[[], [1.0]]), "the model has 0 effects"),
    "no soc": (edited("estimator", "estimate", 1, value=None), "has no SoC"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_is_refused_put_aside_and_replaced(machine: Machine, name: str) -> None:
    act, reason = DAMAGE[name]
    machine.path = machine.path.with_name(FILE_NAME)  # by another name, no state is not touched
    kept(machine, 300)
    act(machine.path)
    began = time.process_time()
    check_refused(machine, reason)
    assert time.process_time() - began < 20.0


def test_truncated_at_every_byte_it_is_refused(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state.json")
    kept(machine, 3)
    whole = machine.path.read_bytes()
    assert len(whole) < 5000
    for size in range(len(whole) - 1):  # the last byte is the line's end
        machine.path.write_bytes(whole[:size])
        with pytest.raises(state_keeper.InputError):
            read_state(machine.path)


def test_flipped_bits_are_noticed(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state.json")
    kept(machine, 3)
    whole = machine.path.read_bytes()
    same = read_state(machine.path)
    for at in range(0, len(whole), 5):
        damaged = bytearray(whole)
        damaged[at] ^= 0x04
        machine.path.write_bytes(damaged)
        try:
            assert read_state(machine.path) == same  # white space, for one
        except state_keeper.InputError:
            continue


def test_a_pipe_is_neither_read_nor_moved(machine: Machine) -> None:
    os.mkfifo(machine.path)
    with pytest.raises(state_keeper.InputError, match="FIFO"):
        machine.start()
    assert machine.path.is_fifo()


def test_a_refused_state_replaces_only_an_earlier_one(machine: Machine) -> None:
    foreign = machine.path.with_name("state.json.refused")
    foreign.write_text("somebody's")
    for _ in range(2):
        kept(machine, 3)
        overwrite(version=2)(machine.path)
        machine.start()
    assert foreign.read_text() == "somebody's"
    assert sorted(each.name for each in machine.path.parent.iterdir()) == [
        "state.json.refused",
        "state.json.refused2",
    ]


# --- what the disk can do ---------------------------------------------------------------------


def is_root() -> bool:
    return os.geteuid() == 0


def fail(error: OSError) -> Callable[..., None]:
    def write(*_: object) -> None:
        raise error

    return write


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EROFS, "Read-only file system"),
        PermissionError(errno.EACCES, "Permission denied"),
        OSError(errno.EIO, "Input/output error"),
    ],
    ids=lambda error: errno.errorcode[error.errno],
)
def test_a_failing_disk_is_reported_at_growing_intervals(
    machine: Machine, monkeypatch: pytest.MonkeyPatch, error: OSError
) -> None:
    service = machine.start()
    service.drive(DRIVE[:100])
    service.keep()
    before = machine.path.read_bytes()
    with monkeypatch.context() as disk:
        disk.setattr(Path, "write_text", fail(error))
        failures: list[logging.LogRecord] = []
        monkeypatch.setattr(machine.logged, "handle", failures.append)
        for number in range(7):
            service.drive(DRIVE[100 + number : 101 + number])
            service.keep()
        assert [record.getMessage()[:17] for record in failures] == 7 * ["state not written"]
        now = [0.0]
        limiter = RateLimitFilter(clock=lambda: now[0])
        written = 0
        for now[0] in range(0, 600, 10):  # a checkpoint each
            written += limiter.filter(failures[0])
        assert 10 <= written <= 15
        monkeypatch.undo()
        assert machine.path.read_bytes() == before
        assert [each.name for each in machine.path.parent.iterdir()] == ["state.json"]
    service.drive(DRIVE[200:201])
    service.stop()
    assert read_state(machine.path).estimator.memory.samples == 108


def test_a_folder_that_is_not_there(machine: Machine) -> None:
    machine.path = machine.path.parent / "absent" / "state.json"
    service = machine.start()
    assert service.drive(DRIVE[:10])
    service.stop()
    assert "the folder of this file does not exist" in machine.text
    machine.path.parent.mkdir()
    service.drive(DRIVE[10:20])
    service.stop()
    assert machine.path.exists()


@pytest.mark.skipif(is_root(), reason="root may write anywhere")
def test_a_folder_and_a_file_without_rights(machine: Machine) -> None:
    machine.path = machine.path.with_name(FILE_NAME)
    kept(machine)
    machine.path.chmod(0)
    machine.path.parent.chmod(0o500)
    try:
        service = machine.start()
        assert "cannot be read: Permission denied" in machine.text
        assert "cannot be renamed" in machine.text
        assert service.drive(DRIVE[:10])
        service.stop()
        assert "not writable" in machine.text
    finally:
        machine.path.parent.chmod(0o700)


def test_a_hanging_disk_delays_nothing(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    # SIGTERM is to stop the service within a second, the disk's part included.
    assert STOP_WITHIN_S < 1.0
    monkeypatch.setattr(state_keeper, "STOP_WITHIN_S", STOP_WITHIN_S)
    free = threading.Event()
    monkeypatch.setattr(state_keeper, "write_text_atomic", lambda *_: free.wait(PATIENCE_S))
    service = machine.start()
    service.drive(DRIVE[:10])
    began = time.perf_counter()
    service.keeper.checkpoint()
    service.drive(DRIVE[10:20])
    service.keeper.checkpoint()
    service.drive(DRIVE[20:30])
    service.stop()
    # Far more than it takes on a busy machine, and far less than the disk hangs.
    assert time.perf_counter() - began < PATIENCE_S / 4.0
    assert "was not written in time" in machine.text
    free.set()


def test_what_a_killed_writer_left_is_swept_away(machine: Machine) -> None:
    folder = machine.path.parent
    (folder / ".state.0123abcd.json").write_text("half")
    (folder / ".state.json").write_text("somebody's")
    (folder / ".other.0123abcd.json").write_text("another's")
    machine.start()
    assert sorted(each.name for each in folder.iterdir()) == [".other.0123abcd.json", ".state.json"]


def test_where_the_file_is(tmp_path: Path) -> None:
    assert state_path(None, {}) is None
    assert state_path(str(tmp_path), {}) == tmp_path / FILE_NAME
    assert state_path("a.json", {"STATE_DIRECTORY": "/var/lib/x"}) == Path("a.json")
    assert state_path(None, {"STATE_DIRECTORY": "/var/lib/x:/var/lib/y"}) == Path(
        "/var/lib/x", FILE_NAME
    )


def test_a_state_holds_no_nan_and_is_plain_json(machine: Machine) -> None:
    kept(machine, 20)
    data = json.loads(machine.path.read_text(), parse_constant=pytest.fail)
    assert data["content"]["estimator"]["memory"]["gap_until_s"] is None
    assert math.isfinite(data["content"]["estimator"]["estimate"][1])


@pytest.mark.parametrize("method", ["ekf", "coulomb"])
def test_a_refused_state_starts_by_voltage(machine: Machine, method: Any) -> None:
    given = EstimatorSettings(method=method, initial_soc_pct=40.0, initial_soc_std_pct=1.0)
    machine.settings = PipelineSettings(estimator=given)
    first = machine.start()
    # At a first start it is believed: the drive begins at 80 %, so this shows.
    assert first.drive(DRIVE[:3])[-1].soc_pct == pytest.approx(40.0, abs=2.0)
    first.stop()
    machine.path.write_bytes(b"")
    again = machine.start()
    assert "starting from the voltage, since the given initial SoC is outdated" in machine.text
    found = again.drive(DRIVE[:1000])[-1]
    assert abs(found.soc_pct - 79.0) < 3.0 * found.soc_std_pct
    assert found.soc_pct == pytest.approx(79.0, abs=4.0)
    # Nor is it taken up again when the configuration is read again.
    again.pipeline.reconfigure(None, machine.model, machine.settings)
    assert again.drive(DRIVE[1000:1010])[-1].soc_pct == pytest.approx(79.0, abs=4.0)


@pytest.mark.parametrize("of", ["bus", "vehicle"])
def test_a_state_of_another_bus_or_vehicle_is_set_aside(machine: Machine, of: str) -> None:
    kept(machine)
    before = machine.path.read_text()
    rewritten(machine.path, lambda content: content.update({of: "another one"}))
    service = machine.start()
    assert not service.keeper.restored
    assert math.isnan(service.pipeline.latest.soc_pct)
    assert f"of another {of} (another one)" in machine.text
    aside = machine.path.with_name(machine.path.name + ".refused")
    assert "another one" in aside.read_text() != before


def test_a_state_is_for_its_owner_only(machine: Machine) -> None:
    machine.path.touch(0o666)
    kept(machine)
    assert machine.path.stat().st_mode & 0o777 == 0o600
