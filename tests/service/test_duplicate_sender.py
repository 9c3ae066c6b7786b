"""Two services with the same ids on one bus, and a bus that echoes own frames."""

from __future__ import annotations

import os
import time

import can
import pytest

from cangauge.bus.backend import backend_capabilities
from cangauge.bus.connection import BusConnection
from cangauge.bus.open import bus_address, open_bus
from cangauge.bus.publish import FrameIds
from cangauge.bus.vehicle import Vehicle
from cangauge.service.loop import DUPLICATE_WARN_EVERY_S, DuplicateSenderDetector
from cangauge.service.pipeline import Pipeline, PipelineSettings
from live import Service, leaf_model, virtual_service, waits

OTHER_IDS = PipelineSettings(
    ids=FrameIds(0x5B0, 0x5B1, soc_health=0x5B2, soc_power=0x5B3, soc_cells=0x5B4)
)


def frame(frame_id: int = 0x5A0, data: bytes = b"12345678") -> can.Message:
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=data)


def test_two_services_warn_of_each_other_once() -> None:
    with virtual_service("rivals") as one, virtual_service("rivals") as two:
        assert waits(lambda: bool(one.warnings) and bool(two.warnings))
        time.sleep(0.5)
    for service in (one, two):
        assert len(service.warnings) == 1
        assert "0x5A" in service.warnings[0]
        assert "--soc-estimate-id" in service.warnings[0]
        assert service.summary is not None
        assert service.summary.foreign_frames >= 3
        assert service.pipeline.counts.frames == 0  # they are not input


def test_services_with_other_ids_do_not_warn() -> None:
    with virtual_service("peers") as one, virtual_service("peers", OTHER_IDS) as two:
        time.sleep(0.8)
    assert one.warnings == two.warnings == []
    assert one.summary is not None
    assert one.summary.foreign_frames == 0


def multicast_service(port: int) -> Service:
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    address = bus_address("udp_multicast", options={"port": port})
    bus = open_bus(address, pipeline.filters)
    return Service(BusConnection(bus, str(address), backend_capabilities(address)), pipeline)


def test_own_echoes_are_recognised() -> None:
    port = 20_000 + (os.getpid() + 7919) % 20_000
    with multicast_service(port) as alone:
        time.sleep(1.0)
        assert alone.warnings == []
        with multicast_service(port) as second:
            assert waits(lambda: bool(alone.warnings) and bool(second.warnings))
    assert "sends 0x5A" in alone.warnings[0]


@pytest.mark.parametrize("echoes", [False, True])
def test_identical_foreign_frames_are_noticed(
    echoes: bool, caplog: pytest.LogCaptureFixture
) -> None:
    detector = DuplicateSenderDetector(FrameIds(), echoes=echoes)
    for number in range(4):
        mine = frame(data=bytes([number] * 8))
        detector.note_sent(mine)
        if echoes:
            assert detector.handle(mine, 1.0 + number)
        assert detector.handle(frame(data=bytes([number] * 8)), 1.0 + number)
    assert detector.frames == 4
    assert len(caplog.messages) == 1


def test_single_frame_is_ignored_and_warning_repeats(
    caplog: pytest.LogCaptureFixture,
) -> None:
    detector = DuplicateSenderDetector(FrameIds(), echoes=False)
    for time_s in (0.0, 10.0, 20.0):
        assert detector.handle(frame(), time_s)
    assert caplog.messages == []
    assert not detector.handle(frame(0x1DB), 20.0)
    assert not detector.handle(can.Message(arbitration_id=0x5A0, is_extended_id=True), 20.0)
    for number in range(20_000):
        detector.handle(frame(0x5A1), 30.0 + 0.1 * number)
    assert len(caplog.messages) == 1 + 2000.0 // DUPLICATE_WARN_EVERY_S


def test_lost_echo_is_no_foreign_frame() -> None:
    detector = DuplicateSenderDetector(FrameIds(), echoes=True)
    for number in range(200):
        detector.note_sent(frame(data=bytes([number] * 8)))
        if number % 3:
            detector.handle(frame(data=bytes([number] * 8)), 0.1 * number)
    assert detector.frames == 0
