"""Another sender on the bus: of the ids that the service sends, or of those that it reads."""

from __future__ import annotations

import os
import time
from pathlib import Path

import can
import pytest

from cangauge.bus.connection import BusConnection
from cangauge.bus.decoder import SUSPECTED_FOR_S
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.open import backend_capabilities, bus_address, open_bus
from cangauge.bus.publish import FrameIds
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.live.metrics import Exposition
from cangauge.service.lifecycle import Notifier
from cangauge.service.loop import DUPLICATE_WARN_EVERY_S, DuplicateSenderDetector
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.recording import Recorder
from cangauge.service.status import Identity, Monitor, as_json
from cangauge.types import Reason, Status
from live import (
    Service,
    leaf_model,
    short_log,
    virtual_port,
    virtual_service,
    waits,
)

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
        assert service.pipeline.published.reasons & Reason.DUPLICATE_SENDER
        assert service.pipeline.published.status is not Status.VALID
        assert service.port.foreign == service.summary.foreign_frames  # type: ignore[union-attr] # not None
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


def test_other_sender_is_reported_for_a_while_only() -> None:
    detector = DuplicateSenderDetector(FrameIds(), echoes=False)
    for time_s in (1.0, 1.1):
        detector.handle(frame(), time_s)
        assert not detector.is_active(time_s)
    detector.handle(frame(), 1.2)
    assert detector.is_active(1.2)
    assert detector.is_active(1.2 + 0.9 * SUSPECTED_FOR_S)
    assert not detector.is_active(1.2 + 1.1 * SUSPECTED_FOR_S)


def forged_drive(seconds: float) -> list[can.Message]:
    """Return a drive with false frames between the true ones in its middle third."""
    vehicle = Vehicle.load("generic")
    encoder, false, out = FrameEncoder(vehicle), FrameEncoder(vehicle), []
    for sample in samples_of(short_log(seconds)):
        out += encoder.encode(sample)
        if seconds / 3.0 <= sample.time_s < 2.0 * seconds / 3.0:
            wrong = sample._replace(current_a=300.0, voltage_v=300.0, time_s=sample.time_s + 0.03)
            out += false.encode(wrong)
    return sorted(out, key=lambda each: each.timestamp)


def test_false_frames_do_not_move_the_soc() -> None:
    settings = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), settings, publishes=False)
    during, after = [], []
    for each in forged_drive(300.0):
        time_s = each.timestamp
        pipeline.handle(each)
        if 105.0 < time_s < 205.0:
            during.append(pipeline.estimate_now())
        elif time_s > 260.0:
            after.append(pipeline.estimate_now())
    assert all(each.reasons & Reason.DUPLICATE_SENDER for each in during)
    assert all(each.status is Status.INVALID for each in during)
    # 300 V alone would be an empty pack.
    assert max(abs(each.soc_pct - 79.0) for each in during) < 1.0
    assert all(abs(each.soc_pct - 77.2) < 3.0 * each.soc_std_pct for each in after)
    assert max(each.soc_std_pct for each in after) > 1.5 * during[0].soc_std_pct
    assert pipeline.counts.samples < 2200


def test_false_frames_are_logged_once_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    with (
        Recorder(path) as recorder,
        virtual_port("false") as car,
        virtual_service("false", record=recorder) as service,
    ):
        for each in forged_drive(12.0):
            car.send(each)
            time.sleep(0.005)
        assert waits(lambda: bool(service.warnings))
        time.sleep(0.3)
        monitor = Monitor(
            service.pipeline, service.port, identity=Identity("b", "v", "m", "ekf", "receive", 0.0),
            notifier=Notifier(),
        )  # fmt: skip
    names = [line for line in service.warnings if "two senders use the id" in line]
    assert sorted(line.split("id of ")[1].split(":")[0] for line in names) == [
        "PACK_CURRENT", "PACK_VOLTAGE",
    ]  # fmt: skip
    status = as_json(monitor.latest, monitor.latest.made_s)
    assert "duplicate_sender" in status["reasons"]
    assert status["rejects"]["two_senders"] > 0
    metrics = Exposition(lambda: monitor.latest).render("")[0].decode()
    assert 'cangauge_reason{reason="duplicate_sender"} 1.0' in metrics
    assert 'cangauge_rejects_total{reason="two_senders"}' in metrics
    assert "cangauge_bus_foreign_total" in metrics
    # The same frames give the same decisions offline.
    recorded = estimate_capture(path, Vehicle.load("generic"), leaf_model())
    assert recorded.table.soc_pct.tolist() == [each.soc_pct for _, each in service.rows]
    assert recorded.table.reasons.tolist() == [int(each.reasons) for _, each in service.rows]
