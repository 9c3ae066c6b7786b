"""The gauge: frames in, frames out. Pure: no bus, no clock; whoever has both is `loop`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import can
from can.typechecking import CanFilter

from cangauge.bus.counters import Counters
from cangauge.bus.publish import FrameIds, SocPublisher, standard_filter
from cangauge.bus.time_source import TimeSourceName
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimate.belief import Verdict
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.state import EstimatorState
from cangauge.estimate.types import Estimate, Reason, Sample
from cangauge.estimate.validity import status_of
from cangauge.model.model_file import ModelFile
from cangauge.service.stream import NOTHING_YET, EstimateStream, FrameCounts

ACKNOWLEDGE_EVERY: Final = 4
"""Samples between two SOC_DETAIL at most, under the replay clock: `replay` waits for them."""


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
        self._is_replay = self.settings.time_source == "replay-clock"
        self._publisher = SocPublisher(ids, ACKNOWLEDGE_EVERY if self._is_replay else None)
        self._beginnings = 0
        self.published = NOTHING_YET
        """The estimate as last put on the bus, stale where it was told to be."""

    def reconfigure(
        self, vehicle: Vehicle | None, model: ModelFile, settings: GaugeSettings
    ) -> None:
        """Go on with another configuration, from the SoC that is known.

        Parameters
        ----------
        vehicle : Vehicle, optional
            None: the same.
        model : ModelFile
        settings : GaugeSettings
            Of the estimator's, initial SoC and standard deviation stay what they were; time source
            and REPLAY_CLOCK's id must be what they were.

        Raises
        ------
        InputError
            As when made; the old configuration then stays.
        """
        _check_ids(vehicle or self._vehicle, settings.ids)
        self._vehicle = vehicle or self._vehicle
        self._stream.reconfigure(vehicle, model, settings.estimator)
        self.settings = settings
        self._publisher.ids = settings.ids

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

    def take(self, message: can.Message) -> bool:
        """Take one frame; return whether it completed a sample."""
        return self._stream.take(message)

    def acknowledgement(self) -> list[can.Message]:
        """Return what to send at once after a sample, which only a replay's time asks for."""
        return self._publish(self._stream.latest) if self._is_replay else []

    def handle(self, message: can.Message) -> list[can.Message]:
        """Take one frame; return those to send at once."""
        return self.acknowledgement() if self.take(message) else []

    def finish(self) -> list[can.Message]:
        """Return the last frames to send, at the end."""
        estimate = self._stream.finish()
        if estimate is None:
            return []
        self.published = estimate
        return self._publisher.beat(estimate, self.samples, 0.0)

    def heartbeat(self, *, is_stale: bool, silent_s: float = 0.0) -> list[can.Message]:
        """Return what to send now: every `publish.ESTIMATE_EVERY_S`, or so long after `handle`.

        Parameters
        ----------
        is_stale : bool
            No sample within the service's time-out: the latest estimate is told as invalid.
        silent_s : float
            Time since the latest sample came in, by the loop's monotonic clock [s]. While the
            receive stamps are bus time, the current's own time-out counts, too.
        """
        estimate = self._stream.told
        is_stale = is_stale or (not self._is_replay and silent_s > self._stream.current_timeout_s)
        if is_stale and self.samples:
            reasons = estimate.reasons | Reason.INPUT_STALE
            estimate = estimate._replace(status=status_of(reasons), reasons=reasons)
        self.published = estimate
        age_s = silent_s if self.samples else math.nan
        return self._publisher.beat(estimate, self.samples, age_s)

    @property
    def patience_s(self) -> float:
        """How long to wait for a sample at least before the input is stale [s].

        A source that is slower than the service's time-out is not stale between two samples.
        """
        return 0.0 if self._is_replay else self._stream.current_patience_s

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
    def counters(self) -> Counters:
        """The same in detail, of the log that is running."""
        return self._stream.counters

    @property
    def reference_soc_pct(self) -> float:
        """The car's own state of charge [%]; NaN while there is none."""
        return self._stream.reference_soc_pct

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle in use."""
        return self._vehicle

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

    def ask_the_voltage(self) -> bool:
        """Begin from the voltage; see `EstimateStream.ask_the_voltage`."""
        return self._stream.ask_the_voltage()

    def _publish(self, estimate: Estimate) -> list[can.Message]:
        if self._stream.beginnings != self._beginnings:
            self._beginnings = self._stream.beginnings
            self._publisher.restart()
        self.published = estimate
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
