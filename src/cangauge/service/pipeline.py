"""Frames → estimates: the one path that a live bus and a recorded capture both take.

Pure: no bus, no clock, no files. The same frames with the same stamps give the same numbers.

The gauge: frames in, frames out. Pure: no bus, no clock; whoever has both is `loop`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import can
from can.typechecking import CanFilter

from cangauge.bus.decoder import FrameStatistics, SampleDecoder
from cangauge.bus.plausibility import MISSED_AT_LEAST, Pack
from cangauge.bus.publish import ACKNOWLEDGE_EVERY, FrameIds, SocPublisher, standard_filter
from cangauge.bus.time_source import (
    REPLAY_CLOCK_ID,
    ReceiveTime,
    ReplayClock,
    TimeSourceName,
    is_clock,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimate.estimator import Estimator
from cangauge.estimate.hypothesis_filter import Verdict
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.state import EstimatorState
from cangauge.estimate.validity import Estimate, Reason, Sample, Status, status_of
from cangauge.model.model_file import Model, effective_error_std_v

# --- Frames → estimates: the one path that a live bus and a recorded capture both take

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
    repeated: int = 0
    """Wanted frames whose counter stood still."""
    short: int = 0
    """Wanted frames with too few bytes."""
    not_available: int = 0
    """Values whose code means "not available"."""
    implausible: int = 0
    """Values out of range, or changed too fast."""
    stuck: int = 0
    """Values of a signal that stood still while it should move."""
    held_back: int = 0
    """Good values not used yet, because too many before them failed."""
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
    model : Model
    settings : EstimatorSettings, optional
        A temperature source that it leaves unknown is the vehicle's.
    time_source : {"receive", "replay-clock"}
    clock_id : int
        REPLAY_CLOCK's id.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        model: Model,
        settings: EstimatorSettings | None = None,
        time_source: TimeSourceName = "receive",
        clock_id: int = REPLAY_CLOCK_ID,
    ) -> None:
        settings = _filled(settings or EstimatorSettings(), vehicle)
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
        self.latest_sample: Sample | None = None
        self._pack = pack_of(model, settings.capacity_ah)
        self._assembler = SampleDecoder(vehicle, self._pack)
        self._estimator = Estimator(model, settings)
        # The latest estimate as the estimator gave it (None until there was a sample) and judged;
        # a sample that came since is waiting for somebody to ask for its estimate.
        self._estimated: Estimate | None = None
        self._latest = NOTHING_YET
        self._is_behind = False

    def handle(self, message: can.Message) -> Estimate | None:
        """Take one frame; return the estimate after the sample that it completes, if any."""
        return self.latest if self.take(message) else None

    def take(self, message: can.Message) -> bool:
        """Take one frame; return whether it completed a sample, of which `latest` then tells.

        The message's time stamp is set to bus time.
        """
        time_s = self._time.time_of(message)
        if time_s is None:
            if not is_clock(message, self._clock_id):
                self._untimed += 1
            return False
        if self._time.beginnings != self.beginnings:
            self._begin_anew()
        message.timestamp = time_s
        sample = self._assembler.handle(message)
        if sample is None:
            return False
        self._step(sample)
        return True

    def finish(self) -> Estimate | None:
        """Return the estimate after a last current that still waits for a voltage, if any."""
        sample = self._assembler.flush()
        if sample is None:
            return None
        self._step(sample)
        return self.latest

    @property
    def latest(self) -> Estimate:
        """The latest estimate; `NOTHING_YET` before the first."""
        self._catch_up()
        return self._latest

    def reconfigure(
        self, vehicle: Vehicle | None, model: Model, settings: EstimatorSettings
    ) -> None:
        """Go on with another vehicle (None: the same), model and settings.

        What does not change is not touched: the numbers then go on bit for bit. Else the
        estimator is made anew and takes SoC and delay line over; the initial SoC stays what it
        was.
        """
        self._catch_up()
        old = self._settings
        settings = replace(
            _filled(settings, vehicle or self._vehicle),
            initial_soc_pct=old.initial_soc_pct,
            initial_soc_std_pct=old.initial_soc_std_pct,
        )
        pack = pack_of(model, settings.capacity_ah)
        if vehicle is not None or pack != self._pack:
            # What a signal may be follows from both.
            self._past, self._untimed = self.counts, 0
            self._vehicle, self._pack = vehicle or self._vehicle, pack
            self._assembler = SampleDecoder(self._vehicle, pack)
        if (model, settings) == (self._model, old):
            return
        before = self._estimator
        self._model, self._settings = model, settings
        self._estimator = Estimator(model, settings)
        self._estimator.take_over(before)

    @property
    def counts(self) -> FrameCounts:
        """What happened to the frames so far."""
        now = self._assembler.statistics
        return self._past + FrameCounts(
            frames=now.frames,
            samples=now.samples,
            lost=now.frames_lost,
            crc_errors=now.crc_errors,
            repeated=now.counter_repeats,
            short=now.short,
            not_available=now.not_available,
            implausible=now.implausible,
            stuck=now.stuck,
            held_back=now.held_back,
            untimed=self._untimed,
        )

    @property
    def counters(self) -> FrameStatistics:
        """The same in detail, of the log that is running."""
        return self._assembler.statistics

    @property
    def reference_soc_pct(self) -> float:
        """The car's own state of charge [%]; NaN while there is none."""
        return self._assembler.reference_soc_pct

    @property
    def model(self) -> Model:
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
        self._latest = latest._replace(status=Status.INVALID, reasons=reasons)
        self._is_behind = False
        return self._latest

    def ask_the_voltage(self) -> bool:
        """Begin from the first voltages, whatever initial SoC was given; False if none was.

        For a start at which the given one is known to be of another time.
        """
        if self._settings.initial_soc_pct is None:
            return False
        default = EstimatorSettings().initial_soc_std_pct
        self._settings = replace(self._settings, initial_soc_pct=None, initial_soc_std_pct=default)
        self._estimator = Estimator(self._model, self._settings)
        return True

    def _step(self, sample: Sample) -> None:
        self.samples += 1
        self.latest_sample = sample
        self._estimator.take(sample)
        self._is_behind = True

    def _catch_up(self) -> None:
        """Ask for the estimate after the latest sample, unless that was done."""
        if self._is_behind and self.latest_sample is not None:
            self._is_behind = False
            self._estimated = self._estimator.estimate
            self._latest = self._judged(self.latest_sample.time_s)

    @property
    def told(self) -> Estimate:
        """The latest estimate, with what the signals are worth since: for the next heartbeat."""
        self._catch_up()
        return self._judged(self._assembler.now_s)

    @property
    def current_timeout_s(self) -> float:
        """How long a current holds [s]."""
        return self._assembler.health["current"].timeout_s

    @property
    def current_patience_s(self) -> float:
        """How long to wait for a current at least [s]; 0 while its period is not known."""
        period_s = self._assembler.health["current"].period_s
        return 0.0 if math.isnan(period_s) else MISSED_AT_LEAST * period_s

    def _judged(self, now_s: float) -> Estimate:
        """Return the latest estimate, marked by what the signals are worth at bus time `now_s`.

        One voltage that failed or has not come yet is no missing voltage: several in a row are,
        and one that is too old.
        """
        sample = self.latest_sample
        estimate = self._latest if self._estimated is None else self._estimated
        missing = self._assembler.reasons(now_s)
        reasons = estimate.reasons
        if sample is not None and math.isnan(sample.voltage_v):
            reasons &= ~Reason.VOLTAGE_MISSING
        if missing:
            reasons |= missing
        if reasons == estimate.reasons:
            return estimate
        return estimate._replace(reasons=reasons, status=status_of(reasons))

    def _begin_anew(self) -> None:
        self._catch_up()
        self._past = replace(self.counts, beginnings=self._past.beginnings + 1)
        self._untimed = 0
        self.beginnings = self._time.beginnings
        self._assembler = SampleDecoder(self._vehicle, self._pack)
        self._estimator = Estimator(self._model, self._settings)
        self._estimated = None


