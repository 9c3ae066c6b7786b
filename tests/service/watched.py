"""A pipeline, a port and a monitor over it, without a bus."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from cangauge.bus.open import BusAddress
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.settings import EstimatorSettings
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.status import Monitor
from live import frames_of, leaf_model, short_log


@dataclass
class StandInPort:
    """The counts of a port."""

    name: str = "virtual x"
    garbled: int = 1
    error_frames: int = 2
    unsent: int = 3
    queue_drops: int | None = 4
    is_off: bool = False
    address: BusAddress = field(default_factory=lambda: BusAddress("pcan", "x"))


@dataclass
class Watched:
    now_s: float = 100.0
    port: Any = field(default_factory=StandInPort)

    def __post_init__(self) -> None:
        known = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
        self.pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), known)
        self.monitor = Monitor(
            self.pipeline,
            self.port,
            "leaf.json",
            clock=lambda: self.now_s,
        )

    @property
    def status(self) -> dict[str, Any]:
        return self.monitor.latest.at(self.now_s)

    def drive(self, seconds: float) -> None:
        """Handle the frames of a drive, publishing as the loop does."""
        for frame in frames_of(short_log(seconds)):
            if self.pipeline.handle(frame):
                self.monitor.stepped(frame.timestamp, 30e-6, self.now_s)
        self.pipeline.heartbeat()

    def turn(self, later_s: float = 1.0) -> None:
        self.now_s += later_s
        self.monitor.update(self.now_s)
