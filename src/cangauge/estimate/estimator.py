"""The estimator: one sample in, one estimate out. Pure: no clock, no files, no bus.

Charge is counted on every sample; the voltage is used at the model's rate, on the first sample at
or after each tick of bus time. The same samples give the same numbers, live or offline.
"""

from __future__ import annotations

import math

from cangauge.errors import InputError
from cangauge.estimate.counting import ChargeStep, CoulombCounter, EstimatorClock
from cangauge.estimate.ekf import UNKNOWN_SOC_STD_PCT, Measurement, MeasurementNoise, SocEkf
from cangauge.estimate.hypothesis_filter import HypothesisFilter, Since, Verdict
from cangauge.estimate.settings import Anchor, AnchorWatch, EstimatorSettings, Method
from cangauge.estimate.state import DelayLineState, EstimatorState
from cangauge.estimate.validity import (
    Estimate,
    Reason,
    Sample,
    Status,
    acceptable,
    cleaned,
    outside_model,
    status_of,
    temperature_mismatch,
)
from cangauge.model.delay_line import DelayLine
from cangauge.model.effects.base import Reading
from cangauge.model.model_file import Model
from cangauge.model.voltage_model import Inverse, soc_from_ocv

__all__ = ["Estimator", "EstimatorSettings", "Method"]

REST_CURRENT_C_RATE = 0.02
"""Below this current the pack rests [1/h]: 1.2 A at 60 Ah."""

REST_S = 600.0
"""After this long at rest, slow polarisation has decayed [s]."""

CONTRADICTED_S = 300.0
"""For how long after a lasting contradiction, or the filter's loss, the estimate is marked [s]."""

AGREES_PCT = 1e-6
"""A state's estimate is what its filter or count says, to rounding [%]."""


_SCALARS = (
    "samples",
    "first_s",
    "tick",
    "temperature_c",
    "newton_std_pct",
    "coulomb_start_pct",
    "coulomb_var_pct2",
    "coulomb_counted_s",
    "coulomb_moved_pct",
    "gap_until_s",
    "contradicted_until_s",
    "rest_since_s",
)
"""What the estimator itself remembers, by its attributes' names."""


