"""The estimator: samples → estimates. Pure: no clock, no files, no bus.

Charge is counted on every sample. The voltage is used at the model's rate, on the first sample at
or after each tick of bus time. The same samples give the same numbers, live or offline.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from cangauge._arithmetic import dot, total
from cangauge.errors import InputError
from cangauge.estimation.cells import PackTick
from cangauge.estimation.counting import CoulombCounter, EstimatorClock
from cangauge.estimation.ekf import CAPACITY_STD, UNKNOWN_SOC_STD_PCT, SocEkf, count_std_pct
from cangauge.estimation.health import Health, HealthEstimator, VoltageTick
from cangauge.estimation.hypothesis_filter import HypothesisFilter
from cangauge.estimation.measurement_noise import CurveFunctions, Measurement, MeasurementNoise
from cangauge.estimation.power import LEVEL_MEMORY_S, PackNow, Power, PowerModel
from cangauge.estimation.settings import (
    EstimatorSettings,
    SocReference,
    SocReferenceDetector,
)
from cangauge.estimation.state import (
    ChargeSinceUpdate,
    DelayLineState,
    EstimatorMemory,
    EstimatorState,
)
from cangauge.model.delay_line import DelayLine
from cangauge.model.effects.base import Reading
from cangauge.model.model_file import Model, effective_error_std_v
from cangauge.model.voltage_model import TEMPERATURE_MARGIN_K, Curve, VoltageModel, soc_from_ocv
from cangauge.types import (
    CURRENT_AT_MOST_A,
    REASONS,
    Estimate,
    Reason,
    Sample,
    drop_implausible,
    outside_model,
    status_of,
    temperature_mismatch,
)

__all__ = ["Estimator", "EstimatorSettings"]

REST_CURRENT_C_RATE = 0.02
"""Below this current the pack is at rest [1/h]: 1.2 A at 60 Ah."""

REST_S = 600.0
"""Time at rest after which slow polarisation has decayed [s]."""

CONTRADICTED_S = 300.0
"""How long a lasting contradiction, or a restart of the filter, degrades the estimate [s]."""

MISMATCH_SIGMAS = 3.0
"""Offset, bias or learned capacity beyond this many of the standard deviations assumed for them:
model and pack disagree. By chance one pack in 400 is beyond."""

AGREES_PCT = 1e-6
"""Rounding error allowed between a state's last estimate and its filter or count [%]."""