def pack_of(model: Model, capacity_ah: float | None = None) -> Pack:
    """Return what a model knows of a pack that helps to judge its signals.

    Parameters
    ----------
    model : Model
    capacity_ah : float, optional
        Instead of the model's [Ah].
    """
    voltage = model.extended_model().model
    return Pack(
        resistance_ohm=abs(voltage.resistance_ohm[0]) if voltage.resistance_ohm else 0.0,
        error_std_v=effective_error_std_v(model.noise, 1.0 / model.rate_hz),
        capacity_ah=model.capacity_ah if capacity_ah is None else capacity_ah,
        usual_v=voltage.pseudo_ocv_at(50.0)[0],
    )


def _filled(settings: EstimatorSettings, vehicle: Vehicle) -> EstimatorSettings:
    if settings.temperature_source != "unknown":
        return settings
    return replace(settings, temperature_source=vehicle.temperature_source)


# --- The gauge: frames in, frames out. Pure: no bus, no clock; whoever has both is `loop`


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
    model : Model
    settings : GaugeSettings, optional

    Raises
    ------
    InputError
        If a frame to publish has the id of one that is wanted.
    """

    def __init__(
        self, vehicle: Vehicle, model: Model, settings: GaugeSettings | None = None
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

    def reconfigure(self, vehicle: Vehicle | None, model: Model, settings: GaugeSettings) -> None:
        """Go on with another configuration, from the SoC that is known.

        Parameters
        ----------
        vehicle : Vehicle, optional
            None: the same.
        model : Model
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
    def counters(self) -> FrameStatistics:
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
    def model(self) -> Model:
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
