"""The pipeline: frames → samples → estimates → frames to publish.

A live bus and a recorded capture share it. Pure: no bus, no files, no clock; the same frames with
the same stamps give the same numbers. `loop` runs it on a bus, `offline` over a capture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import can
from can.typechecking import CanFilter

from cangauge.bus.decoder import FrameStatistics, SampleDecoder
from cangauge.bus.plausibility import MISSED_AT_LEAST, MISSED_UNTIL_OLD, PackProperties
from cangauge.bus.publish import ACKNOWLEDGE_EVERY, PackReport, SocPublisher, standard_filter
from cangauge.bus.time_source import ReplayClock, is_clock, is_count, time_source
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.cells import CellEstimator
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.state import EstimatorState
from cangauge.model.model_file import Model
from cangauge.settings import START_STD_PCT, FrameIds, TimeSourceName
from cangauge.types import REASONS, Estimate, Reason, Sample, Status, status_of

NOTHING_YET: Final = Estimate.unknown(Reason.NO_INITIAL_SOC | Reason.INPUT_STALE)
"""The estimate before the first sample."""


_VOLTAGE_MISSING: Final = int(Reason.VOLTAGE_MISSING)
_INPUT_STALE: Final = int(Reason.INPUT_STALE)


@dataclass(frozen=True)
class PipelineSettings:
    """Settings of a pipeline.

    An unknown temperature source of the estimator is replaced by the vehicle's. Bus time is the
    frames' receive stamps, or the log time that REPLAY_CLOCK sends.
    """

    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    time_source: TimeSourceName = "receive"
    ids: FrameIds = field(default_factory=FrameIds)


class Pipeline:
    """Estimate the SoC from a vehicle's frames, and make the frames to publish.

    When the replay clock jumps back a new log has begun: decoder and estimator restart.

    Parameters
    ----------
    vehicle : Vehicle
    model : Model
    settings : PipelineSettings, optional
    publishes : bool
        False: no frames are asked for, and the vehicle may use their ids.

    Attributes
    ----------
    vehicle, model, settings
        As in use; see `reconfigure`.
    decoder : SampleDecoder
        Signal health and the vehicle's own SoC, of the current log; statistics of all logs.
    estimator : Estimator
    cells : CellEstimator or None
        Where the vehicle gives cell voltages.
    samples, taken : int
        Samples handed to the estimator, over all logs, and those of them that it took: only these
        make an estimate fresh.
    is_replay : bool
        Whether bus time is a replay's.
    stamp_shift_s : float
        What was added to the frames' stamps since their clock was set [s].
    latest_sample : Sample or None
    published : Estimate
        The one in the frames made last: `latest`, or at a heartbeat what is true of it then.
    published_samples : int
        `samples` then.

    Raises
    ------
    InputError
        If a frame to publish has the id of a vehicle's signal.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        model: Model,
        settings: PipelineSettings | None = None,
        *,
        publishes: bool = True,
    ) -> None:
        self.vehicle = vehicle
        self.model = model
        self.settings = settings = settings or PipelineSettings()
        self.is_replay = settings.time_source == "replay-clock"
        if publishes:
            _check_ids(vehicle, settings.ids)
        self._publisher = SocPublisher(settings.ids, ACKNOWLEDGE_EVERY if self.is_replay else None)
        self._time = time_source(settings.time_source, settings.ids.replay_clock)
        self._statistics = FrameStatistics()
        self._beginnings = self._untimed = 0
        self.samples = self.taken = 0
        self._refused = 0  # in a row
        self.stamp_shift_s = 0.0
        self.latest_sample: Sample | None = None
        self.published = NOTHING_YET
        self.published_samples = 0
        self._estimate = NOTHING_YET  # after the latest sample, without the signals' health
        self._report: PackReport | None = None
        self.estimator = make_estimator(model, _with_sensors(settings.estimator, vehicle))
        self._begin_signals()

    def _begin_signals(self) -> None:
        """Begin to judge the signals anew, for the present vehicle and model."""
        self._pack = _pack_of(self.estimator)
        self.decoder = SampleDecoder(self.vehicle, self._pack, self._statistics)
        self._voltage_s = math.inf
        self._without_voltage = 0
        self._lacks_voltage = False
        self._begin_cells()

    def _begin_cells(self) -> None:
        cells = self.vehicle.cells_map
        model = self.estimator.voltage_model
        self.cells = None if cells is None else CellEstimator(model, cells.count, cells.first)

    # --- frames → estimates

    def handle(self, message: can.Message) -> bool:
        """Process one frame; return whether it completed a sample.

        The message's time stamp is set to bus time. `latest` computes the estimate on demand.
        """
        time_s = self._time.time_of(message)
        if time_s is None:
            clock_id = self.settings.ids.replay_clock
            self._untimed += not (is_clock(message, clock_id) or is_count(message, clock_id))
            return False
        if self._time.beginnings != self._beginnings:
            self._beginnings = self._time.beginnings
            self._refused = 0
            self.estimator = make_estimator(self.model, self.estimator.settings)
            self._begin_signals()
        message.timestamp = time_s
        sample = self.decoder.handle(message)
        if sample is None:
            return False
        self._estimate_after(sample)
        return True

    def finish(self) -> bool:
        """Release the last current if it is unpaired; return whether it completed a sample."""
        sample = self.decoder.flush()
        if sample is not None:
            self._estimate_after(sample)
        return sample is not None

    @property
    def latest(self) -> Estimate:
        """The estimate of the latest sample, with the signal health at its time; not cached."""
        sample = self.latest_sample
        return self._estimate if sample is None else self._with_health(sample.time_s)

    def estimate_now(self) -> Estimate:
        """Return the latest estimate with the signal health at the latest wanted frame."""
        return self._with_health(self.decoder.now_s)

    def report(self) -> PackReport:
        """Return health, power and cells after the latest sample; computed once a sample."""
        if self._report is None:
            self._report = PackReport(
                self.estimator.health,
                self.estimator.power(),
                None if self.cells is None else self.cells.report,
            )
        return self._report

    @property
    def counts(self) -> dict[str, int]:
        """Frames and values by outcome so far, over all logs of a run.

        - frames, samples: frames received, wanted or not; samples decoded from them.
        - lost: frames that are missing by the alive counters and by the counts of a replay's clock.
        - crc_errors, repeated, short: frames refused for a wrong CRC, a repeated alive counter, too
          few bytes.
        - not_available, implausible, stuck, held_back: values coded as not available; out of range
          or changed too fast; of a stuck signal; plausible, but of a signal that has not recovered.
        - untimed: frames before the first REPLAY_CLOCK, where that is the time source.
        - beginnings, steps_back: logs that began; times that the receive stamps stepped back.
        """
        found = self._statistics
        return {
            "frames": found.frames,
            "samples": found.samples,
            "lost": found.frames_lost + self._time.lost,
            "crc_errors": found.crc_errors,
            "repeated": found.counter_repeats,
            "short": found.short,
            "not_available": found.not_available,
            "implausible": found.implausible,
            "stuck": found.stuck,
            "held_back": found.held_back,
            "untimed": self._untimed,
            "beginnings": self._time.beginnings,
            "steps_back": self._time.steps_back,
        }

    @property
    def is_unpaired(self) -> bool:
        """Whether good voltages come, but no longer with a current."""
        return self._lacks_voltage and self.decoder.health["voltage"].is_usable(self.decoder.now_s)

    def _estimate_after(self, sample: Sample) -> None:
        self.samples += 1
        self.latest_sample = sample
        self._report = None
        is_implausible = math.isnan(sample.voltage_v) and self.decoder.is_voltage_implausible
        # The estimator treats a refused voltage otherwise than one that never came, as offline.
        self.estimator.update(sample._replace(voltage_v=math.inf) if is_implausible else sample)
        self._estimate = self.estimator.estimate
        self._note_voltage(sample)
        self._refused = self._refused + 1 if self.estimator.is_refused else 0
        self.taken += not self.estimator.is_refused
        cells = self.cells
        received = self.decoder.cells
        if cells is not None and received is not None and cells.is_due(sample.time_s):
            volts, times = received.take(sample.time_s)
            changes = self.estimator.current_changes(sample.time_s, times)
            cells.update(self.estimator.pack_tick(sample), volts, changes)

    def _note_voltage(self, sample: Sample) -> None:
        """Note whether samples lack the voltage lastingly, though its frames may come.

        They do when several consecutive samples have no voltage, and the last voltage is older than
        its time-out. The number alone is not enough: a voltage that is sent less often than the
        current is in few samples.
        """
        if not math.isnan(sample.voltage_v):
            self._voltage_s = sample.time_s
            self._without_voltage = 0
            self._lacks_voltage = False
            return
        self._voltage_s = min(self._voltage_s, sample.time_s)  # time may run backwards
        self._without_voltage += 1
        is_old = sample.time_s - self._voltage_s > self.decoder.health["voltage"].timeout_s
        self._lacks_voltage = is_old and self._without_voltage >= MISSED_AT_LEAST

    def _with_health(self, now_s: float) -> Estimate:
        """Return the latest estimate, marked by the health of the signals at bus time `now_s`.

        A single voltage that failed, has not come yet or pairs with no current is not missing;
        several consecutive ones are, or one that is too old. Samples that are refused one after the
        other do not make an estimate fresh.
        """
        estimate = self._estimate
        bits = int(estimate.reasons) & ~_VOLTAGE_MISSING | int(self.decoder.reasons(now_s))
        bits |= _VOLTAGE_MISSING * self._lacks_voltage
        bits |= _INPUT_STALE * (self._refused >= MISSED_UNTIL_OLD)
        return _with_reasons(estimate, REASONS[bits])

    # --- estimates → frames

    @property
    def filters(self) -> list[CanFilter]:
        """Filters for the vehicle's frames, and for REPLAY_CLOCK where that is the time source."""
        clock_id = self.settings.ids.replay_clock
        clock = [standard_filter(clock_id), standard_filter(clock_id - 1)]
        return [*self.vehicle.filters, *(clock if self.is_replay else [])]

    def replay_frames(self, estimate: Estimate) -> list[can.Message]:
        """Return the frames due with the latest sample's estimate in a replay, else none."""
        if not self.is_replay:
            return []
        self.published = estimate
        self.published_samples = self.samples
        return self._publisher.publish(estimate, self.samples, self.report)

    def heartbeat(
        self, silent_s: float = 0.0, timeout_s: float = math.inf, reasons: Reason = Reason.NONE
    ) -> list[can.Message]:
        """Return the frames due every `publish.ESTIMATE_EVERY_S`.

        Parameters
        ----------
        silent_s : float
            Time since the latest sample that the estimator took [s].
        timeout_s : float
            Longest silence at which the estimate is still fresh [s]; see `_is_stale`.
        reasons : Reason
            Findings of the loop.
        """
        if self._is_stale(silent_s, timeout_s):
            reasons |= Reason.INPUT_STALE
        self.published = self._aged(self.estimate_now(), silent_s, reasons)
        self.published_samples = self.samples
        age_s = silent_s if self.taken else math.nan
        return self._publisher.publish_periodic(self.published, self.samples, age_s, self.report)

    def _is_stale(self, silent_s: float, timeout_s: float) -> bool:
        """Return whether a silence is too long.

        With receive stamps some periods of the current are never too long, so that a slow source
        does not make the estimate stale; the current's own time-out always is.
        """
        if not self.is_replay:
            current = self.decoder.health["current"]
            if not math.isnan(current.period_s):
                timeout_s = max(timeout_s, MISSED_AT_LEAST * current.period_s)
            timeout_s = min(timeout_s, current.timeout_s)
        return silent_s > timeout_s and self.taken > 0

    def _aged(self, estimate: Estimate, silent_s: float, reasons: Reason) -> Estimate:
        """Return an estimate with further reasons; an invalid one with the charge not counted.

        While samples come that charge is little: the estimate is then invalid by model or sign.
        """
        estimate = _with_reasons(estimate, estimate.reasons | reasons)
        if estimate.status is not Status.INVALID:
            return estimate
        std_pct = math.hypot(estimate.soc_std_pct, self.estimator.uncounted_std_pct(silent_s))
        return estimate._replace(soc_std_pct=std_pct)

    # --- reload and restart

    def reconfigure(self, vehicle: Vehicle, model: Model, settings: PipelineSettings) -> None:
        """Continue with another configuration, from the SoC known so far.

        Unchanged parts keep their state bit for bit. A changed model or estimator setting makes a
        new estimator, which takes over SoC and delay line. Where the decoding of current or voltage
        changed, that SoC is wrong or of another battery: the new estimator starts from the first
        voltages. Otherwise initial SoC and its standard deviation stay. The time source and
        REPLAY_CLOCK's id always stay. InputError, and no change, if a frame to publish has the id
        of a vehicle's signal, or settings contradict the model.
        """
        before = self.estimator
        judged_by = (self.vehicle, self._pack)
        is_other_model = model != self.model
        ids = replace(settings.ids, replay_clock=self.settings.ids.replay_clock)
        _check_ids(vehicle, ids)
        chosen = replace(
            _with_sensors(settings.estimator, vehicle),
            initial_soc_pct=before.settings.initial_soc_pct,
            initial_soc_std_pct=before.settings.initial_soc_std_pct,
        )
        if vehicle.battery != self.vehicle.battery:
            self.estimator = make_estimator(model, _from_voltage(chosen))
            self._estimate = NOTHING_YET
        elif is_other_model or chosen != before.settings:
            estimator = make_estimator(model, chosen)
            estimator.take_over(before)
            self.estimator = estimator
        self.settings = replace(settings, ids=ids, time_source=self.settings.time_source)
        self.vehicle = vehicle
        self.model = model
        self._report = None
        self._publisher.ids = ids
        if judged_by != (vehicle, _pack_of(self.estimator)):
            self._begin_signals()
        elif is_other_model:
            self._begin_cells()

    def snapshot(self) -> EstimatorState | None:
        """Return the estimator's state; None while no SoC is known.

        It refers to the stamps as their clock makes them now: after a restart they come so.
        """
        if not math.isfinite(self._estimate.soc_pct):
            return None
        return self.estimator.snapshot(self.stamp_shift_s)

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Continue from a state (see `Estimator.restore`); it is stale until a sample comes.

        InputError, and no change, if it does not fit the model.
        """
        estimator = make_estimator(self.model, self.estimator.settings)
        latest = estimator.restore(state, age_s)
        self.estimator = estimator
        self._report = None
        if isinstance(self._time, ReplayClock):
            self._time.resume(latest.time_s)
        reasons = latest.reasons | Reason.INPUT_STALE
        self._estimate = latest._replace(status=Status.INVALID, reasons=reasons)
        return self._estimate

    def discard_initial_soc(self) -> bool:
        """Start from the first voltages instead of the given initial SoC; False if none was given.

        For a start at which the given SoC is known to be outdated.
        """
        settings = self.estimator.settings
        if settings.initial_soc_pct is None:
            return False
        self.estimator = make_estimator(self.model, _from_voltage(settings))
        return True


def _pack_of(estimator: Estimator) -> PackProperties:
    """Return the pack's properties by which its signals are judged."""
    voltage = estimator.voltage_model
    stated_ah = estimator.settings.capacity_ah
    return PackProperties(
        resistance_ohm=abs(voltage.loads.resistance_ohm[0]),
        error_std_v=estimator.model.noise.residual_std_v,
        capacity_ah=estimator.model.capacity_ah if stated_ah is None else stated_ah,
        usual_v=voltage.pseudo_ocv_at(50.0)[0],
    )


