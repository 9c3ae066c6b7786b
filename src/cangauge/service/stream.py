"""Frames → estimates: the one path that a live bus and a recorded capture both take.

Pure: no bus, no clock, no files. The same frames with the same stamps give the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import can

from cangauge.bus.decode import SampleAssembler
from cangauge.bus.time_source import (
    REPLAY_CLOCK_ID,
    ReceiveTime,
    ReplayClock,
    TimeSourceName,
    is_clock,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.estimate.belief import Verdict
from cangauge.estimate.estimator import Estimator, EstimatorSettings
from cangauge.estimate.state import EstimatorState
from cangauge.estimate.types import Estimate, Reason, Sample, Status
from cangauge.model.model_file import ModelFile

NOTHING_YET: Final = Estimate(
    *(math.nan,) * 7, Status.INITIALISING, Reason.NO_INITIAL_SOC | Reason.INPUT_STALE, 0
)
"""Stands for the estimate before the first sample."""


@dataclass(frozen=True)
class FrameCounts:
    """What happened to the frames so far."""

    frames: int = 0
    """Frames handed over, REPLAY_CLOCK left out."""
    samples: int = 0
    """Samples made of them."""
    lost: int = 0
    """Wanted frames that their counters say are missing."""
    crc_errors: int = 0
    """Wanted frames with a wrong CRC."""
    untimed: int = 0
    """Frames before the first REPLAY_CLOCK, where that is the clock."""
    beginnings: int = 0
    """How often a new log began and everything was forgotten."""

    def __add__(self, other: FrameCounts) -> FrameCounts:
        """Return the sums."""
        return FrameCounts(
            *(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__)
        )


class EstimateStream:
    """Time source, assembler and estimator in one.

    When the replay clock jumps back, a new log has begun: assembler and estimator start anew.

    Parameters
    ----------
    vehicle : Vehicle
    model : ModelFile
    settings : EstimatorSettings, optional
        A temperature source that it leaves unknown is the vehicle's.
    time_source : {"receive", "replay-clock"}
    clock_id : int
        REPLAY_CLOCK's id.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        model: ModelFile,
        settings: EstimatorSettings | None = None,
        time_source: TimeSourceName = "receive",
        clock_id: int = REPLAY_CLOCK_ID,
    ) -> None:
        settings = settings or EstimatorSettings()
        if settings.temperature_source == "unknown":
            settings = replace(settings, temperature_source=vehicle.temperature_source)
        self._vehicle = vehicle
        self._model = model
        self._settings = settings
        self._clock_id = clock_id
        self._time: ReceiveTime | ReplayClock = (
            ReceiveTime() if time_source == "receive" else ReplayClock(clock_id)
        )
        self._past = FrameCounts()
        self._untimed = 0
        self.beginnings = 0
        self.samples = 0
        """Samples handed to the estimator so far, those that it refused included."""
        self.latest = NOTHING_YET
        """The latest estimate; `NOTHING_YET` before the first."""
        self.latest_sample: Sample | None = None
        self._assembler = SampleAssembler(vehicle)
        self._estimator = Estimator(model, settings)

    def handle(self, message: can.Message) -> Estimate | None:
        """Take one frame; return the estimate after the sample that it completes, if any.

        The message's time stamp is set to bus time.
        """
        time_s = self._time.time_of(message)
        if time_s is None:
            if not is_clock(message, self._clock_id):
                self._untimed += 1
            return None
        if self._time.beginnings != self.beginnings:
            self._begin_anew()
        message.timestamp = time_s
        return self._step(self._assembler.handle(message))

    def finish(self) -> Estimate | None:
        """Return the estimate after a last current that still waits for a voltage, if any."""
        return self._step(self._assembler.flush())

    @property
    def counts(self) -> FrameCounts:
        """What happened to the frames so far."""
        now = self._assembler.counters
        return self._past + FrameCounts(
            frames=now.frames,
            samples=now.samples,
            lost=now.frames_lost,
            crc_errors=now.crc_errors,
            untimed=self._untimed,
        )

    @property
    def reference_soc_pct(self) -> float:
        """The car's own state of charge [%]; NaN while there is none."""
        return self._assembler.reference_soc_pct

    @property
    def model(self) -> ModelFile:
        """The model in use."""
        return self._model

    @property
    def pause_verdict(self) -> Verdict:
        """How the SoC over the last long pause was judged by the voltage after it."""
        return self._estimator.pause_verdict

    def snapshot(self) -> EstimatorState | None:
        """Return what must be remembered over a restart; None while no SoC is known."""
        return self._estimator.snapshot() if math.isfinite(self.latest.soc_pct) else None

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Go on from a state (see `Estimator.restore`); until a sample comes, it is stale.

        Raises
        ------
        InputError
            If the state does not fit the model; nothing is changed then.
        """
        estimator = Estimator(self._model, self._settings)
        latest = estimator.restore(state, age_s)
        self._estimator = estimator
        if isinstance(self._time, ReplayClock):
            self._time.resume(latest.time_s)
        reasons = latest.reasons | Reason.INPUT_STALE
        self.latest = latest._replace(status=Status.INVALID, reasons=reasons)
        return self.latest

    def _step(self, sample: Sample | None) -> Estimate | None:
        if sample is None:
            return None
        self.samples += 1
        self.latest_sample = sample
        self.latest = self._estimator.step(sample)
        return self.latest

    def _begin_anew(self) -> None:
        self._past = replace(self.counts, beginnings=self._past.beginnings + 1)
        self._untimed = 0
        self.beginnings = self._time.beginnings
        self._assembler = SampleAssembler(self._vehicle)
        self._estimator = Estimator(self._model, self._settings)
