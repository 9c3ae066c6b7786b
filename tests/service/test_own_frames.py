"""Own frames come back late where frames wait, and the end says what was published last."""

from __future__ import annotations

import can

from cangauge.estimation.settings import EstimatorSettings
from cangauge.service.own_frames import OwnFrames
from cangauge.service.pipeline import PipelineSettings
from cangauge.types import Reason
from live import frames_of, short_log, virtual_port, virtual_service, waits


def own_frame(number: int) -> can.Message:
    data = number.to_bytes(4, "big")
    return can.Message(arbitration_id=0x5A0, is_extended_id=False, data=data)


def test_echoes_are_awaited_until_the_queue_was_empty_however_many_they_are() -> None:
    own = OwnFrames(echoes=True)
    for number in range(5000):
        own.note_sent(own_frame(number), 0.001 * number)
    assert all(own.is_echo(own_frame(number)) for number in range(100))
    own.forget(10.0)
    assert not own.is_echo(own_frame(5000 - 1025))
    assert own.is_echo(own_frame(5000 - 1024))  # a controller without an acknowledgement waits


def test_the_end_after_a_silence_says_that_the_estimate_is_stale() -> None:
    known = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    service = virtual_service("silent end", known, timeout_s=0.2)
    with virtual_port("silent end") as port, service:
        for frame in frames_of(short_log(1.0)):
            port.send(frame)
        assert waits(lambda: service.pipeline.published_samples > 0)
        assert waits(lambda: bool(service.pipeline.published.reasons & Reason.INPUT_STALE))
    found = service.monitor.final()
    assert (found["status"], "input_stale" in found["reasons"]) == ("invalid", True)