def _from_voltage(settings: EstimatorSettings) -> EstimatorSettings:
    """Return the settings without an initial SoC."""
    return replace(settings, initial_soc_pct=None, initial_soc_std_pct=START_STD_PCT)


def _with_reasons(estimate: Estimate, reasons: Reason) -> Estimate:
    if reasons is estimate.reasons:  # the usual case
        return estimate
    return estimate._replace(reasons=reasons, status=status_of(reasons))


def _with_sensors(settings: EstimatorSettings, vehicle: Vehicle) -> EstimatorSettings:
    """Return the settings with the vehicle's sensors; a stated temperature source stays."""
    source = settings.temperature_source
    return replace(
        settings,
        temperature_source=vehicle.temperature_source if source == "unknown" else source,
        voltage_accuracy_pct=vehicle.voltage_accuracy_pct,
    )


def _check_ids(vehicle: Vehicle, ids: FrameIds) -> None:
    published = ids.published | {ids.replay_clock: "replay_clock"}
    for signal in (*vehicle.signals, *vehicle.cells):
        if signal.key in published:  # the key of an extended id is no standard id
            raise InputError(
                f"{signal.message} of {vehicle.name} has this id",
                field=f"ids.{published[signal.key]}",
                value=f"0x{signal.key:X}",
                cure="choose another one",
            )
