"""Housekeeping: saving the state, and reporting dropped frames."""

from __future__ import annotations

import errno
from dataclasses import dataclass, field

import pytest

from cangauge.bus.connection import BusConnection, BusError
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import CangaugeError
from cangauge.estimation.offline import samples_of
from cangauge.service.loop import Housekeeping, LoopSettings, Outputs, serve
from live import BrokenBus, LoggedLines, network_down, short_log, virtual_port, virtual_service


@dataclass
class Saves:
    error: Exception | None = None
    samples: list[int] = field(default_factory=list)


def run(channel: str, saves: Saves, every_s: float = 0.2) -> list[str]:
    """Serve 5 s of a log for 0.7 s, and note how many samples each save has seen."""
    service = virtual_service(channel)

    def checkpoint() -> None:
        saves.samples.append(service.pipeline.samples)
        if saves.error is not None:
            raise saves.error

    encoder = FrameEncoder(Vehicle.load("generic"))
    with virtual_port(channel) as sender, service.port:
        for sample in samples_of(short_log(5.0)):
            for frame in encoder.encode(sample):
                sender.send(frame)
        with LoggedLines("cangauge.service.loop") as logged:
            serve(
                service.port,
                service.pipeline,
                LoopSettings(duration_s=0.7, checkpoint_every_s=every_s),
                Outputs(checkpoint=checkpoint),
                lambda: False,
            )
            warnings = list(logged.lines)
    return warnings


def test_the_state_is_saved_now_and_then_and_at_the_end() -> None:
    saves = Saves()
    assert run("saves", saves) == []
    assert 2 <= len(saves.samples) <= 4
    assert saves.samples[-1] == 50
    rare = Saves()
    run("seldom", rare, every_s=30.0)
    assert rare.samples == [50]  # at the end alone


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), CangaugeError("disk full")]
)
def test_a_state_that_cannot_be_saved_is_a_warning(error: Exception) -> None:
    saves = Saves(error)
    warnings = run(f"full disk {error}", saves)
    assert len(saves.samples) >= 3
    assert len(warnings) == 1  # a second has not passed
    assert "could not be saved" in warnings[0]


def test_the_state_is_saved_also_when_the_service_breaks() -> None:
    saved = []
    pipeline = virtual_service("breaks").pipeline
    port = BusConnection(BrokenBus([network_down()]), "fake")  # type: ignore[arg-type] # has what is used
    with pytest.raises(BusError):
        serve(
            port,
            pipeline,
            LoopSettings(),
            Outputs(checkpoint=lambda: saved.append(1)),
            lambda: False,
        )
    assert saved == [1]


def test_frames_lost_in_the_receive_queue_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    class Port:
        name = "socketcan can9"
        queue_drops: int | None = None

    port = Port()
    upkeep = Housekeeping(port)  # type: ignore[arg-type] # all that is looked at
    upkeep.run(1.0)
    port.queue_drops = 7
    upkeep.run(1.05)  # too soon to look
    assert not caplog.messages
    upkeep.run(1.2)
    assert caplog.messages == [
        "socketcan can9: the receive queue overflowed: 7 frames lost (7 so far)"
    ]
    upkeep.run(2.0)
    assert len(caplog.messages) == 1
