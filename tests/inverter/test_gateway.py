"""The gateway to an inverter: only the SoC is replaced, only while it is valid and current."""

from __future__ import annotations

import errno
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.open import BusAddress
from cangauge.bus.reconnecting import ReconnectingBus
from cangauge.errors import InputError
from cangauge.extras.inverter.gateway import DOUBT_S, Gateway, make_output, soc_fields
from cangauge.service.run import Service
from cangauge.service.status_client import Snapshot
from cangauge.types import Estimate, Reason, Sample, Status
from live import BrokenBus, LoggedLines, leaf_model_path, waits
from running import RunningService

SAMPLE = Sample(0.0, 1.0, 50.0, 20.0)
NO_ESTIMATE = Estimate(*[0.0] * 7, Status.VALID, Reason.NONE, 1)
# Recorded from two US5000 of Pylontech, of protocol 1.2 and 1.3
# (setfirelabs.com, "Pylontech battery CAN comms v1.2 vs v1.3").
V12 = {
    0x351: "1402C012C012C201", 0x355: "58005E00", 0x356: "7A13F2FE6B01", 0x359: "0000000006504E",
    0x35C: "C000", 0x35E: "50594C4F4E202020",
}  # fmt: skip
V13 = {
    0x351: "1002C012C012C201", 0x355: "540060000000", 0x356: "7B13E9FE6B01",
    0x35A: "0000000000000000", 0x35E: "50594C4F4E202020", 0x35F: "4C4901033C02AA00",
}  # fmt: skip


def opened(bus: BrokenBus) -> ReconnectingBus:
    found = ReconnectingBus(BusAddress("virtual", "broken"), [], lambda *_: bus)
    found.open()
    return found


def frame(number: int, data: str | bytes) -> can.Message:
    payload = bytes.fromhex(data) if isinstance(data, str) else data
    return can.Message(arbitration_id=number, is_extended_id=False, data=payload)


def snapshot(soc_pct: float | None, status: str = "valid") -> Snapshot:
    return Snapshot(time.monotonic(), {"status": status, "estimate": {"soc_pct": soc_pct}})


def gateway(name: str, profile: str = "pylontech") -> Gateway:
    buses = [ReconnectingBus(BusAddress("virtual", f"{name} {side}"), []) for side in "bi"]
    for bus in buses:
        bus.open()
    return Gateway(*buses, soc_fields(profile), lambda: frozenset({0x5A0}))


@pytest.fixture
def pylon(request: pytest.FixtureRequest) -> Iterator[Gateway]:
    with closing(gateway(request.node.name)) as found:
        yield found


def confirm(found: Gateway, soc_pct: float | None, status: str = "valid") -> None:
    for _ in range(3):
        found.on_sample(SAMPLE, NO_ESTIMATE)
    found.on_snapshot(snapshot(soc_pct, status))


@pytest.mark.parametrize("frames", [V12, V13])
def test_only_the_soc_of_recorded_frames_is_replaced(
    pylon: Gateway, frames: dict[int, str]
) -> None:
    confirm(pylon, 71.6)
    for number, data in frames.items():
        told = pylon.replaced(frame(number, data), time.monotonic())
        assert told.arbitration_id == number
        if number != 0x355:
            assert bytes(told.data) == bytes.fromhex(data)
            continue
        # Read as the public description of the protocol says, without the DBC.
        soc, *rest = struct.unpack(f"<{len(told.data) // 2}H", bytes(told.data))
        assert soc == 72
        assert rest == list(struct.unpack(f"<{len(rest)}H", bytes.fromhex(data)[2:]))


def test_the_soc_of_a_high_voltage_battery_is_replaced(pylon: Gateway) -> None:
    confirm(pylon, 71.6)
    data = bytes.fromhex("A00F30754C04585E")
    own = can.Message(arbitration_id=0x4210, is_extended_id=True, data=data)
    told = pylon.replaced(own, time.monotonic())
    assert (told.arbitration_id, told.is_extended_id) == (0x4210, True)
    assert bytes(told.data) == data[:6] + bytes([72]) + data[7:]
    short = frame(0x210, data)
    assert pylon.replaced(short, time.monotonic()).data == data


