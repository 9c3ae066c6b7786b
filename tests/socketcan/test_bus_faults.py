"""Faults of a real SocketCAN interface under the service: down, removed, overrun, error frames, a
second service, signals."""

from __future__ import annotations

import logging
import shutil
import signal
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import can
import pytest

from bus_log import BusLog
from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, has_socketcan, open_bus
from cangauge.bus.publish import SocReader, standard_filter
from cangauge.bus.reconnecting import LONGEST_PAUSE_S, ReconnectingBus
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Reason, Status
from live import Command, Service, leaf_model, leaf_model_path, loop_config, short_log, waits

pytestmark = pytest.mark.socketcan

VCAN = BusAddress("socketcan", "vcan0")
STALE_S = 0.3


def ip(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True)


def add(name: str) -> None:
    ip("add", name, "type", "vcan")
    ip("set", name, "up")


@pytest.fixture(autouse=True)
def _vcan0() -> Iterator[None]:
    if not has_socketcan("vcan0"):
        pytest.skip("no SocketCAN interface vcan0 on this machine")
    if shutil.which("ip") is None:
        pytest.skip("no `ip` command to take the interface down")
    yield
    names = [name for _, name in socket.if_nameindex()]
    if "vcan0" in names:
        ip("set", "vcan0", "up")
    else:
        add("vcan0")
    if "vcan7" in names:
        ip("del", "vcan7")


class Reconnecting(Service):
    """The service on a reconnecting bus; its log is kept."""

    def __init__(self, address: BusAddress = VCAN, *, wait: bool = False) -> None:
        known = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
        pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), known)
        self.log = BusLog()
        port = ReconnectingBus(address, pipeline.filters)
        port.open(wait=wait)
        super().__init__(port, pipeline, loop_config(timeout_s=STALE_S))

    def __enter__(self) -> Self:
        self.log.__enter__()
        return super().__enter__()

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        self.log.__exit__()

    @property
    def bus(self) -> ReconnectingBus:
        assert isinstance(self.port, ReconnectingBus)
        return self.port


class Pack:
    """Sends a drive in real time, 50 samples a second, while there is a bus."""

    def __init__(self, address: BusAddress = VCAN) -> None:
        self._address = address
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.sent = 0

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        encoder = FrameEncoder(Vehicle.load("generic"))
        port = ReconnectingBus(self._address, [])
        port.open(wait=True)
        with port:
            for sample in samples_of(short_log(600.0)):
                if self._stop.is_set():
                    return
                for frame in encoder.encode(sample):
                    port.post(frame, 1.0)
                    self.sent += 1
                port.receive(0.0 if port.is_away else 0.001)
                time.sleep(0.02)


class Listener:
    """Reads the published estimates."""

    def __init__(self) -> None:
        self._bus = open_bus(VCAN, [standard_filter(0x5A0)])
        self._reader = SocReader()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    def next(self) -> dict[str, Any]:
        message = self._bus.recv(2.0)
        assert message is not None, "nothing is published"
        name, values = self._reader.read(message)
        assert name == "soc_estimate"
        return values


def is_stale(estimate: dict[str, Any]) -> bool:
    return estimate["status"] is Status.INVALID and bool(estimate["reason"] & Reason.INPUT_STALE)


@pytest.mark.parametrize("kind", ["down", "removed"])
def test_an_interface_that_is_lost_and_returns(kind: str) -> None:
    with Reconnecting() as live:
        with Pack():
            assert waits(lambda: live.pipeline.samples >= 50)
        before = live.pipeline.latest.soc_pct
        if kind == "down":
            ip("set", "vcan0", "down")
        else:
            ip("del", "vcan0")
        assert waits(lambda: live.bus.is_away)
        cpu_s = time.process_time()
        time.sleep(2.0)
        # CPU time of the whole program, this test included; a busy loop takes two seconds.
        assert time.process_time() - cpu_s < 0.5
        assert live.error is None
        assert live.bus.is_away
        if kind == "down":
            ip("set", "vcan0", "up")
        else:
            add("vcan0")
        assert waits(lambda: not live.bus.is_away, LONGEST_PAUSE_S + 0.5)
        with Listener() as listener:
            estimate = listener.next()
            assert is_stale(estimate)  # it keeps publishing, with the age
            assert estimate["soc_pct"] == pytest.approx(before, abs=0.01)
            samples = live.pipeline.samples
            with Pack():
                assert waits(lambda: live.pipeline.samples >= samples + 20)
                estimate = [listener.next() for _ in range(30)][-1]
            assert not is_stale(estimate)
            assert estimate["soc_pct"] == pytest.approx(before, abs=0.5)
    assert live.error is None
    assert live.bus.losses == 1
    assert live.bus.away_s >= 2.0
    assert [each for each in live.log.events if each != "bus.away"] == ["bus.lost", "bus.back"]
    assert live.log.lines[0].startswith("socketcan vcan0: ")