class Estimator:
    """SoC estimator: voltage model, delay line, Coulomb counter and hypothesis filter.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings, optional
    ekf_type : type, optional
        Implementation of the Kalman filter; by default that of `settings.filter`.

    Attributes
    ----------
    model : Model
    settings : EstimatorSettings
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    filter : HypothesisFilter
        Offset of the current sensor, and the verdict on the last unobserved interval.
    is_refused : bool
        Whether the latest sample was refused: without a plausible current, or not later.

    Examples
    --------
    >>> from cangauge.estimation.estimator import Estimator, EstimatorSettings
    >>> from cangauge.types import Sample
    >>> from cangauge.model.published import leaf_2012_model_file
    >>> estimator = Estimator(leaf_2012_model_file(), EstimatorSettings(initial_soc_pct=80.0))
    >>> estimate = estimator.step(
    ...     Sample(time_s=0.0, current_a=10.0, voltage_v=385.0, temperature_c=23.0)
    ... )
    >>> round(estimate.soc_coulomb_pct)
    80
    """

    core: ClassVar[str] = "python"
    """Implementation of the step: "python", or "compiled" (`compiled`)."""

    def __init__(
        self,
        model: Model,
        settings: EstimatorSettings | None = None,
        ekf_type: type[SocEkf] | None = None,
    ) -> None:
        self.model = model
        self.settings = settings or EstimatorSettings()
        make_ekf = ekf_type or _ekf_type(self.settings)
        extended = model.extended_model()
        self._voltage_model = extended.model
        self._online = extended.online(self.settings.capacity_ah)
        self._has_effects = not self._online.plain
        self._curve = self._make_curve()
        self.capacity_ah = self._online.capacity_ah
        self.filter = HypothesisFilter(
            lambda: make_ekf(self._curve, self._online.steady_ohm, self.capacity_ah, model.noise)
        )
        self._counter = CoulombCounter(self.capacity_ah, self.settings.gap_s)
        self._clock = EstimatorClock()
        self._line = DelayLine(self._voltage_model.delay_s, gap_s=self.settings.gap_s)
        self._references = SocReferenceDetector(self.settings.full_charge, self.settings.long_rest)
        self._noise = MeasurementNoise(model, self._online)
        slow_v, lasting_v = model.noise.slow_std_v, model.noise.lasting_std_v
        self._bias_std_v = math.sqrt(slow_v * slow_v + lasting_v * lasting_v)
        self._functions = CurveFunctions(model.noise)
        self._nominal_v = self._voltage_model.pseudo_ocv_at(50.0)[0]
        self._health = HealthEstimator(
            self._curve,
            steady_ohm=self._online.steady_ohm,
            noise=model.noise,
            fast_std_v=effective_error_std_v(model.noise, 1.0 / model.rate_hz),
            nominal_v=self._nominal_v,
            capacity_ah=self.capacity_ah,
        )
        self._power = PowerModel(
            self._curve,
            self._voltage_model,
            model.noise,
            self.settings.limits.of_model(self._voltage_model),
        )
        self._permanent_reasons = temperature_mismatch(
            model.temperature_source, self.settings.temperature_source
        )
        self._memory = EstimatorMemory()
        self._since = ChargeSinceUpdate()
        self._is_filtering = False
        # Voltage less the pseudo-OCV at the latest sample [V], NaN until it is needed, and the
        # delayed currents [A] that it was computed from.
        self._without_ocv_v = math.nan
        self._delayed_a: Sequence[float] = ()
        self._implausible = Reason.NONE
        self.is_refused = False
        self._latest = Estimate.unknown(Reason.NO_INITIAL_SOC)
        # Sample and stamp of which the estimate is not computed yet; None: it is computed.
        self._pending: tuple[Sample, float] | None = None
        if self.settings.initial_soc_pct is not None:
            soc_pct = self._online.initial_soc_pct(self.settings.initial_soc_pct)
            self._start(soc_pct, self.settings.initial_soc_std_pct)

    def _make_curve(self) -> Curve:
        """Return the pseudo-OCV with effects; the compiled estimator has its own."""
        # Without effects the voltage model gives the same numbers with half the calls.
        return self._online if self._has_effects else self._voltage_model

    def step(self, sample: Sample) -> Estimate:
        """Process one sample and return the estimate after it; see `update`."""
        self.update(sample)
        return self.estimate

    def update(self, sample: Sample) -> None:
        """Process one sample.

        The estimate is computed on demand (`estimate`): a service receives thousands of samples
        and publishes ten estimates a second. Reading it changes nothing.

        A sample without a plausible current, or not later than the last one, is refused: the
        estimate stays the last one, marked `IMPLAUSIBLE_INPUT`. A clock that was set back is
        recognised after a few samples and followed. An implausible voltage or temperature counts
        as missing, and charge is still counted.

        Effects in the model correct the sample first. An effect may hold a sample back until it
        knows the current that belongs to it (`time_skew`); the estimate is then the one after the
        last sample released.
        """
        time_s = None
        if abs(sample.current_a) <= CURRENT_AT_MOST_A:  # false for NaN
            time_s = self._clock.time_of(sample.time_s)
        self.is_refused = time_s is None
        if time_s is None:
            return
        stamp_s = sample.time_s
        if time_s != stamp_s:
            sample = sample._replace(time_s=time_s)
        if self._has_effects:
            self._evaluate()  # effects may hold this sample back, which keeps the last estimate
        sample, self._implausible = drop_implausible(sample, self._nominal_v)
        memory = self._memory
        if memory.samples == 0:
            memory.first_s = time_s
        memory.samples += 1
        if not self._has_effects:
            self._process(sample)
            self._pending = sample, stamp_s
            return
        corrected = [Sample(*reading) for reading in self._online.correct(Reading(*sample))]
        for each in corrected:
            self._process(each)
        if corrected:
            self._pending = corrected[-1], stamp_s
        else:
            self._latest = self._latest._replace(time_s=stamp_s, samples=memory.samples)

    def uncounted_std_pct(self, seconds: float) -> float:
        """Return what the SoC's standard deviation lacks [%] when no sample came for a time [s]."""
        return self._counter.uncounted_std_pct(seconds)

    @property
    def estimate(self) -> Estimate:
        """The estimate after the latest sample; SoC and voltages are NaN until they are known."""
        latest = self._evaluate()
        if not self.is_refused:
            return latest
        reasons = latest.reasons | Reason.IMPLAUSIBLE_INPUT
        return latest._replace(reasons=reasons, status=status_of(reasons))

    @property
    def health(self) -> Health:
        """Capacity, resistance and current offset, with standard deviations."""
        health = self._health.health
        return health._replace(offset_a=self.filter.offset_a) if self._is_filtering else health

    @property
    def voltage_model(self) -> VoltageModel:
        """The voltage model without effects."""
        return self._voltage_model

    def pack_tick(self, sample: Sample) -> PackTick:
        """Return what is known of the pack after its latest sample, for its cells."""
        soc_pct, std_pct = self._soc_and_std_pct()
        is_known = self._memory.samples > 0 and not math.isnan(self._counter.state.time_s)
        without_ocv_v = self._voltage_without_ocv_v() if is_known else math.nan
        return PackTick(
            sample.time_s,
            soc_pct,
            std_pct,
            sample.voltage_v,
            without_ocv_v,
            dot(self._voltage_model.resistance_ohm, self._delayed_a),
            self._counter.state.moved_pct,
        )

    def current_changes(self, time_s: float, stamps_s: Sequence[float]) -> list[float]:
        """Return the current at a sample's time less that at other stamps [A]; NaN for NaN."""
        if math.isnan(self._counter.state.time_s):
            return [math.nan] * len(stamps_s)
        known = {each for each in stamps_s if not math.isnan(each)}
        at = {each: self._line.current_at(time_s - each) for each in known}
        now_a = self._line.current_at(0.0)
        return [now_a - at[each] if each in at else math.nan for each in stamps_s]

    def power(self) -> Power:
        """Return the currents possible for 10 s and the energy left, after the latest sample."""
        return self._power.at(self._pack_now(), self._line)

    def _pack_now(self) -> PackNow:
        memory = self._memory
        soc_pct, std_pct = self._soc_and_std_pct()
        is_level = self._counter.state.time_s - memory.level_s <= LEVEL_MEMORY_S
        return PackNow(
            soc_pct,
            std_pct,
            memory.temperature_c,
            memory.level_residual_v if is_level else math.nan,
            memory.level_drop_v,
            self.health,
        )

    @property
    def time_s(self) -> float:
        """The estimator's own time at the latest sample [s]: it always increases."""
        return self._clock.state.last_s

    def _process(self, sample: Sample) -> None:
        """Count the charge of a corrected sample, and use its voltage where that is due."""
        memory, since = self._memory, self._since
        time_s, current_a, _, temperature_c = sample
        counted_a = self._online.counted(current_a) if self._has_effects else current_a
        charge = self._counter.step(time_s, counted_a)
        self._line.push(time_s, current_a)
        self._without_ocv_v = math.nan

        since.seconds += charge.seconds
        since.discharged_pct += charge.discharged_pct
        since.moved_pct += abs(charge.discharged_pct)
        if charge.away_s:
            since.away_s += charge.away_s
            since.unseen_var_pct2 += charge.parked_std_pct * charge.parked_std_pct
        else:
            since.gap_var_pct2 += charge.gap_std_pct * charge.gap_std_pct
        if charge.seconds > self.settings.gap_s:
            memory.gap_until_s = time_s + self._voltage_model.delay_s[-1]
        if charge.gap_std_pct and not math.isnan(memory.coulomb_var_pct2):
            memory.coulomb_var_pct2 += charge.gap_std_pct * charge.gap_std_pct

        if abs(current_a) > REST_CURRENT_C_RATE * self.capacity_ah:
            memory.rest_since_s = math.nan
        elif math.isnan(memory.rest_since_s):
            memory.rest_since_s = time_s
        if charge.seconds > REST_S:  # an unobserved interval counts as rest
            memory.rest_since_s = time_s - charge.seconds

        if not math.isnan(temperature_c):
            memory.temperature_c = temperature_c
        if self._has_effects:
            self._online.advance(time_s, current_a, memory.temperature_c, self._line.currents())
        tick = math.floor((time_s - memory.first_s) * self.model.rate_hz + 1e-6)
        if tick > memory.tick:
            memory.tick = tick
            self._use_voltage(sample)

    def _use_voltage(self, sample: Sample) -> None:
        memory = self._memory
        rest_s = sample.time_s - memory.rest_since_s
        since, self._since = self._since, ChargeSinceUpdate()
        if self._is_filtering:
            self.filter.predict(since)
            if rest_s > REST_S:
                self.filter.shrink_bias()
        self._health.count(since)
        if math.isnan(sample.voltage_v):
            memory.newton_pct, memory.newton_inside = math.nan, True
            memory.newton_std_pct = math.nan
        else:
            self._update_with_voltage(sample, since)
        if self.settings.full_charge is not None or self.settings.long_rest is not None:
            for reference in self._references.detect(sample, rest_s, memory.newton_pct):
                self._correct(reference)
        if self._is_filtering and self.filter.is_lost():
            # Restart from the voltage if there is one, and forget the offset.
            known = (memory.newton_pct, _clip(self._coulomb_pct()), 50.0)
            soc_pct = next(soc for soc in known if not math.isnan(soc))
            self.filter.start(soc_pct, UNKNOWN_SOC_STD_PCT)
            memory.contradicted_until_s = sample.time_s + CONTRADICTED_S
            memory.resets += 1

    def _update_with_voltage(self, sample: Sample, since: ChargeSinceUpdate) -> None:
        memory = self._memory
        without_ocv_v = self._voltage_without_ocv_v()
        guess_pct = 50.0 if math.isnan(memory.newton_pct) else memory.newton_pct
        newton = soc_from_ocv(self._curve, sample.voltage_v - without_ocv_v, guess_pct)
        memory.newton_pct, memory.newton_inside = newton
        std_v, kt_std_v = self._noise.at(memory.temperature_c, self._line)
        drop_v = total(self._delayed_a) / len(self._delayed_a) * self._online.steady_ohm
        resistance_std_v = self._noise.resistance_std(memory.temperature_c) * drop_v
        slope = self._curve.pseudo_ocv_at(memory.newton_pct)[1]
        curve_std_v = self._functions.std_v(memory.newton_pct)
        parts_v = (std_v, self._bias_std_v, curve_std_v, kt_std_v, resistance_std_v)
        error_v = math.sqrt(dot(parts_v, parts_v))
        memory.newton_std_pct = min(error_v / slope, UNKNOWN_SOC_STD_PCT)
        if math.isnan(memory.coulomb_start_pct):
            # No initial SoC: start from the voltage's with a wide prior, from which the filter
            # learns how SoC and bias share what the voltage cannot separate.
            self._start(memory.newton_pct, UNKNOWN_SOC_STD_PCT)
            memory.coulomb_var_pct2 = memory.newton_std_pct * memory.newton_std_pct
        if self._is_filtering:
            measurement = Measurement(
                sample.voltage_v,
                without_ocv_v,
                memory.newton_pct,
                std_v,
                kt_std_v,
                resistance_std_v,
            )
            if self.filter.update(measurement, since):
                memory.contradicted_until_s = sample.time_s + CONTRADICTED_S
            ekf = self.filter.likelier
            memory.bias_pct = min(abs(ekf.bias_v) / slope, UNKNOWN_SOC_STD_PCT)
            if ekf.strain > MISMATCH_SIGMAS or self._has_other_capacity():
                memory.mismatch_until_s = sample.time_s + CONTRADICTED_S
        tick = self._voltage_tick(sample, without_ocv_v)
        self._health.use(tick, since.seconds)
        self._follow_level(tick, sample.time_s)

    def _follow_level(self, tick: VoltageTick, time_s: float) -> None:
        """Follow the levels of the residual and of the predicted drop."""
        memory = self._memory
        soc_pct = self._soc_and_std_pct()[0]
        residual_v = tick.voltage_v - tick.without_ocv_v - self._curve.pseudo_ocv_at(soc_pct)[0]
        weight = 1.0
        if time_s - memory.level_s < LEVEL_MEMORY_S:
            weight = -math.expm1((memory.level_s - time_s) / LEVEL_MEMORY_S)
        memory.level_residual_v += weight * (residual_v - memory.level_residual_v)
        memory.level_drop_v += weight * (tick.drop_v - memory.level_drop_v)
        memory.level_s = time_s

    def _voltage_tick(self, sample: Sample, without_ocv_v: float) -> VoltageTick:
        memory, model = self._memory, self._voltage_model
        cold, hot = model.temperature_range_c
        margin_k = TEMPERATURE_MARGIN_K
        drop_v = dot(model.resistance_ohm, self._delayed_a)
        return VoltageTick(
            sample.voltage_v,
            without_ocv_v,
            drop_v,
            memory.newton_pct if memory.newton_inside else math.nan,
            _clip(self._coulomb_pct()),
            is_filled=self._line.full,
            is_inside=cold - margin_k <= memory.temperature_c <= hot + margin_k,
        )

    def _voltage_without_ocv_v(self) -> float:
        """Return the model's voltage less the pseudo-OCV at the latest sample [V]."""
        if math.isnan(self._without_ocv_v):
            temperature_c = self._memory.temperature_c
            if math.isnan(temperature_c):
                temperature_c = self._voltage_model.t_ref_c
            self._delayed_a = self._line.currents()
            self._without_ocv_v = self._voltage_model.offset_at(temperature_c, self._delayed_a)
        return self._without_ocv_v

    def _start(self, soc_pct: float, std_pct: float) -> None:
        """Start counting, and the filter where it is used, from a SoC [%]."""
        self._start_count(soc_pct, std_pct * std_pct)
        if self.settings.method == "ekf":
            self.filter.start(soc_pct, std_pct)
            self._is_filtering = True
            self._since = ChargeSinceUpdate()

    def _start_count(self, soc_pct: float, var_pct2: float) -> None:
        memory, counter = self._memory, self._counter.state
        memory.coulomb_start_pct = soc_pct + counter.discharged_pct
        memory.coulomb_var_pct2 = var_pct2
        memory.coulomb_counted_s = counter.counted_s
        memory.coulomb_moved_pct = counter.moved_pct

    def _correct(self, reference: SocReference) -> None:
        """Fuse an external SoC reference into count and filter, weighted by the variances."""
        if math.isnan(self._memory.coulomb_start_pct):
            self._start(reference.soc_pct, reference.soc_std_pct)
            return
        if not reference.is_by_voltage:
            self._health.correct(reference.soc_pct, reference.soc_std_pct)
        soc_pct = _clip(self._coulomb_pct())
        std_pct, reference_std_pct = self._coulomb_std_pct(), reference.soc_std_pct
        var_pct2, reference_var_pct2 = std_pct * std_pct, reference_std_pct * reference_std_pct
        gain = var_pct2 / (var_pct2 + reference_var_pct2)
        self._start_count(soc_pct + gain * (reference.soc_pct - soc_pct), (1.0 - gain) * var_pct2)
        if self._is_filtering:
            self.filter.correct(reference.soc_pct, reference.soc_std_pct)

    def _evaluate(self) -> Estimate:
        """Return the estimate after the latest accepted sample."""
        if self._pending is None:
            return self._latest
        (sample, stamp_s), self._pending = self._pending, None
        soc_pct, std_pct = self._soc_and_std_pct()
        voltage_model_v = math.nan
        if not math.isnan(soc_pct):
            ocv_v = self._curve.pseudo_ocv_at(soc_pct)[0]
            voltage_model_v = ocv_v + self._voltage_without_ocv_v()
        reasons = self._reasons(sample, soc_pct, std_pct)
        self._latest = Estimate(
            stamp_s,
            soc_pct,
            std_pct,
            self._memory.newton_pct,
            _clip(self._coulomb_pct()),
            voltage_model_v,
            sample.voltage_v - voltage_model_v,
            status_of(reasons),
            reasons,
            self._memory.samples,
        )
        return self._latest

    def _soc_and_std_pct(self) -> tuple[float, float]:
        """Return SoC and standard deviation [%] of the chosen method; NaN until known."""
        memory, method = self._memory, self.settings.method
        if method == "newton":
            return memory.newton_pct, memory.newton_std_pct
        if math.isnan(memory.coulomb_start_pct):
            return math.nan, math.nan
        if method == "coulomb":
            return _clip(self._coulomb_pct()), self._coulomb_std_pct()
        soc_pct, std_pct = self.filter.soc_after(self._since)
        if self._counter.state.time_s < memory.mismatch_until_s:
            # A model that does not fit: as uncertain as its inputs disagree.
            counted_pct = _clip(self._coulomb_pct()) - soc_pct
            parts_pct = (std_pct, memory.bias_pct, counted_pct)
            std_pct = math.sqrt(dot(parts_pct, parts_pct))
        return soc_pct, std_pct

    def _has_other_capacity(self) -> bool:
        """Return whether the learned capacity is beyond what the filter allows for, surely."""
        capacity_ah, std_ah = self._health.capacity
        difference_ah = abs(capacity_ah - self.capacity_ah)
        allowed_ah = max(std_ah, CAPACITY_STD * self.capacity_ah)
        return difference_ah > MISMATCH_SIGMAS * allowed_ah

    def _coulomb_pct(self) -> float:
        """Return the SoC by counting alone [%], not clipped; NaN until counting has started."""
        return self._memory.coulomb_start_pct - self._counter.state.discharged_pct

    def _coulomb_std_pct(self) -> float:
        memory, counter = self._memory, self._counter.state
        hours = (counter.counted_s - memory.coulomb_counted_s) / 3600.0
        moved_pct = counter.moved_pct - memory.coulomb_moved_pct
        return count_std_pct(self.capacity_ah, memory.coulomb_var_pct2, hours, moved_pct)

    def _reasons(  # noqa: C901 - one line a reason
        self, sample: Sample, soc_pct: float, std_pct: float
    ) -> Reason:
        # In plain bits: operations on flags are slow. Comparisons with NaN are false.
        memory = self._memory
        bits = int(self._permanent_reasons)
        if self._implausible:
            bits |= int(self._implausible)
        if math.isnan(soc_pct):
            bits |= int(Reason.NO_INITIAL_SOC)
        if std_pct > self.settings.valid_std_pct:
            bits |= int(Reason.SOC_UNCERTAIN)
        if self._line.filled_s < self._voltage_model.delay_s[-1]:
            bits |= int(Reason.DELAY_LINE_FILLING)
        if sample.time_s < memory.gap_until_s:
            bits |= int(Reason.CURRENT_GAP)
        if math.isnan(sample.voltage_v):
            bits |= int(Reason.VOLTAGE_MISSING)
        if math.isnan(sample.temperature_c):
            bits |= int(Reason.TEMPERATURE_MISSING)
        if not memory.newton_inside:
            bits |= int(Reason.VOLTAGE_OUTSIDE_MODEL)
        if sample.time_s < memory.contradicted_until_s:
            bits |= int(Reason.INNOVATION_LARGE)
        if sample.time_s < memory.mismatch_until_s:
            bits |= int(Reason.MODEL_MISMATCH)
        outside = outside_model(self._voltage_model, soc_pct, sample)
        return REASONS[bits | int(outside) if outside else bits]

    def snapshot(self) -> EstimatorState:
        """Return a copy of everything needed to continue as if not interrupted."""
        latest = self._evaluate()
        return EstimatorState.model_construct(
            method=self.settings.method,
            capacity_ah=self.capacity_ah,
            clock=replace(self._clock.state),
            counter=replace(self._counter.state),
            line=DelayLineState(*self._line.contents),
            effects=self._online.state(),
            filter=self.filter.snapshot(),
            since=replace(self._since),
            references=replace(self._references.state),
            memory=replace(self._memory),
            health=self._health.snapshot(),
            estimate=list(latest[:7]),
            reasons=int(latest.reasons),
        )

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Continue from a state of the same model, and return its last estimate.

        With the state's method and capacity, the next sample continues bit for bit. With another
        method or capacity, only the SoC and its uncertainty are taken over.

        Parameters
        ----------
        state : EstimatorState
        age_s : float
            Minimum age of the state [s] by a clock other than the samples' stamps; NaN if no
            clock measured it. It overrides stamps that show less.

        Returns
        -------
        Estimate

        Raises
        ------
        InputError
            If the state does not fit the model; the estimator must then not be used.
        """
        self._resume(state, age_s)
        self._online.restore(state.effects, state.clock.last_s)
        self._references.state = replace(state.references)
        self._health.restore(state.health)
        if (state.method, state.capacity_ah) != (self.settings.method, self.capacity_ah):
            self._start_from(state)
            return self._latest
        if self.settings.method == "ekf" and not math.isnan(self._memory.coulomb_start_pct):
            self.filter.restore(state.filter)
            self._is_filtering = True
        if self.settings.method != "newton":
            self._check_agreement(state)
        return self._latest

    def take_over(self, before: Estimator) -> None:
        """Continue from another estimator, of another model or with other settings.

        SoC and standard deviation, the delay line, the last sample (so that counting continues) and
        the ends of gaps are carried over. The current's offset, the model's biases and the states
        of effects belong to the other model and are estimated again. An unknown SoC stays unknown.
        """
        state = before.snapshot()
        self._resume(state, before._clock.age_s)
        line = state.line
        if line.time_s and self._line.longest_s > before._line.longest_s:
            # The other delay line has dropped what this longer one needs.
            self._line.fill(line.time_s, line.current_a, max(line.since_s, line.time_s[0]))
        self._memory.tick = -1
        self._memory.level_s = math.nan
        self._health.take_over(before._health)
        self._start_from(state)

    def _resume(self, state: EstimatorState, age_s: float | None) -> None:
        """Copy from a state what depends on neither model nor settings."""
        self._clock.restore(replace(state.clock), age_s)
        self._counter.restore(replace(state.counter))
        self._line.fill(state.line.time_s, state.line.current_a, state.line.since_s)
        self._since = replace(state.since)
        self._memory = replace(state.memory)
        reasons = Reason(state.reasons)
        self._latest = Estimate._make(
            [*state.estimate, status_of(reasons), reasons, state.memory.samples]
        )
        self._pending, self.is_refused = None, False
        self._is_filtering = False

    def _start_from(self, state: EstimatorState) -> None:
        """Start from the SoC of another estimator, if it knew one."""
        coulomb_pct = state.estimate[4]
        self._memory.mismatch_until_s, self._memory.bias_pct = math.nan, 0.0
        if not (math.isnan(state.soc_pct) or math.isnan(state.soc_std_pct)):
            self._start(state.soc_pct, min(state.soc_std_pct, UNKNOWN_SOC_STD_PCT))
        elif not math.isnan(coulomb_pct):
            # The inverse has no SoC without a voltage; counting has.
            self._start(coulomb_pct, UNKNOWN_SOC_STD_PCT)
        else:
            self._memory.coulomb_start_pct = math.nan

    def _check_agreement(self, state: EstimatorState) -> None:
        """Refuse a state whose filter or count contradicts its last estimate."""
        soc_pct, std_pct = self._soc_and_std_pct()
        kept_std_pct = state.soc_std_pct
        # `take_over` limits the standard deviation that an estimator starts from.
        apart_pct = min(
            abs(std_pct - kept_std_pct), abs(std_pct - min(kept_std_pct, UNKNOWN_SOC_STD_PCT))
        )
        if abs(soc_pct - state.soc_pct) > AGREES_PCT or apart_pct > AGREES_PCT:
            raise InputError(
                f"the last estimate, {state.soc_pct:g} ± {kept_std_pct:g} %, contradicts filter"
                f" and count, {soc_pct:g} ± {std_pct:g} %",
                field="estimate",
            )


def _ekf_type(settings: EstimatorSettings) -> type[SocEkf]:
    if settings.filter == "reference":
        # filterpy is slow to import, and only a check needs it.
        from cangauge.estimation.reference_filter import ReferenceEkf  # noqa: PLC0415

        return ReferenceEkf
    return SocEkf


def _clip(soc_pct: float) -> float:
    """Return the SoC within 0–100 %; NaN stays NaN."""
    return soc_pct if math.isnan(soc_pct) else min(max(soc_pct, 0.0), 100.0)