class Estimator:
    """Voltage model, delay line, inverse, Coulomb counter and fusion in one.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings, optional
    """

    def __init__(self, model: Model, settings: EstimatorSettings | None = None) -> None:
        self.settings = settings or EstimatorSettings()
        self._file = model
        extended = model.extended_model()
        self._model = extended.model
        self._online = extended.online(self.settings.capacity_ah)
        self._is_plain = self._online.plain
        self.capacity_ah = self._online.capacity_ah
        self._counter = CoulombCounter(self.capacity_ah, self.settings.gap_s)
        self._line = DelayLine(self._model.delay_s, gap_s=self.settings.gap_s)
        noise = model.noise
        self._fusion = HypothesisFilter(lambda: SocEkf(self._online, self.capacity_ah, noise))
        self._anchors = AnchorWatch(self.settings.full_charge, self.settings.long_rest)
        self._bias_std_v = math.hypot(noise.slow_std_v, noise.lasting_std_v)
        self._voltage_error = MeasurementNoise(self._model, model, self.capacity_ah)
        self._standing = temperature_mismatch(
            model.temperature_source, self.settings.temperature_source
        )
        self._usual_v = self._model.pseudo_ocv_at(50.0)[0]
        self._implausible = Reason.NONE
        self._samples = 0
        self._first_s = 0.0
        self._clock = EstimatorClock()
        self._tick = -1
        self._temperature_c = math.nan
        # SoC by each method: NaN until it is known. The counter's is the SoC that it began from.
        self._newton = Inverse(math.nan, inside=True)
        self._newton_std_pct = math.nan
        self._coulomb_start_pct = math.nan
        self._coulomb_var_pct2 = math.nan
        # What was counted when the counter's SoC was last known to that variance.
        self._coulomb_counted_s = 0.0
        self._coulomb_moved_pct = 0.0
        self._fused = False
        # Since the last voltage that was used: what the filter must be carried over.
        self._since = Since()
        # NaN: never.
        self._gap_until_s = math.nan
        self._contradicted_until_s = math.nan
        self.resets = 0
        """How often the filter was lost and started anew."""
        self._rest_since_s = math.nan
        self._made = _nothing_yet()
        # What the next estimate is to be made of, the sample and its stamp; None: it is made.
        self._unmade: tuple[Sample, float] | None = None
        self._is_refused = False
        if self.settings.initial_soc_pct is not None:
            start = self._online.initial_soc_pct(self.settings.initial_soc_pct)
            self._begin(start, self.settings.initial_soc_std_pct)

    @property
    def offset_a(self) -> float:
        """Estimated offset of the current sensor [A]; 0 without fusion."""
        return self._fusion.offset_a if self._fused else 0.0

    def step(self, sample: Sample) -> Estimate:
        """Take one sample and return the estimate after it; see `take`."""
        self.take(sample)
        return self.estimate

    def take(self, sample: Sample) -> None:
        """Take one sample.

        What it does to the estimate is worked out when somebody asks for it: a service that hears
        thousands of samples a second tells ten of them. Asking changes nothing.

        A sample without a believable current, or not later than the one before, is refused: the
        last estimate comes back, marked `IMPLAUSIBLE_INPUT`; a clock that was set back is noticed
        after a few and followed. A voltage or temperature that cannot be true counts as missing,
        and charge is still counted.

        With effects in the model the sample is corrected first. An effect may hold a sample back
        until it knows the current that belongs to it (`time_skew`); the estimate then is the one
        after the last sample that was given out.
        """
        time_s = self._clock.at(sample.time_s) if acceptable(sample) else None
        self._is_refused = time_s is None
        if time_s is None:
            return
        stamp_s = sample.time_s
        if not self._is_plain:
            self._make()  # an effect may hold this sample back, and the estimate stays that one
        if time_s != stamp_s:
            sample = sample._replace(time_s=time_s)
        sample, self._implausible = cleaned(sample, self._usual_v)
        if self._samples == 0:
            self._first_s = time_s
        self._samples += 1
        if self._is_plain:
            self._take(sample)
            self._unmade = sample, stamp_s
        else:
            self._take_corrected(sample, stamp_s)

    @property
    def estimate(self) -> Estimate:
        """The estimate after the latest sample."""
        made = self._make()
        if not self._is_refused:
            return made
        reasons = made.reasons | Reason.IMPLAUSIBLE_INPUT
        return made._replace(reasons=reasons, status=status_of(reasons))

    def _take_corrected(self, sample: Sample, stamp_s: float) -> None:
        corrected = [Sample(*reading) for reading in self._online.correct(Reading(*sample))]
        for item in corrected:
            self._take(item)
        if corrected:
            self._unmade = corrected[-1], stamp_s
        else:
            self._made = self._made._replace(time_s=stamp_s, samples=self._samples)

    def _take(self, sample: Sample) -> None:
        time_s, current_a = sample.time_s, sample.current_a
        charge = self._counter.step(time_s, self._online.counted(current_a))
        self._line.push(time_s, current_a)
        self._account(charge, time_s, current_a)
        if math.isfinite(sample.temperature_c):
            self._temperature_c = sample.temperature_c
        if not self._is_plain:
            self._online.advance(time_s, current_a, self._temperature_c, self._line.currents())
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
        self._begin_count(soc_pct, std_pct**2)
        if self.settings.method == "ekf":
            self._fusion.start(soc_pct, std_pct)
            self._fused = True
            self._since = Since()

    def _begin_count(self, soc_pct: float, var_pct2: float) -> None:
        self._coulomb_start_pct = soc_pct + self._counter.discharged_pct
        self._coulomb_var_pct2 = var_pct2
        self._coulomb_counted_s = self._counter.counted_s
        self._coulomb_moved_pct = self._counter.moved_pct

    def _anchor(self, anchor: Anchor) -> None:
        """Take a SoC in that is known otherwise, as far as the two uncertainties say."""
        if math.isnan(self._coulomb_start_pct):
            self._begin(anchor.soc_pct, anchor.soc_std_pct)
            return
        soc_pct = _clip(self._coulomb_start_pct - self._counter.discharged_pct)
        before, of_anchor = self._coulomb_std_pct() ** 2, anchor.soc_std_pct**2
        gain = before / (before + of_anchor)
        self._begin_count(soc_pct + gain * (anchor.soc_pct - soc_pct), (1.0 - gain) * before)
        if self._fused:
            self._fusion.anchor(anchor.soc_pct, anchor.soc_std_pct)

    # --- voltage --------------------------------------------------------------------------

    def _use_voltage(self, sample: Sample) -> None:
        before_pct, _ = self._chosen(self._coulomb_pct)
        since, self._since = self._since, Since()
        if self._fused:
            self._fusion.predict(since)
            if sample.time_s - self._rest_since_s > REST_S:
                self._fusion.rested()
        if not math.isfinite(sample.voltage_v):
            self._newton = Inverse(math.nan, inside=True)
            self._newton_std_pct = math.nan
        else:
            self._weigh_voltage(sample, since)
        for anchor in self._anchors.see(
            sample, sample.time_s - self._rest_since_s, self._newton.soc_pct
        ):
            self._anchor(anchor)
        if self._fused and self._fusion.is_lost:
            self._reset(sample.time_s, before_pct)

    def _weigh_voltage(self, sample: Sample, since: Since) -> None:
        beside_v = self._model.offset_at(self._known_temperature_c(), self._line.currents())
        guess = self._newton.soc_pct if math.isfinite(self._newton.soc_pct) else 50.0
        self._newton = soc_from_ocv(self._online, sample.voltage_v - beside_v, guess)
        std_v_at = self._voltage_error.at(self._temperature_c, self._line)
        std_v = std_v_at(self._fusion.soc_pct if self._fused else self._newton.soc_pct)
        slope = self._online.pseudo_ocv_at(self._newton.soc_pct)[1]
        self._newton_std_pct = min(math.hypot(std_v, self._bias_std_v) / slope, UNKNOWN_SOC_STD_PCT)
        if math.isnan(self._coulomb_start_pct):
            # Nothing known before: the voltage says where to begin, and the filter starts wide,
            # so that it learns how SoC and bias share what the voltage cannot tell apart.
            self._begin(self._newton.soc_pct, UNKNOWN_SOC_STD_PCT)
            self._coulomb_var_pct2 = self._newton_std_pct**2
        if self._fused and self._fusion.update(
            Measurement(sample.voltage_v, beside_v, self._newton.soc_pct, std_v_at), since
        ):
            self._contradicted_until_s = sample.time_s + CONTRADICTED_S

    def _reset(self, time_s: float, before_pct: float) -> None:
        """Start the filter anew, from the voltage if there is one, and forget its offset."""
        known = (self._newton.soc_pct, before_pct, 50.0)
        soc_pct = next(soc for soc in known if math.isfinite(soc))
        self._fusion.start(soc_pct, UNKNOWN_SOC_STD_PCT)
        self._contradicted_until_s = time_s + CONTRADICTED_S
        self.resets += 1

    # --- estimate -------------------------------------------------------------------------

    def _make(self) -> Estimate:
        """Return the estimate after the latest sample that was not refused."""
        if self._unmade is not None:
            self._made = self._estimate(*self._unmade)
            self._unmade = None
        return self._made

    def _estimate(self, sample: Sample, time_s: float) -> Estimate:
        coulomb = self._coulomb_pct
        soc, std = self._chosen(coulomb)
        voltage_model_v = math.nan
        if math.isfinite(soc):
            beside_v = self._model.offset_at(self._known_temperature_c(), self._line.currents())
            voltage_model_v = self._online.pseudo_ocv_at(soc)[0] + beside_v
        reasons = self._reasons(sample, soc, std)
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
            return _clip(coulomb_pct), self._coulomb_std_pct()
        # Between voltages the filter's SoC moves by the charge counted since.
        moved = self._since.discharged_pct - self._fusion.offset_pct(self._since.counted_s)
        return _clip(self._fusion.soc_pct - moved), math.sqrt(
            self._fusion.soc_std_pct**2 + self._since.spread_pct2()
        )

    @property
    def _coulomb_pct(self) -> float:
        """What counting alone says [%], not clipped; NaN while it has not begun."""
        return self._coulomb_start_pct - self._counter.discharged_pct

    def _coulomb_std_pct(self) -> float:
        hours = (self._counter.counted_s - self._coulomb_counted_s) / 3600.0
        moved_pct = self._counter.moved_pct - self._coulomb_moved_pct
        return self._fusion.count_std_pct(self._coulomb_var_pct2, hours, moved_pct)

    def _reasons(self, sample: Sample, soc_pct: float, std_pct: float) -> Reason:
        # Operations on flags are slow, and mostly there are none.
        reasons = self._standing
        if self._implausible:
            reasons |= self._implausible
        if math.isnan(soc_pct):
            reasons |= Reason.NO_INITIAL_SOC
        if std_pct > self.settings.valid_std_pct:
            reasons |= Reason.SOC_UNCERTAIN
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
        outside = outside_model(self._model, soc_pct, sample)
        return reasons | outside if outside else reasons

    # --- interruptions --------------------------------------------------------------------

    @property
    def pause_verdict(self) -> Verdict:
        """How the SoC over the last long pause was judged by the voltage after it."""
        return self._fusion.verdict

    def snapshot(self) -> EstimatorState:
        """Return all that must be remembered to go on as if not interrupted: copies."""
        times, currents, since_s = self._line.contents
        latest = self._make()
        return EstimatorState.model_construct(
            method=self.settings.method,
            capacity_ah=self.capacity_ah,
            clock=self._clock.state(),
            counter=self._counter.state(),
            line=DelayLineState.model_construct(time_s=times, current_a=currents, since_s=since_s),
            effects=self._online.state(),
            belief=self._fusion.state(),
            since=self._since.state(),
            anchors=self._anchors.state(),
            newton_pct=self._newton.soc_pct,
            newton_inside=self._newton.inside,
            estimate=list(latest[:7]),
            reasons=int(latest.reasons),
            resets=self.resets,
            **{name: getattr(self, f"_{name}") for name in _SCALARS},
        )

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Go on from a state; return its last estimate.

        With the state's own method and capacity everything is taken over, and the next sample
        goes on bit for bit. With another method or capacity the SoC is, with its uncertainty.

        Parameters
        ----------
        state : EstimatorState
            Of the same model.
        age_s : float
            How old the state is at least, by a clock that the samples' stamps do not come from
            [s]; NaN if none knows. If the stamps show less, the age is believed.

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
        self._anchors.restore(state.anchors)
        self.resets = state.resets
        is_same = (state.method, state.capacity_ah) == (self.settings.method, self.capacity_ah)
        if not is_same:
            self._begin_from(state)
        elif self.settings.method == "ekf" and math.isfinite(self._coulomb_start_pct):
            self._fusion.restore(state.belief)
            self._fused = True
        if is_same:
            self._check_agreement(state)
        return self._made

    def _check_agreement(self, state: EstimatorState) -> None:
        """Refuse a state whose filter or count says something else than its last estimate."""
        if self.settings.method == "newton":
            return
        soc, std = self._chosen(self._coulomb_pct)
        kept_std = state.soc_std_pct
        # An estimator that has just taken over from another one began from no more than that.
        apart_pct = min(abs(std - kept_std), abs(std - min(kept_std, UNKNOWN_SOC_STD_PCT)))
        if abs(soc - state.soc_pct) > AGREES_PCT or apart_pct > AGREES_PCT:
            raise InputError(
                f"the last estimate, {state.soc_pct:g} ± {kept_std:g} %, is not what filter and"
                f" count say, {soc:g} ± {std:g} %",
                field="estimate",
            )

    def take_over(self, before: Estimator) -> None:
        """Go on where another estimator stands, of another model or other settings.

        SoC and standard deviation are carried over, and so are the delay line, the last sample,
        from which charge is counted on, and the marks of gaps. What was learned of the current's
        offset and the model's bias belongs to the other model, and is learned anew; so are the
        inner states of effects. Where the other one knows no SoC yet, neither does this one.
        """
        state = before.snapshot()
        self._resume(state, before._clock.age_s)
        line = state.line
        if line.time_s and self._line.longest_s > before._line.longest_s:
            # The other one has forgotten what this one would need.
            self._line.fill(line.time_s, line.current_a, max(line.since_s, line.time_s[0]))
        self._tick = -1
        self._begin_from(state)

    def _resume(self, state: EstimatorState, age_s: float | None) -> None:
        """Take over what does not depend on model and settings."""
        self._clock.restore(state.clock, age_s)
        self._counter.restore(state.counter)
        self._line.fill(state.line.time_s, state.line.current_a, state.line.since_s)
        self._since = Since.of(state.since)
        self._newton = Inverse(state.newton_pct, state.newton_inside)
        for name in _SCALARS:
            setattr(self, f"_{name}", getattr(state, name))
        reasons = Reason(state.reasons)
        self._made = Estimate._make([*state.estimate, status_of(reasons), reasons, state.samples])
        self._unmade, self._is_refused = None, False
        self._fused = False

    def _begin_from(self, state: EstimatorState) -> None:
        """Begin from the SoC that another estimator knew, if it knew any."""
        coulomb_pct = state.estimate[4]
        if math.isfinite(state.soc_pct) and math.isfinite(state.soc_std_pct):
            self._begin(state.soc_pct, min(state.soc_std_pct, UNKNOWN_SOC_STD_PCT))
        elif math.isfinite(coulomb_pct):
            # The inverse without a voltage knows nothing; counting still does.
            self._begin(coulomb_pct, UNKNOWN_SOC_STD_PCT)
        else:
            self._coulomb_start_pct = math.nan


def _clip(soc_pct: float) -> float:
    return soc_pct if math.isnan(soc_pct) else min(max(soc_pct, 0.0), 100.0)


def _nothing_yet() -> Estimate:
    nan = math.nan
    return Estimate(
        nan, nan, nan, nan, nan, nan, nan, Status.INITIALISING, Reason.NO_INITIAL_SOC, 0
    )
