"""The loop on a simulated port and clock: no time passes."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import can
import pytest

from cangauge.bus.open import BusAddress
from cangauge.bus.publish import SocReader
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service import loop
from cangauge.service.config import RunConfig
from cangauge.service.loop import Loop
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.types import Sample
from live import leaf_model, loop_config, never

BEGAN_S = 5000.0
EPOCH_S = 1.7e9
GIVEN = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
"""A start: drives of seconds have no block of voltages."""


def estimate_in(reader: SocReader, frame: can.Message) -> SimpleNamespace | None:
    """Return the values of a SOC_ESTIMATE; None for other frames."""
    name, values = reader.read(frame)
    if name != "soc_estimate":
        return None
    return SimpleNamespace(**values, reasons=values["reason"])


class SimulatedPort:
    """Port and clock in one: receiving advances the clock to the next frame or the time-out.

    Parameters
    ----------
    frames : list of (float, can.Message)
        Frames and when they arrive [s since the beginning].
    """

    address = BusAddress("pcan", "x")
    queue_drops = None
    name = "simulated"

    def __init__(self, frames: list[tuple[float, can.Message]]) -> None:
        self.now_s = BEGAN_S
        self._frames = [(BEGAN_S + at_s, frame) for at_s, frame in frames]
        self.sent: list[tuple[float, can.Message]] = []
        self.work_s: Callable[[float], float] = lambda _: 0.0
        self.suspended_s: tuple[float, float] | None = None

    @property
    def since_s(self) -> float:
        return self.now_s - BEGAN_S

    @property
    def is_drained(self) -> bool:
        return not self._frames or self._frames[0][0] > self.now_s

    def receive_pending(self, timeout_s: float) -> list[can.Message]:
        if self.suspended_s is not None and self.since_s >= self.suspended_s[0]:
            self.now_s += self.suspended_s[1]
            self.suspended_s = None
        work_s = self.work_s(self.since_s)
        if self._frames and self._frames[0][0] <= self.now_s + timeout_s:
            at_s, frame = self._frames.pop(0)
            self.now_s = max(self.now_s, at_s) + work_s
            return [frame]
        self.now_s += max(timeout_s, 1e-6)
        return []

    def post(self, frame: can.Message, _within_s: float) -> None:
        self.sent.append((self.since_s, frame))

    def set_filters(self, _filters: object) -> None:
        pass

    @property
    def published(self) -> list[tuple[float, SimpleNamespace]]:
        """The values of each SOC_ESTIMATE, and when it was sent [s]."""
        reader = SocReader()
        read = [(at_s, estimate_in(reader, frame)) for at_s, frame in self.sent]
        return [(at_s, values) for at_s, values in read if values is not None]


def frames_every(
    step_s: float,
    until_s: float,
    from_s: float = 0.0,
    stamp: Callable[[float], float] = lambda at_s: EPOCH_S + at_s,
) -> list[tuple[float, can.Message]]:
    """Return frames of a steady current, with the stamp of each arrival."""
    encoder = FrameEncoder(Vehicle.load("generic"))
    times = [from_s + number * step_s for number in range(round((until_s - from_s) / step_s))]
    return [
        (at_s, frame)
        for at_s in times
        for frame in encoder.encode(Sample(stamp(at_s), 10.0, 370.0, 20.0))
    ]


def simulate(
    port: SimulatedPort,
    config: RunConfig | float,
    pipeline: Pipeline | None = None,
    **more: Any,
) -> SimulatedPort:
    """Run the loop on a simulated port, as configured or for a duration [s]; return the port."""
    clock = SimpleNamespace(
        monotonic=lambda: port.now_s,
        time=lambda: EPOCH_S + port.since_s,
        process_time=time.process_time,
    )
    if isinstance(config, float):
        config = loop_config(duration_s=config)
    pipeline = pipeline or Pipeline(Vehicle.load("generic"), leaf_model(), GIVEN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "time", clock)
        patch.setattr(loop, "steady_s", lambda: port.now_s)
        Loop(port, pipeline, config, **more).run(never)  # type: ignore[arg-type] # has what is used
    return port