def test_frames_that_waited_while_the_gateway_was_stopped_are_dropped(tmp_path: Path) -> None:
    buses = [ReconnectingBus(BusAddress("virtual", f"{tmp_path} {side}"), []) for side in "bi"]
    for bus in buses:
        bus.open()
    with (
        can.Bus(f"{tmp_path} b", interface="virtual") as battery,
        can.Bus(f"{tmp_path} i", interface="virtual") as inverter,
        LoggedLines("cangauge.extras.inverter") as lines,
    ):
        battery.send(frame(0x351, V12[0x351]))
        time.sleep(1.1 * DOUBT_S)
        with closing(Gateway(*buses, soc_fields("pylontech"))):
            assert waits(lambda: "longer than 0.5 s" in " ".join(lines.lines))
            battery.send(frame(0x356, V12[0x356]))
            came = inverter.recv(10.0)
            assert came is not None
            assert came.arbitration_id == 0x356


def test_frames_behind_one_at_which_the_process_was_stopped_are_dropped() -> None:
    class Stopped(Gateway):
        def replaced(self, frame: can.Message, now_s: float) -> can.Message:
            time.sleep(1.1 * DOUBT_S)
            return super().replaced(frame, now_s)

    now_s, told = time.time(), BrokenBus([])
    came = [can.Message(now_s, 0x351, is_extended_id=False, data=bytes(8)) for _ in range(3)]
    found = Stopped.__new__(Stopped)
    found._battery, found._inverter = opened(BrokenBus([*came])), opened(told)
    found._fields, found._own_ids = soc_fields("pylontech"), frozenset
    found._ever_own, found._without_fd = set(), []
    found._hand_on_pending()
    assert len(told.sent) == 1


@pytest.mark.parametrize(
    ("soc_pct", "told_pct"), [(99.4, 99), (99.5, 99), (99.99, 99), (100.0, 100)]
)
def test_rounding_does_not_end_a_charge(pylon: Gateway, soc_pct: float, told_pct: int) -> None:
    confirm(pylon, soc_pct)
    told = pylon.replaced(frame(0x355, V12[0x355]), time.monotonic())
    assert struct.unpack("<2H", bytes(told.data)) == (told_pct, 94)


def test_a_gx_gets_the_fine_soc_where_the_frame_holds_it() -> None:
    with closing(gateway("gx", "victron")) as found:
        confirm(found, 71.64)
        told = found.replaced(frame(0x355, "58005E0060220000"), time.monotonic())
        assert struct.unpack("<4H", bytes(told.data)) == (72, 94, 7164, 0)
        short = found.replaced(frame(0x355, "58005E00"), time.monotonic())
        assert struct.unpack("<2H", bytes(short.data)) == (72, 94)


@pytest.mark.parametrize("status", ["initialising", "degraded", "invalid"])
def test_the_batterys_own_soc_passes_unless_valid(pylon: Gateway, status: str) -> None:
    own = frame(0x355, V12[0x355])
    assert pylon.replaced(own, time.monotonic()).data == own.data  # nothing known yet
    confirm(pylon, 71.6)
    assert pylon.replaced(own, time.monotonic()).data != own.data
    assert pylon.trouble == ""
    confirm(pylon, 71.6, status)
    assert pylon.replaced(own, time.monotonic()).data == own.data
    assert "own SoC" in pylon.trouble
    confirm(pylon, None)
    assert pylon.replaced(own, time.monotonic()).data == own.data


def test_what_is_not_confirmed_is_not_sent(pylon: Gateway) -> None:
    now_s = time.monotonic()
    confirm(pylon, 71.6)
    assert pylon.soc_pct(now_s + 0.9 * DOUBT_S) == 71.6
    assert pylon.soc_pct(now_s + 1.2 * DOUBT_S) is None  # the service hangs, or samples end
    pylon.on_snapshot(Snapshot(now_s + 60.0, snapshot(71.6).status))
    assert pylon.soc_pct(now_s + 60.1) is None  # it turns, but no samples come


def test_a_frame_that_waits_for_room_is_not_sent_long_after_a_doubt() -> None:
    class Full(BrokenBus):
        is_full = True

        def send(self, message: can.Message) -> None:
            if self.is_full:
                raise can.CanOperationError("full", errno.ENOBUFS)
            super().send(message)

    full, own = Full([]), frame(0x355, V12[0x355])
    battery, inverter = opened(BrokenBus([])), opened(full)
    found = Gateway.__new__(Gateway)
    found._battery, found._inverter, found._without_fd = battery, inverter, []
    found._hand_on(own, inverter)
    time.sleep(1.2 * DOUBT_S)
    full.is_full = False
    inverter.receive_pending(0.0)
    assert not full.sent
    found._hand_on(own, inverter)
    assert len(full.sent) == 1