def test_an_interface_that_flaps() -> None:
    with Reconnecting() as live, Pack():
        for _ in range(5):
            ip("set", "vcan0", "down")
            time.sleep(0.05)
            ip("set", "vcan0", "up")
            time.sleep(0.25)
        assert waits(lambda: not live.bus.is_away)
        samples = live.pipeline.samples
        assert waits(lambda: live.pipeline.samples >= samples + 20)
    assert live.error is None
    assert 1 <= live.bus.losses <= 5
    assert live.log.events.count("bus.lost") <= 5


def test_a_bus_that_does_not_exist_yet() -> None:
    address = BusAddress("socketcan", "vcan7")
    with pytest.raises(InputError, match="vcan7"):
        Reconnecting(address)
    with Reconnecting(address, wait=True) as live, Pack(address):
        time.sleep(0.5)
        assert live.bus.is_away
        add("vcan7")
        assert waits(lambda: live.pipeline.samples >= 20)
    assert live.error is None
    assert live.bus.losses == 0
    assert live.log.events[-1] == "bus.back"


def test_opening_an_interface_that_is_down_is_an_error() -> None:
    ip("set", "vcan0", "down")
    with pytest.raises(InputError, match="is down") as caught:
        open_bus(VCAN)
    assert "ip link set vcan0 up" in str(caught.value)


def test_failed_attempts_leak_no_descriptor(caplog: pytest.LogCaptureFixture) -> None:
    # pytest keeps log records, which keep the errors and their sockets.
    caplog.set_level(logging.CRITICAL + 1, "can")

    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    ip("set", "vcan0", "down")
    before = descriptors()
    for address in [VCAN] * 100 + [BusAddress("socketcan", "nosuch0")] * 100:
        try:
            open_bus(address)
        except InputError:
            continue
        pytest.fail("opened")
    assert descriptors() <= before + 1


def send_error(classes: int, data: bytes = bytes(8)) -> None:
    with socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind(("vcan0",))
        raw.send(struct.pack("=IB3x8s", socket.CAN_ERR_FLAG | classes, 8, data))


def test_error_frames_are_counted_and_bus_off_is_logged() -> None:
    with Reconnecting() as live, Pack():
        assert waits(lambda: live.pipeline.samples >= 10)
        for _ in range(5):
            send_error(0x088)
        send_error(0x004, b"\x00\x01" + bytes(6))
        assert waits(lambda: live.port.error_frames == 6)
        assert live.log.lines == []
        send_error(0x040)
        assert waits(lambda: live.port.is_off)
        assert waits(lambda: bool(live.log.lines))
        assert "bus-off" in live.log.lines[0]
        send_error(0x100)
        frames = live.pipeline.counts["frames"]
        assert waits(lambda: live.pipeline.counts["frames"] > frames + 20)
        assert not live.port.is_off
    assert live.error is None
    assert live.bus.losses == 0


