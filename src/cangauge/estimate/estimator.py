"""The estimator: one sample in, one estimate out. Pure: no clock, no files, no bus.

Charge is counted on every sample; the voltage is used at the model's rate, on the first sample at
or after each tick of bus time. The same samples give the same numbers, live or offline.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from cangauge.errors import InputError
from cangauge.estimate.coulomb import ChargeStep, CoulombCounter
from cangauge.estimate.fusion import UNKNOWN_SOC_STD_PCT, Fusion, Measurement
from cangauge.estimate.types import Estimate, Reason, Sample, Status
from cangauge.estimate.validity import (
    acceptable,
    cleaned,
    outside_model,
    outside_model_std_v,
    status_of,
    temperature_mismatch,
)
from cangauge.logs.log import TemperatureSource
from cangauge.model.delay_line import GAP_S, DelayLine
from cangauge.model.effects.effect import Reading
from cangauge.model.inverse import Inverse, soc_from_ocv
from cangauge.model.model_file import ModelFile, effective_error_std_v

Method = Literal["ekf", "newton", "coulomb"]

REST_CURRENT_C_RATE = 0.02
"""Below this current the pack rests [1/h]: 1.2 A at 60 Ah."""

REST_S = 600.0
"""After this long at rest, slow polarisation has decayed [s]."""

USUAL_CURRENT_C_RATE = 1.0 / 3.0
"""What a current that was not seen may have been [1/h]: 20 A at 60 Ah."""

CONTRADICTED_S = 300.0
"""For how long after a lasting contradiction the estimate is marked [s]."""

TEMPERATURE_STD_K = 10.0
"""Uncertainty of a temperature that is not measured [K]."""


@dataclass(frozen=True)
class EstimatorSettings:
    """What a user may choose.

    Parameters
    ----------
    method : {"ekf", "newton", "coulomb"}
        Whose SoC is published.
    initial_soc_pct : float, optional
        SoC at the first sample [%]; by default from the first voltages.
    initial_soc_std_pct : float
        Its standard deviation [%].
    capacity_ah : float, optional
        Overrides the model's capacity [Ah].
    gap_s : float
        A longer step between current samples is a gap [s].
    temperature_source : str
        What the input's temperature is measured on.
    """

    method: Method = "ekf"
    initial_soc_pct: float | None = None
    initial_soc_std_pct: float = 1.0
    capacity_ah: float | None = None
    gap_s: float = GAP_S
    temperature_source: TemperatureSource = "unknown"

    def __post_init__(self) -> None:
        for name, low, high in (
            ("initial_soc_pct", 0.0, 100.0),
            ("initial_soc_std_pct", 0.0, 100.0),
            ("capacity_ah", 1e-3, 1e5),
            ("gap_s", 1e-3, 3600.0),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"must lie within {low:g} … {high:g}", field=name, value=value)


class Estimator:
    """Voltage model, delay line, inverse, Coulomb counter and fusion in one.

    Parameters
    ----------
    model : ModelFile
    settings : EstimatorSettings, optional
    """

    def __init__(self, model: ModelFile, settings: EstimatorSettings | None = None) -> None:
        self.settings = settings or EstimatorSettings()
        self._file = model
        extended = model.extended_model()
        self._model = extended.model
        self._online = extended.online(self.settings.capacity_ah)
        self.capacity_ah = self._online.capacity_ah
        self._counter = CoulombCounter(self.capacity_ah, self.settings.gap_s)
        self._line = DelayLine(self._model.delay_s, gap_s=self.settings.gap_s)
        noise = model.noise
        self._fusion = Fusion(self._online, self.capacity_ah, noise)
        self._bias_std_v = math.hypot(noise.slow_std_v, noise.lasting_std_v)
        self._fast_std_v = effective_error_std_v(noise, 1.0 / model.rate_hz)
        self._standing = temperature_mismatch(
            model.temperature_source, self.settings.temperature_source
        )
        self._usual_v = self._model.pseudo_ocv_at(50.0)[0]
        self._implausible = Reason.NONE
        self._samples = 0
        self._first_s = 0.0
        self._last_s = -math.inf
        self._tick = -1
        self._temperature_c = math.nan
        # SoC by each method: NaN until it is known. The counter's is the SoC that it began from.
        self._newton = Inverse(math.nan, inside=True)
        self._newton_std_pct = math.nan
        self._coulomb_start_pct = math.nan
        self._coulomb_var_pct2 = math.nan
        self._fused = False
        # Since the last voltage that was used: what the filter must be carried over.
        self._since = _Since()
        self._gap_until_s = -math.inf
        self._contradicted_until_s = -math.inf
        self._rest_since_s = math.nan
        self._last_estimate = _nothing_yet()
        if self.settings.initial_soc_pct is not None:
            start = self._online.initial_soc_pct(self.settings.initial_soc_pct)
            self._begin(start, self.settings.initial_soc_std_pct)

    @property
    def offset_a(self) -> float:
        """Estimated offset of the current sensor [A]; 0 without fusion."""
        return self._fusion.offset_a if self._fused else 0.0

    def take_over(self, before: Estimator) -> None:
        """Go on where another estimator stands, of another model or other settings.

        SoC and standard deviation are carried over, and so are the delay line, the last sample,
        from which charge is counted on, and the marks of gaps. What was learned of the current's
        offset and the model's bias belongs to the other model, and is learned anew; so are the
        inner states of effects. Where the other one knows no SoC yet, neither does this one.
        """
        self._samples = before._samples
        self._first_s = before._first_s
        self._last_s = before._last_s
        self._temperature_c = before._temperature_c
        self._gap_until_s = before._gap_until_s
        self._rest_since_s = before._rest_since_s
        self._line.take_over(before._line)
        self._counter.take_over(before._counter)
        self._last_estimate = latest = before._last_estimate
        if math.isfinite(latest.soc_pct) and math.isfinite(latest.soc_std_pct):
            self._begin(latest.soc_pct, latest.soc_std_pct)
        elif math.isfinite(latest.soc_coulomb_pct):
            # The inverse without a voltage knows nothing; counting still does.
            self._begin(latest.soc_coulomb_pct, UNKNOWN_SOC_STD_PCT)

    def step(self, sample: Sample) -> Estimate:
        """Take one sample and return the estimate after it.

        A sample without a believable current, or not later than the one before, is refused: the
        last estimate comes back, marked `IMPLAUSIBLE_INPUT`. A voltage or temperature that cannot
        be true counts as missing, and charge is still counted.

        With effects in the model the sample is corrected first. An effect may hold a sample back
        until it knows the current that belongs to it (`time_skew`); the estimate then is the one
        after the last sample that was given out.
        """
        if not acceptable(sample) or sample.time_s <= self._last_s:
            return self._refuse()
        sample, self._implausible = cleaned(sample, self._usual_v)
        if self._samples == 0:
            self._first_s = sample.time_s
        self._samples += 1
        self._last_s = sample.time_s
        corrected = self._corrected(sample)
        for item in corrected:
            self._take(item)
        if corrected:
            self._last_estimate = self._estimate(corrected[-1], sample.time_s)
        else:
            self._last_estimate = self._last_estimate._replace(
                time_s=sample.time_s, samples=self._samples
            )
        return self._last_estimate

    def _corrected(self, sample: Sample) -> Sequence[Sample]:
        if self._online.plain:
            return (sample,)
        return [Sample(*reading) for reading in self._online.correct(Reading(*sample))]

    def _take(self, sample: Sample) -> None:
        time_s, current_a = sample.time_s, sample.current_a
        charge = self._counter.step(time_s, self._online.counted(current_a))
        self._line.push(time_s, current_a)
        self._account(charge, time_s, current_a)
        if math.isfinite(sample.temperature_c):
            self._temperature_c = sample.temperature_c
        if not self._online.plain:
            self._online.advance(
                time_s, current_a, self._known_temperature_c(), self._line.currents()
            )
        tick = math.floor((time_s - self._first_s) * self._file.rate_hz + 1e-6)
        if tick > self._tick:
            self._tick = tick
            self._use_voltage(sample)

    def _known_temperature_c(self) -> float:
        """Return the last temperature, or where none was ever known the model's reference."""
        known = math.isfinite(self._temperature_c)
        return self._temperature_c if known else self._model.t_ref_c

    # --- charge ---------------------------------------------------------------------------

    def _account(self, charge: ChargeStep, time_s: float, current_a: float) -> None:
        self._since.add(charge)
        if charge.seconds > self.settings.gap_s:
            self._gap_until_s = time_s + self._model.delay_s[-1]
        if charge.gap_std_pct and math.isfinite(self._coulomb_var_pct2):
            self._coulomb_var_pct2 += charge.gap_std_pct**2
        # Away for long with the bus asleep is a rest too, and the best one.
        if abs(current_a) > REST_CURRENT_C_RATE * self.capacity_ah:
            self._rest_since_s = math.nan
        elif math.isnan(self._rest_since_s):
            self._rest_since_s = time_s
        if charge.seconds > REST_S:
            self._rest_since_s = time_s - charge.seconds

    def _begin(self, soc_pct: float, std_pct: float) -> None:
        self._coulomb_start_pct = soc_pct + self._counter.discharged_pct
        self._coulomb_var_pct2 = std_pct**2
        if self.settings.method == "ekf":
            self._fusion.start(soc_pct, std_pct)
            self._fused = True
            self._since = _Since()

    # --- voltage --------------------------------------------------------------------------

    def _use_voltage(self, sample: Sample) -> None:
        since, self._since = self._since, _Since()
        if self._fused:
            self._fusion.predict(
                since.seconds, since.discharged_pct, since.moved_pct, since.gap_var_pct2
            )
            if sample.time_s - self._rest_since_s > REST_S:
                self._fusion.rested()
        if not math.isfinite(sample.voltage_v):
            self._newton = Inverse(math.nan, inside=True)
            return
        beside_v = self._model.offset_at(self._known_temperature_c(), self._line.currents())
        guess = self._newton.soc_pct if math.isfinite(self._newton.soc_pct) else 50.0
        self._newton = soc_from_ocv(self._online, sample.voltage_v - beside_v, guess)
        std_v = self._error_std_v()
        slope = self._online.pseudo_ocv_at(self._newton.soc_pct)[1]
        self._newton_std_pct = min(math.hypot(std_v, self._bias_std_v) / slope, UNKNOWN_SOC_STD_PCT)
        if math.isnan(self._coulomb_start_pct):
            # Nothing known before: the voltage says where to begin, and the filter starts wide,
            # so that it learns how SoC and bias share what the voltage cannot tell apart.
            self._begin(self._newton.soc_pct, UNKNOWN_SOC_STD_PCT)
            self._coulomb_var_pct2 = self._newton_std_pct**2
        if self._fused and self._fusion.update(
            Measurement(sample.voltage_v, beside_v, std_v), since.seconds
        ):
            self._contradicted_until_s = sample.time_s + CONTRADICTED_S

    def _error_std_v(self) -> float:
        """Return the fast error of this voltage [V], larger where the model is out of its depth."""
        squares = self._fast_std_v**2
        if not self._line.full:
            squares = self._filling_var_v2(squares)
        if math.isnan(self._temperature_c):
            squares += (self._model.kt_v_per_k * TEMPERATURE_STD_K) ** 2
        soc = self._fusion.soc_pct if self._fused else self._newton.soc_pct
        squares += outside_model_std_v(self._model, soc, self._temperature_c) ** 2
        return math.sqrt(squares)

    def _filling_var_v2(self, settled_var_v2: float) -> float:
        """Return the error's variance while the delay line fills [V²].

        The currents before the first sample are a guess, and the same guess for all samples until
        the line is full: together they must tell no more than one of them.
        """
        filled = self._line.filled_s
        unknown_ohm = sum(
            abs(resistance)
            for resistance, delay in zip(
                self._model.resistance_ohm, self._model.delay_s, strict=True
            )
            if delay > filled
        )
        guess_v = unknown_ohm * USUAL_CURRENT_C_RATE * self.capacity_ah
        alike = max(self._model.delay_s[-1] * self._file.rate_hz, 1.0)
        return (settled_var_v2 + guess_v**2) * alike

    # --- estimate -------------------------------------------------------------------------

    def _estimate(self, sample: Sample, time_s: float) -> Estimate:
        coulomb = self._coulomb_start_pct - self._counter.discharged_pct
        soc, std = self._chosen(coulomb)
        voltage_model_v = math.nan
        if math.isfinite(soc):
            beside_v = self._model.offset_at(self._known_temperature_c(), self._line.currents())
            voltage_model_v = self._online.pseudo_ocv_at(soc)[0] + beside_v
        reasons = self._reasons(sample, soc)
        return Estimate(
            time_s=time_s,
            soc_pct=soc,
            soc_std_pct=std,
            soc_newton_pct=self._newton.soc_pct,
            soc_coulomb_pct=_clip(coulomb),
            voltage_model_v=voltage_model_v,
            residual_v=sample.voltage_v - voltage_model_v,
            status=status_of(reasons),
            reasons=reasons,
            samples=self._samples,
        )

    def _chosen(self, coulomb_pct: float) -> tuple[float, float]:
        """Return SoC and standard deviation [%] of the method that was asked for."""
        method = self.settings.method
        if method == "newton":
            return self._newton.soc_pct, self._newton_std_pct
        if math.isnan(self._coulomb_start_pct):
            return math.nan, math.nan
        if method == "coulomb":
            hours = (self._last_s - self._first_s) / 3600.0
            std = self._fusion.count_std_pct(self._coulomb_var_pct2, hours, self._counter.moved_pct)
            return _clip(coulomb_pct), std
        # Between voltages the filter's SoC moves by the charge counted since.
        moved = self._since.discharged_pct - self._fusion.offset_pct(self._since.seconds)
        return _clip(self._fusion.soc_pct - moved), math.sqrt(
            self._fusion.soc_std_pct**2 + self._since.gap_var_pct2
        )

    def _reasons(self, sample: Sample, soc_pct: float) -> Reason:
        reasons = self._standing | self._implausible
        if math.isnan(soc_pct):
            reasons |= Reason.NO_INITIAL_SOC
        if not self._line.full:
            reasons |= Reason.DELAY_LINE_FILLING
        if sample.time_s < self._gap_until_s:
            reasons |= Reason.CURRENT_GAP
        if math.isnan(sample.voltage_v):
            reasons |= Reason.VOLTAGE_MISSING
        if math.isnan(sample.temperature_c):
            reasons |= Reason.TEMPERATURE_MISSING
        if not self._newton.inside:
            reasons |= Reason.VOLTAGE_OUTSIDE_MODEL
        if sample.time_s < self._contradicted_until_s:
            reasons |= Reason.INNOVATION_LARGE
        return reasons | outside_model(self._model, soc_pct, sample)

    def _refuse(self) -> Estimate:
        last = self._last_estimate
        reasons = last.reasons | Reason.IMPLAUSIBLE_INPUT
        return last._replace(reasons=reasons, status=status_of(reasons))


@dataclass
class _Since:
    """Charge since the last voltage that was used."""

    seconds: float = 0.0
    discharged_pct: float = 0.0
    moved_pct: float = 0.0
    gap_var_pct2: float = 0.0

    def add(self, charge: ChargeStep) -> None:
        self.seconds += charge.seconds
        self.discharged_pct += charge.discharged_pct
        self.moved_pct += abs(charge.discharged_pct)
        self.gap_var_pct2 += charge.gap_std_pct**2


def _clip(soc_pct: float) -> float:
    return soc_pct if math.isnan(soc_pct) else min(max(soc_pct, 0.0), 100.0)


def _nothing_yet() -> Estimate:
    nan = math.nan
    return Estimate(
        nan, nan, nan, nan, nan, nan, nan, Status.INITIALISING, Reason.NO_INITIAL_SOC, 0
    )
