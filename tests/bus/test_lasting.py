"""A bus that goes and comes back: what is done, how often, what it costs, what is said."""

from __future__ import annotations

import errno
import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import can
import pytest
from can.typechecking import CanFilter

from cangauge.bus import reconnect as lasting
from cangauge.bus.open import BusAddress, DriverMissingError, open_bus
from cangauge.bus.publish import standard_filter
from cangauge.bus.reconnect import FIRST_PAUSE_S, LONGEST_PAUSE_S, ReconnectingBus
from cangauge.errors import InputError
from live import BrokenBus, LoggedLines, network_down, unpack_error

ADDRESS = BusAddress("socketcan", "can9")
FRAME = can.Message(arbitration_id=0x123, is_extended_id=False, data=b"12345678")


class Opener:
    """Opens buses from a script: a bus, or an error to raise; the last one again and again."""

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
def lines() -> Iterator[list[str]]:
    with LoggedLines("cangauge.bus.reconnect") as logged:
        yield logged.lines


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
def test_a_lost_bus_is_closed_and_opened_again_with_its_filters(
    error: BaseException, lines: list[str]
) -> None:
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
    assert len(lines) == 1  # that it is back comes a second later
    assert lines[0].startswith("warning: socketcan can9: receiving failed: ")
    assert pump(port, 1.2) == []
    assert len(lines) == 2
    assert lines[1].startswith("socketcan can9: back after 0.")
    port.close()
    assert second.closed == 1


def test_a_send_that_fails_is_a_loss_too_and_frames_meanwhile_are_counted(lines: list[str]) -> None:
    opener = Opener(BrokenBus([], sending=network_down()), missing())
    port = port_on(opener)
    port.post(FRAME)
    assert (port.losses, port.unsent) == (1, 1)
    began_s = time.monotonic()
    for _ in range(1000):
        port.post(FRAME)
    assert time.monotonic() - began_s < 0.1
    assert port.unsent == 1001
    assert "sending failed" in lines[0]
    port.close()


def test_one_bad_packet_is_no_loss() -> None:
    port = port_on(Opener(BrokenBus([unpack_error(), FRAME])))
    assert len(pump(port, 0.1)) == 1
    assert (port.garbled, port.losses) == (1, 0)


def test_pauses_grow_to_a_ceiling_and_start_small_after_a_steady_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(lasting, "LONGEST_PAUSE_S", 0.4)
    monkeypatch.setattr(lasting, "STEADY_S", 0.3)
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


def test_a_bus_that_opens_and_fails_at_once_costs_little_and_says_little(lines: list[str]) -> None:
    opener = Opener(lambda: BrokenBus([network_down()]))
    port = port_on(opener)
    cpu_s = time.process_time()
    pump(port, 3.0)
    assert time.process_time() - cpu_s < 0.3
    # 0.05 + 0.1 + 0.2 + 0.4 + 0.8 s, then once a second.
    assert 4 <= port.losses <= 8
    assert len(lines) <= 4
    port.close()


def test_a_driver_that_hangs_while_opening_stops_nothing() -> None:
    free = threading.Event()
    late = BrokenBus([])

    def hang() -> BrokenBus:
        free.wait(10.0)
        return late

    port = port_on(Opener(BrokenBus([network_down()]), hang))
    pump(port, 0.2)
    began_s = time.monotonic()
    assert port.receive(0.05) is None
    assert time.monotonic() - began_s < 0.2
    port.close()
    assert time.monotonic() - began_s < 0.4
    free.set()
    end_s = time.monotonic() + 2.0
    while not late.closed and time.monotonic() < end_s:
        time.sleep(0.01)
    assert late.closed == 1  # nobody wants it any more


def test_a_bus_that_is_not_there_at_the_start(lines: list[str]) -> None:
    with pytest.raises(InputError, match="no such bus"):
        port_on(Opener(missing()))
    opener = Opener(missing(), missing(), BrokenBus([FRAME]))
    port = port_on(opener, wait=True)
    assert port.is_away
    assert port.trouble.startswith("bus away for ")
    port.post(FRAME)
    received = pump(port, 2.0, until=lambda: not port.is_away)
    received += pump(port, 0.1)
    assert len(received) == 1
    assert (port.losses, port.unsent, port.trouble) == (0, 1, "")
    assert "waiting for it" in lines[0]
    pump(port, 1.2)
    assert "there after" in lines[1]
    port.close()


def test_what_no_waiting_brings_ends_at_once() -> None:
    opener = Opener(DriverMissingError("a library for this interface is missing"))
    with pytest.raises(InputError, match="library"):
        port_on(opener, wait=True)
    with pytest.raises(DriverMissingError):
        open_bus(BusAddress("pcan", "PCAN_USBBUS1"))


def test_while_it_is_away_it_is_mentioned_now_and_then(
    monkeypatch: pytest.MonkeyPatch, lines: list[str]
) -> None:
    monkeypatch.setattr(lasting, "REMIND_S", 1.5)
    monkeypatch.setattr(lasting, "LONGEST_PAUSE_S", 0.1)
    port = port_on(Opener(BrokenBus([network_down()]), missing()))
    pump(port, 3.6)
    assert 3 <= len(lines) <= 4  # lost; 1.5 s; 3 s
    assert "away for 2 s (--channel: no such bus" in lines[1]
    port.close()


@pytest.mark.skipif(sys.platform != "linux", reason="counts /proc/self/fd")
def test_opening_in_vain_for_long_leaks_nothing() -> None:
    nowhere = BusAddress("socketcan", "nosuch0")
    before = threading.active_count()
    for _ in range(300):
        with pytest.raises(InputError):
            open_bus(nowhere)
    assert len(list(Path("/proc/self/fd").iterdir())) < 100
    assert threading.active_count() < before + 20


def test_bus_off_is_told_and_so_is_its_end(lines: list[str]) -> None:
    def error_frame(classes: int) -> can.Message:
        return can.Message(
            arbitration_id=classes, is_extended_id=False, is_error_frame=True, data=bytes(8)
        )

    bus = BrokenBus([error_frame(0x080), error_frame(0x040)])
    port = port_on(Opener(bus))
    assert pump(port, 0.1) == []
    assert port.error_frames == 2
    assert port.error_kinds == {"bus_error": 1, "bus_off": 1}
    assert port.is_off
    assert port.trouble == "bus-off"
    assert "restart-ms" in lines[0]
    bus._receiving.append(error_frame(0x100))
    pump(port, 0.1)
    assert not port.is_off
    bus._receiving += [error_frame(0x040), FRAME]
    assert len(pump(port, 0.1)) == 1  # who receives is not off, whatever was told
    assert not port.is_off
    pump(port, 1.1)
    assert "no longer bus-off" in lines[-1]
    assert port.losses == 0


def test_a_full_transmit_queue_never_waits_and_keeps_order() -> None:
    full = can.CanOperationError("Failed to transmit: No buffer space", errno.ENOBUFS)
    bus = BrokenBus([FRAME] * 50, sending=full)
    port = port_on(Opener(bus))
    began_s = time.monotonic()
    for number in range(10):
        port.post(can.Message(arbitration_id=number, is_extended_id=False), within_s=0.15)
    received = [port.receive(0.5) for _ in range(50)]
    assert time.monotonic() - began_s < 0.1
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


def test_the_ceiling_is_short_enough_for_a_pack_under_load() -> None:
    assert LONGEST_PAUSE_S < 2.0  # else every loss would be a gap for the delay line
