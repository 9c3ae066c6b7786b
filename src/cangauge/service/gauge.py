"""The gauge: frames in, frames out. Pure: no bus, no clock; whoever has both is `loop`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import can
from can.typechecking import CanFilter

from cangauge.bus.publish import FrameIds, SocPublisher, standard_filter
from cangauge.bus.time_source import TimeSourceName
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimate.belief import Verdict
from cangauge.estimate.estimator import EstimatorSettings
from cangauge.estimate.state import EstimatorState
from cangauge.estimate.types import Estimate, Reason, Sample, Status
from cangauge.model.model_file import ModelFile
from cangauge.service.stream import EstimateStream, FrameCounts

ACKNOWLEDGE_EVERY: Final = 4
"""Samples between two SOC_DETAIL at most, under the replay clock: `replay` waits for them."""

DETAIL_EVERY_BEATS: Final = 10
"""Every so many heartbeats carry a SOC_DETAIL: one a second while no sample arrives."""


@dataclass(frozen=True)
class GaugeSettings:
    """What a user may choose.

    Parameters
    ----------
    estimator : EstimatorSettings
    time_source : {"receive", "replay-clock"}
    ids : FrameIds
    """

    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    time_source: TimeSourceName = "receive"
    ids: FrameIds = field(default_factory=FrameIds)


class Gauge:
    """Makes SOC_ESTIMATE and SOC_DETAIL of a vehicle's frames.

    Parameters
    ----------
    vehicle : Vehicle
    model : ModelFile
    settings : GaugeSettings, optional

    Raises
    ------
    InputError
        If a frame to publish has the id of one that is wanted.
    """

    def __init__(
        self, vehicle: Vehicle, model: ModelFile, settings: GaugeSettings | None = None
    ) -> None:
        self.settings = settings or GaugeSettings()
        ids = self.settings.ids
        self._vehicle = vehicle
        _check_ids(vehicle, ids)
        self._stream = EstimateStream(
            vehicle, model, self.settings.estimator, self.settings.time_source, ids.replay_clock
        )
        is_replay = self.settings.time_source == "replay-clock"
        self._publisher = SocPublisher(ids, ACKNOWLEDGE_EVERY if is_replay else None)
        self._beginnings = 0
        self._beats = 0

    @property
    def filters(self) -> list[CanFilter]:
        """What to receive: the vehicle's frames, and REPLAY_CLOCK where that is the clock."""
        wanted = [
            CanFilter(
                can_id=int(each["can_id"]),
                can_mask=int(each["can_mask"]),
                extended=bool(each["extended"]),
            )
            for each in self._vehicle.filters
        ]
        if self.settings.time_source == "replay-clock":
            wanted.append(standard_filter(self.settings.ids.replay_clock))
        return wanted

    def handle(self, message: can.Message) -> list[can.Message]:
        """Take one frame; return those to send."""
        estimate = self._stream.handle(message)
        return [] if estimate is None else self._publish(estimate)

    def finish(self) -> list[can.Message]:
        """Return the last frames to send, at the end."""
        estimate = self._stream.finish()
        return [] if estimate is None else self._publish(estimate)

    def heartbeat(self, *, is_stale: bool) -> list[can.Message]:
        """Return what to send when nothing was sent for a while.

        Parameters
        ----------
        is_stale : bool
            No sample within the time-out: the latest estimate is repeated as invalid.
        """
        estimate = self.latest
        if is_stale and self.samples:
            estimate = estimate._replace(
                status=Status.INVALID, reasons=estimate.reasons | Reason.INPUT_STALE
            )
        frames = [self._publisher.estimate_frame(estimate)]
        self._beats += 1
        if self.samples != self._publisher.samples_told or self._beats % DETAIL_EVERY_BEATS == 1:
            frames.append(self._publisher.detail_frame(estimate, self.samples))
        return frames

    @property
    def latest(self) -> Estimate:
        """The latest estimate; `stream.NOTHING_YET` before the first."""
        return self._stream.latest

    @property
    def latest_sample(self) -> Sample | None:
        """The latest sample; None before the first."""
        return self._stream.latest_sample

    @property
    def samples(self) -> int:
        """Samples processed so far, those that the estimator refused included."""
        return self._stream.samples

    @property
    def counts(self) -> FrameCounts:
        """What happened to the frames so far."""
        return self._stream.counts

    @property
    def reference_soc_pct(self) -> float:
        """The car's own state of charge [%]; NaN while there is none."""
        return self._stream.reference_soc_pct

    @property
    def model(self) -> ModelFile:
        """The model in use."""
        return self._stream.model

    @property
    def pause_verdict(self) -> Verdict:
        """How the SoC over the last long pause was judged by the voltage after it."""
        return self._stream.pause_verdict

    def snapshot(self) -> EstimatorState | None:
        """Return what must be remembered over a restart; None while no SoC is known."""
        return self._stream.snapshot()

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Go on from a state; see `EstimateStream.restore`."""
        return self._stream.restore(state, age_s)

    def _publish(self, estimate: Estimate) -> list[can.Message]:
        if self._stream.beginnings != self._beginnings:
            self._beginnings = self._stream.beginnings
            self._publisher.restart()
        return self._publisher.publish(estimate, self.samples)


def _check_ids(vehicle: Vehicle, ids: FrameIds) -> None:
    own = {
        ids.soc_estimate: "soc_estimate",
        ids.soc_detail: "soc_detail",
        ids.replay_clock: "replay_clock",
    }
    for signal in vehicle.signals:
        if not signal.is_extended and signal.arbitration_id in own:
            raise InputError(
                f"{signal.message} of {vehicle.name} has this id",
                field=f"ids.{own[signal.arbitration_id]}",
                value=f"0x{signal.arbitration_id:X}",
                cure="choose another one",
            )