def test_a_gap_does_not_make_silence_last(pylon: Gateway) -> None:
    for time_s in (0.0, 0.1, 0.2, 2.1):
        pylon.on_sample(SAMPLE._replace(time_s=time_s), NO_ESTIMATE)
    now_s = time.monotonic()
    pylon.on_snapshot(Snapshot(now_s + 60.0, snapshot(71.6).status))
    assert pylon.soc_pct(now_s + 0.1 + 0.9 * DOUBT_S) == 71.6
    assert pylon.soc_pct(now_s + 0.1 + 1.2 * DOUBT_S) is None


@given(st.binary(max_size=8), st.floats(-1e3, 1e3), st.sampled_from(["pylontech", "victron"]))
def test_any_frame_keeps_all_other_bits(data: bytes, soc_pct: float, profile: str) -> None:
    found = Gateway.__new__(Gateway)
    found._fields, found._replaces = soc_fields(profile), True
    found._soc, found._current_until_s = (soc_pct, 1.0), 1.0
    told = bytes(found.replaced(frame(0x355, data), 0.5).data)
    whole = min(max(soc_pct, 0.0), 100.0)
    wanted = bytearray(data)
    if len(data) >= 2:
        wanted[:2] = struct.pack("<H", round(whole))
    if len(data) >= 6 and profile == "victron":
        wanted[4:6] = struct.pack("<H", round(whole / 0.01))
    assert told == bytes(wanted)


def test_frames_are_handed_on_both_ways(pylon: Gateway, request: pytest.FixtureRequest) -> None:
    name = request.node.name
    with (
        can.Bus(interface="virtual", channel=f"{name} b") as battery,
        can.Bus(interface="virtual", channel=f"{name} i") as inverter,
    ):
        battery.send(frame(0x5A0, b"ours"))
        for number, data in V12.items():
            battery.send(frame(number, data))
        seen = [inverter.recv(2.0) for _ in V12]
        assert {m.arbitration_id: bytes(m.data).hex().upper() for m in seen if m} == V12
        inverter.send(frame(0x305, bytes(8)))
        alive = battery.recv(2.0)
        assert alive is not None
        assert alive.arbitration_id == 0x305
        assert inverter.recv(0.1) is None  # nothing comes back, nothing of the service
        extended = can.Message(arbitration_id=0x5A0, data=b"other")
        battery.send(extended)
        told = inverter.recv(2.0)
        assert told is not None
        assert told.equals(extended, timestamp_delta=None, check_channel=False)


