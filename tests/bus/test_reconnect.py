"""Reconnecting a lost bus: attempts, cost, log."""

from __future__ import annotations

import errno
import itertools
from collections.abc import Callable, Iterator, Sequence

import can
import pytest
from can.typechecking import CanFilter

import live
from bus_log import BusLog
from cangauge.bus import connection, reconnecting
from cangauge.bus.open import BusAddress, DriverMissingError, open_bus
from cangauge.bus.publish import standard_filter
from cangauge.bus.reconnecting import FIRST_PAUSE_S, ReconnectingBus
from cangauge.errors import InputError
from live import BrokenBus, network_down

ADDRESS = BusAddress("socketcan", "can9")
FRAME = can.Message(arbitration_id=0x123, is_extended_id=False, data=b"12345678")


class Clock:
    """Time that passes in waits alone [s], so that no test depends on how busy the machine is."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def time(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds + 1e-6  # as a real one, never less


time = Clock()


@pytest.fixture(autouse=True)
def _simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (connection, reconnecting, live):
        monkeypatch.setattr(module, "time", time)


class Opener:
    """Opens buses from a script: a bus, or an error to raise; the last step repeats."""

    def __init__(self, *script: object) -> None:
        self._script = list(script)
        self.at_s: list[float] = []
        self.filters: list[object] = []

    def __call__(
        self, _address: BusAddress, filters: Sequence[CanFilter] | None = None
    ) -> can.BusABC:
        self.at_s.append(time.monotonic())
        self.filters.append(filters)
        step = self._script.pop(0) if len(self._script) > 1 else self._script[0]
        if isinstance(step, BaseException):
            raise step
        return step() if callable(step) else step  # type: ignore[return-value] # what is used of one


def missing() -> InputError:
    return InputError("no such bus", field="--channel", value="can9")


@pytest.fixture
def log() -> Iterator[BusLog]:
    with BusLog() as log:
        yield log


def port_on(opener: Opener, *, wait: bool = False) -> ReconnectingBus:
    port = ReconnectingBus(ADDRESS, [standard_filter(0x123)], opener)
    port.open(wait=wait)
    return port


def pump(
    port: ReconnectingBus, seconds: float, until: Callable[[], bool] = lambda: False
) -> list[can.Message]:
    found = []
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and not until():
        message = port.receive(0.02)
        if message is not None:
            found.append(message)
    return found


@pytest.mark.parametrize(
    "error",
    [
        network_down(),
        OSError(errno.ENODEV, "No such device"),
        AssertionError("only requested a single extra field"),
        RuntimeError("usb: device gone"),
        can.CanOperationError("driver closed"),
    ],
    ids=repr,
)
def test_a_lost_bus_is_reopened_with_its_filters(error: BaseException, log: BusLog) -> None:
    first, second = BrokenBus([FRAME, error]), BrokenBus([FRAME])
    opener = Opener(first, second)
    port = port_on(opener)
    port.set_filters([standard_filter(0x55)])
    received = pump(port, 2.0, until=lambda: len(opener.at_s) == 2 and not port.is_away)
    received += pump(port, 0.1)
    assert len(received) == 2
    assert (first.closed, second.closed) == (1, 0)
    assert opener.filters[1] == [standard_filter(0x55)]
    assert (port.losses, port.is_away) == (1, False)
    assert FIRST_PAUSE_S <= port.away_s < 1.0
    assert log.events == ["bus.lost", "bus.back"]
    assert log.lines[0].startswith("socketcan can9: receiving failed: ")
    assert log.lines[1].startswith("socketcan can9: back after 0.")
    port.close()
    assert second.closed == 1


def test_a_failed_send_is_a_loss_and_later_frames_are_counted(log: BusLog) -> None:
    port = port_on(Opener(BrokenBus([], sending=network_down()), missing()))
    port.post(FRAME, 1.0)
    assert (port.losses, port.unsent) == (1, 1)
    began_s = time.now_s
    for _ in range(1000):
        port.post(FRAME, 1.0)
    assert time.now_s - began_s < 0.1
    assert port.unsent == 1001
    assert "sending failed" in log.lines[0]
    port.close()


def test_pauses_grow_to_a_limit_and_reset_when_steady(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reconnecting, "LONGEST_PAUSE_S", 0.4)
    monkeypatch.setattr(reconnecting, "STEADY_S", 0.3)
    last = BrokenBus([])
    opener = Opener(BrokenBus([network_down()]), *(missing() for _ in range(6)), last)
    port = port_on(opener)
    pump(port, 4.0, until=lambda: not port.is_away and len(opener.at_s) == 8)
    pauses = [b - a for a, b in itertools.pairwise(opener.at_s)]
    wanted = [0.05, 0.1, 0.2, 0.4, 0.4, 0.4, 0.4]
    assert all(want <= pause < want + 0.15 for want, pause in zip(wanted, pauses, strict=True))
    pump(port, 0.35)
    last._receiving.append(network_down())
    lost_s = time.monotonic()
    pump(port, 1.0, until=lambda: len(opener.at_s) == 9)
    assert opener.at_s[-1] - lost_s < 0.2
    port.close()


def test_a_bus_that_is_missing_at_the_start(log: BusLog) -> None:
    with pytest.raises(InputError, match="no such bus"):
        port_on(Opener(missing()))
    port = port_on(Opener(missing(), missing(), BrokenBus([FRAME])), wait=True)
    assert port.is_away
    assert port.trouble.startswith("bus away for ")
    port.post(FRAME, 1.0)
    received = pump(port, 2.0, until=lambda: not port.is_away)
    received += pump(port, 0.1)
    assert len(received) == 1
    assert (port.losses, port.unsent, port.trouble) == (0, 1, "")
    assert log.events == ["bus.missing", "bus.back"]
    assert "waiting for it" in log.lines[0]
    assert "available after" in log.lines[1]
    port.close()


def test_a_missing_driver_is_not_waited_for() -> None:
    opener = Opener(DriverMissingError("a library for this interface is missing"))
    with pytest.raises(InputError, match="library"):
        port_on(opener, wait=True)
    with pytest.raises(DriverMissingError):
        open_bus(BusAddress("pcan", "PCAN_USBBUS1"))


def test_a_bus_that_opens_after_the_end_is_shut_down(log: BusLog) -> None:
    def slow() -> BrokenBus:
        port.close()  # as another thread, while the driver opens
        return late

    late = BrokenBus([FRAME])
    port = port_on(Opener(BrokenBus([network_down()]), slow))
    pump(port, 2.0, until=lambda: late.closed == 1)
    assert (late.closed, port.is_away, log.events) == (1, False, ["bus.lost"])


def test_bus_off_and_its_end_are_logged(log: BusLog) -> None:
    def error_frame(classes: int) -> can.Message:
        return can.Message(
            arbitration_id=classes, is_extended_id=False, is_error_frame=True, data=bytes(8)
        )

    bus = BrokenBus([error_frame(0x080), error_frame(0x040)])
    port = port_on(Opener(bus))
    assert pump(port, 0.1) == []
    assert port.error_frames == 2
    assert port.is_off
    assert port.trouble == "bus-off"
    assert "restart-ms" in log.lines[0]
    bus._receiving.append(error_frame(0x100))
    pump(port, 0.1)
    assert not port.is_off
    bus._receiving += [error_frame(0x040), FRAME]
    assert len(pump(port, 0.1)) == 1  # a controller that receives is not off
    assert not port.is_off
    assert log.events[:2] == ["bus.off", "bus.on"]
    assert port.losses == 0


def test_a_full_transmit_queue_never_waits_and_keeps_order() -> None:
    full = can.CanOperationError("Failed to transmit: No buffer space", errno.ENOBUFS)
    bus = BrokenBus([FRAME] * 50, sending=full)
    port = port_on(Opener(bus))
    began_s = time.now_s
    for number in range(10):
        port.post(can.Message(arbitration_id=number, is_extended_id=False), within_s=0.15)
    received = [port.receive(0.5) for _ in range(50)]
    assert time.now_s - began_s < 0.1
    assert all(message is FRAME for message in received)
    assert port.unsent == 0
    bus._sending = None
    pump(port, 0.05)
    assert [each.arbitration_id for each in bus.sent] == list(range(10))
    bus._sending = full
    for _ in range(3):
        port.post(FRAME, within_s=0.05)
    pump(port, 0.2)
    assert (port.unsent, len(bus.sent), port.losses) == (3, 10, 0)