def test_two_thousand_error_frames_cost_no_sample() -> None:
    with Reconnecting() as live, Pack() as pack:
        assert waits(lambda: live.pipeline.samples >= 10)
        with socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
            raw.bind(("vcan0",))
            frame = struct.pack("=IB3x8s", socket.CAN_ERR_FLAG | 0x080, 8, bytes(8))
            for _ in range(100):
                for _ in range(20):
                    raw.send(frame)
                time.sleep(0.01)
        assert waits(lambda: live.port.error_frames == 2000)
        samples = live.pipeline.samples
        assert waits(lambda: live.pipeline.samples >= samples + 20)
        assert pack.sent > 0
    assert live.pipeline.counts["lost"] == live.port.queue_drops == 0


def test_the_kernel_stamps_frames_on_arrival() -> None:
    with (
        BusConnection(open_bus(VCAN), VCAN) as port,
        BusConnection(open_bus(VCAN), VCAN) as sender,
    ):
        before_s = time.time()
        sender.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        sent_s = time.time()
        time.sleep(0.5)
        message = port.receive(1.0)
    assert message is not None
    # Reading happens half a second later.
    assert before_s - 0.001 <= message.timestamp <= sent_s + 0.05


def test_two_services_detect_each_other() -> None:
    with Reconnecting() as one:
        time.sleep(0.5)
        assert one.warnings == []
        with Reconnecting() as two:
            assert waits(lambda: bool(one.warnings) and bool(two.warnings))
    assert "sends 0x5A" in one.warnings[0]


def test_overflow_signals_and_a_bus_that_is_down(tmp_path: Path) -> None:
    """One process for all: processes start slowly in a guest."""
    config = tmp_path / "car.toml"
    config.write_text(f'model = "{leaf_model_path()}"\nchannel = "vcan0"\nwait_for_bus = true\n')
    ip("set", "vcan0", "down")
    live = Command("run", "--config", config, "--json")
    live.wait_for("bus.missing")
    ip("set", "vcan0", "up")
    live.wait_for("bus.back")
    # A pause of the process: frames beyond the queue are lost and counted.
    live.process.send_signal(signal.SIGSTOP)
    burst = _overflow()
    live.process.send_signal(signal.SIGCONT)
    live.wait_for("bus.queue_overflow")
    _wait_until_worked_off()
    config.write_text("timeout_s = [")
    live.process.send_signal(signal.SIGHUP)
    live.wait_for("config.refused")
    config.write_text(
        f'model = "{leaf_model_path()}"\nchannel = "vcan0"\n[ids]\nsoc_estimate = 0x111\n'
    )
    live.process.send_signal(signal.SIGHUP)
    live.wait_for("config.reloaded")
    listener = open_bus(VCAN, [standard_filter(0x111)])
    assert listener.recv(2.0) is not None
    listener.shutdown()
    ip("set", "vcan0", "down")
    live.wait_for("bus.lost")
    time.sleep(0.5)
    began_s = time.monotonic()
    live.process.send_signal(signal.SIGTERM)
    ended = live.end()
    assert time.monotonic() - began_s < 1.0
    assert ended.code == 0, ended.err
    result = ended.json
    drops = result["bus_counts"]["queue_drops"]
    assert drops > 0
    assert result["frames"]["received"] + drops == burst
    assert result["stamps"] == "kernel"
    assert result["bus_counts"]["losses"] == 1
    assert f"{drops} frames dropped in the receive queue" in ended.err


def _wait_until_worked_off() -> None:
    """Wait until the service's sample count no longer changes."""
    reader, before = SocReader(), -1
    with open_bus(VCAN, [standard_filter(0x5A1)]) as listener:
        while (frame := listener.recv(3.0)) is not None:
            name, detail = reader.read(frame)
            assert name == "soc_detail"
            if detail["samples"] == before:
                return
            before = detail["samples"]
    raise AssertionError("nothing is published")


def _overflow() -> int:
    """Send until a receive queue as large as the service's overflows; return the count."""
    encoder, sent = FrameEncoder(Vehicle.load("generic")), 0
    frames = [frame for each in samples_of(short_log(200.0)) for frame in encoder.encode(each)]
    with (
        BusConnection(open_bus(VCAN), VCAN) as witness,
        BusConnection(open_bus(VCAN, []), VCAN) as sender,
    ):
        while not witness.queue_drops:
            for frame in frames:
                sender.send(frame)
            sent += len(frames)
    return sent