def test_a_frame_that_a_bus_cannot_carry_costs_nothing_else(
    pylon: Gateway, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    def send(bus: can.BusABC, message: can.Message, timeout: float | None = None) -> None:
        if message.is_fd and bus.channel_info.endswith(" i"):
            raise can.CanOperationError("cannot send FD message over bus with CAN FD disabled")
        as_before(bus, message, timeout)

    name, virtual = request.node.name, type(pylon._battery._bus)
    as_before = virtual.send
    monkeypatch.setattr(virtual, "send", send)
    with (
        LoggedLines("cangauge.extras.inverter") as log,
        can.Bus(interface="virtual", channel=f"{name} b") as battery,
        can.Bus(interface="virtual", channel=f"{name} i") as inverter,
    ):
        for number in range(20):
            battery.send(can.Message(arbitration_id=0x7FF, is_fd=True, data=bytes(12)))
            battery.send(frame(0x351, bytes([number])))
        seen = [inverter.recv(2.0) for _ in range(20)]
        assert [m.data[0] for m in seen if m] == list(range(20))
        pylon.close()
    dropped, unsent = log.lines
    assert "not open for CAN FD: frames such as 0x7FF are dropped" in dropped
    assert "20 frames could not be handed on" in unsent


def test_frames_for_a_bus_that_is_away_are_counted(pylon: Gateway) -> None:
    away = ReconnectingBus(BusAddress("virtual", "away"), [])
    with LoggedLines("cangauge.extras.inverter") as log:
        pylon._hand_on(can.Message(arbitration_id=0x7FF, is_fd=True, data=bytes(12)), away)
    assert (away.unsent, log.lines) == (1, [])


def test_what_the_service_sends_is_not_for_the_inverter(tmp_path: Path) -> None:
    publish = {"profile": "pylontech", "interface": "virtual", "channel": f"{tmp_path} i"}
    options = {"interface": "virtual", "channel": f"{tmp_path} b", "vehicle": "leaf_ze1_polled"}
    service = Service(
        model=str(leaf_model_path()), **options, publish=publish, poll={"every_s": 60.0}
    )
    with closing(make_output(service)) as found:
        asked = {each.request_id for each in service.pipeline.vehicle.poll_targets}
        assert asked
        assert waits(lambda: found._ever_own == {*range(0x5A0, 0x5A5), *asked})
        other = Service(
            model=str(leaf_model_path()), **options, publish=publish, ids={"soc_estimate": 0x6A0}
        )
        service.apply(other._setup)
        assert waits(lambda: found._ever_own == {*range(0x5A0, 0x5A5), 0x6A0, *asked})


@pytest.mark.parametrize(
    ("battery", "inverter", "options", "problem"),
    [
        (("virtual", "one"), ("virtual", "one"), {}, "battery's bus"),
        (("virtual", "one"), ("udp_multicast", "239.74.163.9"), {}, "go round for ever"),
        (("udp_multicast", "239.74.163.9"), ("virtual", "one"), {}, "go round for ever"),
        (("virtual", "b"), ("virtual", "i"), {"time_source": "replay-clock"}, "SoC of a replay"),
        (
            ("virtual", "b"), ("virtual", "i"),
            {"bus_options": {"receive_own_messages": True}}, "go round for ever",
        ),
    ],
)  # fmt: skip
def test_buses_that_cannot_be_joined_are_refused(
    battery: tuple[str, str], inverter: tuple[str, str], options: dict[str, Any], problem: str
) -> None:
    names = ("interface", "channel")
    publish = {"profile": "pylontech", **dict(zip(names, inverter, strict=True))}
    bus = dict(zip(names, battery, strict=True))
    with pytest.raises(InputError, match=problem) as caught:
        Service(model=str(leaf_model_path()), **bus, **options, publish=publish)
    assert caught.value.field == ("time_source" if "time_source" in options else "publish.channel")


def test_a_gateway_that_fails_says_so(request: pytest.FixtureRequest) -> None:
    class Broken(ReconnectingBus):
        def post(self, *_: object) -> None:
            raise ValueError("no such controller")

    name = request.node.name
    battery, inverter = (
        kind(BusAddress("virtual", f"{name} {side}"), [])
        for kind, side in ((ReconnectingBus, "b"), (Broken, "i"))
    )
    battery.open()
    inverter.open()
    with (
        LoggedLines("cangauge.extras.inverter") as log,
        closing(Gateway(battery, inverter, soc_fields("pylontech"))) as found,
        can.Bus(interface="virtual", channel=f"{name} b") as bus,
    ):
        bus.send(frame(0x351, V12[0x351]))
        assert waits(lambda: "no such controller" in found.trouble)
        assert log.lines == [f"warning: {found.trouble}"]


@pytest.mark.nightly  # VALID once the delay line is full: 70 s
def test_a_service_tells_the_inverter_its_soc_and_stops_in_silence(tmp_path: Path) -> None:
    text = f'[publish]\nprofile = "pylontech"\ninterface = "virtual"\nchannel = "{tmp_path}"\n'
    told: list[tuple[float, int]] = []
    over = threading.Event()
    with (
        RunningService(tmp_path, text) as running,
        can.Bus(interface="virtual", channel=str(tmp_path)) as inverter,
        can.Bus(interface="virtual", channel=tmp_path.name) as battery,
    ):

        def listen() -> None:
            while not over.is_set():
                message = inverter.recv(0.1)
                if message is not None and message.arbitration_id == 0x355:
                    told.append((time.monotonic(), struct.unpack_from("<H", message.data)[0]))

        def send() -> None:
            while not over.wait(0.05):
                battery.send(frame(0x355, "0B005E00"))  # the battery itself says 11 %

        threads = [threading.Thread(target=each) for each in (listen, send)]
        for thread in threads:
            thread.start()
        try:
            assert waits(lambda: any(soc == 79 for _, soc in told))
            running.silent.set()
            silent_s = time.monotonic()
            assert waits(lambda: told[-1][1] == 11)
            last_s = max(at for at, soc in told if soc == 79)
            assert last_s - silent_s < DOUBT_S + 0.3  # a sample may be under way
        finally:
            over.set()
            for thread in threads:
                thread.join()
    assert {soc for _, soc in told} == {11, 79}
