"""The estimator: samples → estimates. Pure: no clock, no files, no bus.

Charge is counted on every sample. The voltage is compared with the model at the model's rate (1 Hz
rows: inverse and residual), and corrects the filter once per block with the mean of its rows.
Between blocks the filter's SoC is counted on. The same samples give the same numbers, live or
offline.
"""

from __future__ import annotations

import json
import math
from base64 import b64decode, b64encode
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, ClassVar, Final

import numpy as np

from cangauge._version import __version__
from cangauge.errors import InputError
from cangauge.estimation import checks
from cangauge.estimation.cells import PackTick
from cangauge.estimation.counting import (
    UNKNOWN_INTERRUPTION_S,
    UNKNOWN_STD_PCT,
    CoulombCounter,
    EstimatorClock,
    count_std_pct,
    moved_std_pct,
    parked_std_pct,
)
from cangauge.estimation.ekf import inverse_std_pct
from cangauge.estimation.health import health_of
from cangauge.estimation.power import PowerModel
from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.start import WRONG_PRIOR, WRONG_STD_PCT, Hypotheses
from cangauge.estimation.state import Block, BlockState, EstimatorMemory, EstimatorState
from cangauge.model.inverse import soc_from_ocv
from cangauge.model.model_file import Model, as_model
from cangauge.model.voltage_model import VoltageModel
from cangauge.types import (
    CURRENT_AT_MOST_A,
    REASONS,
    Estimate,
    Health,
    Power,
    Reason,
    Sample,
    Status,
    status_of,
)

CONTRADICTED_S: Final = 300.0
"""How long a rejected hypothesis, or a restart of the filter, degrades the estimate [s]."""


class Estimator:
    """SoC estimator: voltage model, delay line, Coulomb counter and Kalman filter.

    Parameters
    ----------
    model : Model, path or result of `fit`
    settings : EstimatorSettings, optional

    Attributes
    ----------
    model : Model
    settings : EstimatorSettings
    capacity_ah : float
        Charge from 100 to 0 % [Ah].
    voltage_model : VoltageModel
    hypotheses : Hypotheses
        The filter, or two while a start is in doubt.
    limits : checks.Limits
        How far the pack may be from its model.
    always : Reason
        Reasons that hold throughout.
    is_refused : bool
        Whether the latest sample was refused: without a plausible current, or not later.

    Examples
    --------
    >>> from cangauge import Estimator, Sample
    >>> from cangauge.estimation.settings import EstimatorSettings
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
    _release: ClassVar[str] = __version__
    """Release of the implementation, whose estimators read each other's states."""

    def __init__(self, model: Model | Any, settings: EstimatorSettings | None = None) -> None:
        self.model: Model = as_model(model)
        self.settings = settings or EstimatorSettings()
        self.online = self.model.online(
            self.settings.capacity_ah, self.settings.gap_s, self.settings.voltage_accuracy_pct
        )
        self.capacity_ah = self.online.capacity_ah
        self.voltage_model: VoltageModel = self.online.model
        self.hypotheses = Hypotheses(self.online)
        self._clock = EstimatorClock()
        self._counter = CoulombCounter(self.capacity_ah, self.settings.gap_s)
        # Copies of the counter: as the filter was last predicted, and as the count started.
        self._predicted_to = self._counted_from = replace(self._counter)
        self._block = BlockState()
        self._memory = EstimatorMemory()
        self._power = PowerModel(self.online, self.settings.limits)
        self.limits = checks.Limits.of(self.online)
        of_model, of_input = self.model.temperature_source, self.settings.temperature_source
        is_same = "unknown" in {of_model, of_input} or of_model == of_input
        self.always = Reason.NONE if is_same else Reason.TEMPERATURE_SOURCE_MISMATCH
        self.is_refused = False
        self._latest = Estimate.unknown(Reason.NO_INITIAL_SOC)
        if self.settings.initial_soc_pct is not None:
            soc_pct = self.online.initial_soc_pct(self.settings.initial_soc_pct)
            self._start(soc_pct, self.settings.initial_soc_std_pct, is_doubtful=True)

    # --- samples → estimates

    def step(self, sample: Sample) -> Estimate:
        """Process one sample and return the estimate after it; see `update`."""
        self.update(sample)
        return self.estimate

    def update(self, sample: Sample) -> None:
        """Process one sample; `estimate` is the one after it.

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
        memory, stamp_s = self._memory, sample.time_s
        sample, implausible = checks.drop_implausible(
            sample._replace(time_s=time_s), self.voltage_model.nominal_v
        )
        if memory.samples == 0:
            memory.first_s = time_s
        memory.samples += 1
        corrected = self.online.correct(sample)
        for each in corrected:
            self._process(each, implausible)
        if corrected:
            self._latest = self._evaluate(corrected[-1], implausible)
        self._latest = self._latest._replace(time_s=stamp_s, samples=memory.samples)

    @property
    def estimate(self) -> Estimate:
        """The estimate after the latest sample; SoC and voltages are NaN until they are known."""
        if not self.is_refused:
            return self._latest
        reasons = self._latest.reasons | Reason.IMPLAUSIBLE_INPUT
        return self._latest._replace(reasons=reasons, status=status_of(reasons))

    @property
    def row(self) -> int:
        """Number of the row whose voltage was compared with the model last; −1 before any."""
        return self._memory.tick

    @property
    def health(self) -> Health:
        """Capacity, resistance and current offset, with standard deviations."""
        self._refresh()
        return health_of(self.hypotheses.likelier, self._temperature_c)

    def power(self) -> Power:
        """Return the currents possible for 10 s and the energy left, after the latest sample."""
        self._refresh()
        latest = self.estimate
        if math.isnan(latest.soc_pct) or math.isnan(self._counter.time_s):
            return Power()
        return self._power.at(
            self.hypotheses.likelier, latest.soc_pct, latest.soc_std_pct, self._temperature_c
        )

    def uncounted_std_pct(self, seconds: float) -> float:
        """Return what the SoC's standard deviation lacks [%] when no sample came for a time [s]."""
        return self._counter.uncounted_std_pct(seconds)

    def pack_tick(self, sample: Sample) -> PackTick:
        """Return what is known of the pack after its latest sample, for its cells."""
        self._refresh()
        latest = self.estimate
        return PackTick(
            time_s=sample.time_s,
            soc_pct=latest.soc_pct,
            soc_std_pct=latest.soc_std_pct,
            voltage_v=sample.voltage_v,
            without_ocv_v=self.online.load_v,
            drop_v=self.online.drop_v,
            moved_pct=self._counter.moved_pct,
        )

    def current_changes(self, time_s: float, stamps_s: Sequence[float]) -> list[float]:
        """Return the current at a sample's time less that at other stamps [A]; NaN for NaN."""
        self._refresh()
        if math.isnan(self._counter.time_s):
            return [math.nan] * len(stamps_s)
        at = self.online.delay_line.current_at
        return [math.nan if math.isnan(s) else at(0.0) - at(time_s - s) for s in stamps_s]

    def _refresh(self) -> None:
        """Bring the attributes to the latest sample, where the step is computed elsewhere."""

    # --- one sample

    def _process(self, sample: Sample, implausible: Reason) -> None:
        """Count the charge of a corrected sample, and use its voltage where that is due."""
        memory, block = self._memory, self._block
        time_s, current_a, voltage_v, temperature_c = sample
        number = math.floor((time_s - memory.first_s) / self.model.noise.block_s + 1e-9)
        if number > block.number:
            self._close_block(time_s)
            block = self._block = BlockState(number)
        if implausible and math.isnan(voltage_v):
            # Behind an open contactor; the block's other rows may be of a voltage that falls.
            block.is_broken = True
        seconds = self._counter.step(time_s, self.online.counted(current_a))
        if not math.isnan(temperature_c) or self._counter.away_s:
            memory.temperature_c = temperature_c
        self.online.advance(time_s, current_a, memory.temperature_c)
        if seconds > self.settings.gap_s:
            self._note_gap(time_s)
        checks.track_rest(memory, sample, seconds, self.capacity_ah)
        tick = math.floor((time_s - memory.first_s) * self.model.rate_hz + 1e-6)
        if tick > memory.tick:
            memory.tick = tick
            self._use_row(sample)

    def _note_gap(self, time_s: float) -> None:
        """Follow a gap in the current that ends now, or an unobserved interval."""
        memory, away_s = self._memory, self._counter.away_s
        self._block.is_broken = True
        memory.row_v = math.nan
        memory.gap_until_s = time_s + self.online.delay_line.longest_s
        if away_s > 0.0:
            self._predict_to_now()
            self._be_away(away_s, self._counter.parked_std_pct)

    def _be_away(self, away_s: float, parked_pct: float) -> None:
        """Allow for a car that was charged or driven in an unobserved interval [s, %]."""
        moved_pct = moved_std_pct(away_s)
        self.hypotheses.doubt(moved_pct, away_s, parked_pct)
        self._memory.coulomb_var_pct2 += WRONG_PRIOR * moved_pct**2

    def _use_row(self, sample: Sample) -> None:
        """Compare a row's voltage with the model, add it to the open block, look for references."""
        memory, online, counter = self._memory, self.online, self._counter
        load_v = online.load_v
        self._invert(sample.voltage_v - load_v)
        if not math.isnan(sample.voltage_v):
            row = Block(
                counter.counted_s,
                counter.discharged_pct,
                sample.voltage_v,
                memory.temperature_c,
                online.drop_v,
                online.unseen_v_per_a**2 * counter.turned_a2,
                online.load,
                online.drives,
            )
            self._block.add(row)
            self._confirm_current(row, sample)
            checks.watch_sign(memory, sample, self.capacity_ah)
        memory.voltage_model_v = online.pseudo_ocv_at(self._soc()[0])[0] + load_v
        memory.residual_v = sample.voltage_v - memory.voltage_model_v
        for reference in checks.detect_references(self.settings, memory, sample):
            self._correct(*reference)

    def _invert(self, ocv_v: float) -> None:
        """Find the SoC of a row's voltage without load [V]; NaN: it has none."""
        memory, at = self._memory, self.online.pseudo_ocv_at
        guess_pct = 50.0 if math.isnan(memory.newton_pct) else memory.newton_pct
        memory.newton_pct = memory.newton_std_pct = math.nan
        memory.newton_inside = True
        if math.isnan(ocv_v):
            return
        memory.newton_pct, memory.newton_inside = soc_from_ocv(at, ocv_v, guess_pct)
        if self.settings.method == "newton":  # no other method asks for it
            memory.newton_std_pct = inverse_std_pct(
                self.online, memory.newton_pct, self._temperature_c
            )

    def _confirm_current(self, row: Block, sample: Sample) -> None:
        """Compare a current beyond the fit's with the voltage, which a false one leaves as it is.

        Only the voltage of a current nearer to the fit's contradicts it, by more than the model's
        uncertainty at that current.
        """
        low_a, high_a = self.voltage_model.range.current_a
        is_above = sample.current_a > high_a
        if not is_above and not sample.current_a < low_a:
            return
        likelier = self.hypotheses.likelier
        soc_pct, _ = likelier.soc_moments_after(*self._counter.since(self._predicted_to))
        residual = likelier.row_residual(row, soc_pct)
        if (residual if is_above else -residual) > self.limits.residual_at_most:
            self._memory.contradicted_until_s = sample.time_s + CONTRADICTED_S

    def _close_block(self, time_s: float) -> None:
        """Correct the filter by the open block, and test its innovation."""
        memory, hypotheses, block = self._memory, self.hypotheses, self._block.mean()
        if block is None:
            memory.is_unseen |= not self._block.rows
            self._predict_to_now()  # so that σ grows by what the biases make of the charge
            return
        memory.is_unseen = False
        self._predict(
            replace(self._counter, counted_s=block.counted_s, discharged_pct=block.discharged_pct)
        )
        was_rejected = hypotheses.is_rejected
        hypotheses.update(block)
        if not hypotheses.is_valid():
            self.hypotheses = Hypotheses(self.online)
            memory.contradicted_until_s = time_s + CONTRADICTED_S
        elif hypotheses.is_rejected and not was_rejected:
            memory.contradicted_until_s = time_s + CONTRADICTED_S
        memory.is_known = True
        self._test_model(time_s)
        if math.isnan(memory.coulomb_start_pct):
            self._start_count(*self._filter_soc())

    def _test_model(self, time_s: float) -> None:
        """Flag a mismatch of model and pack, and doubt the SoC if ten minutes of voltages show it.

        Under the model the normalised innovations are independent standard normal, and what is
        learned of the constants lies together within their priors.
        """
        memory, limits, likelier = self._memory, self.limits, self.hypotheses.likelier
        innovations = [*memory.innovations, float(likelier.y**2 / likelier.S)]
        memory.innovations = innovations[-limits.tested_blocks :]
        is_lasting = sum(memory.innovations) > limits.innovations_at_most
        if is_lasting or likelier.strain() > limits.strain_at_most:
            memory.mismatch_until_s = time_s + checks.MISMATCH_S
        if is_lasting:  # the model may be right and the SoC wrong: charge that was not seen
            memory.innovations = []
            self.hypotheses.doubt(WRONG_STD_PCT)

    def _predict(self, to: CoulombCounter) -> None:
        """Predict the filter to a count."""
        self.hypotheses.predict(*to.since(self._predicted_to))
        self._predicted_to = to

    def _predict_to_now(self) -> None:
        """Predict the filter to the latest sample; the open block lies in part before it."""
        self._predict(replace(self._counter))
        self._block.is_broken = True

    def _correct(self, soc_pct: float, soc_std_pct: float) -> None:
        """Fuse an external SoC reference into count and filter, weighted by the variances."""
        self._predict_to_now()
        self.hypotheses.correct(soc_pct, soc_std_pct)
        self._memory.is_known = True
        counted_pct, std_pct = self._coulomb_soc()
        if math.isnan(counted_pct):
            self._start_count(soc_pct, soc_std_pct)
            return
        gain = std_pct**2 / (std_pct**2 + soc_std_pct**2)
        counted_pct += gain * (soc_pct - counted_pct)
        self._start_count(counted_pct, math.sqrt((1.0 - gain) * std_pct**2))

    def _start(self, soc_pct: float, std_pct: float, *, is_doubtful: bool) -> None:
        """Start filter and count from a SoC and its standard deviation [%]."""
        self.hypotheses = Hypotheses(self.online, soc_pct, std_pct, is_doubtful=is_doubtful)
        self._memory.is_known = True
        self._start_count(soc_pct, std_pct)

    def _start_count(self, soc_pct: float, std_pct: float) -> None:
        self._counted_from = replace(self._counter)
        self._memory.coulomb_start_pct = soc_pct + self._counter.discharged_pct
        self._memory.coulomb_var_pct2 = std_pct**2

    # --- the state after the latest sample

    @property
    def _temperature_c(self) -> float:
        """Latest known temperature [°C]; the model's usual one where there is none."""
        known_c = self._memory.temperature_c
        return self.voltage_model.usual_c if math.isnan(known_c) else known_c

    def _soc(self) -> tuple[float, float]:
        """Return SoC and standard deviation [%] of the chosen method; NaN until known."""
        memory, method = self._memory, self.settings.method
        if method == "newton":
            return memory.newton_pct, memory.newton_std_pct
        if not memory.is_known:
            return math.nan, math.nan
        return self._coulomb_soc() if method == "coulomb" else self._filter_soc()

    def _filter_soc(self) -> tuple[float, float]:
        """Return SoC and standard deviation of the filter, counted to the latest sample [%]."""
        soc_pct, std_pct = self.hypotheses.soc_after(*self._counter.since(self._predicted_to))
        return _clip(soc_pct), std_pct

    def _coulomb_soc(self) -> tuple[float, float]:
        """Return SoC and standard deviation by counting alone [%]; NaN until it has started."""
        memory, counter = self._memory, self._counter
        seconds, _, gap_var_pct2 = counter.since(self._counted_from)
        std_pct = count_std_pct(
            memory.coulomb_var_pct2 + gap_var_pct2,
            seconds,
            counter.moved_pct - self._counted_from.moved_pct,
        )
        return _clip(memory.coulomb_start_pct - counter.discharged_pct), std_pct

    def _evaluate(self, sample: Sample, implausible: Reason) -> Estimate:
        """Return the estimate after a corrected sample."""
        memory = self._memory
        soc_pct, std_pct = self._soc()
        reasons = self._reasons(sample, implausible, soc_pct, std_pct)
        return Estimate(
            sample.time_s,
            soc_pct,
            std_pct,
            memory.newton_pct,
            self._coulomb_soc()[0],
            memory.voltage_model_v,
            memory.residual_v,
            status_of(reasons),
            reasons,
            memory.samples,
        )

    def _reasons(
        self, sample: Sample, implausible: Reason, soc_pct: float, std_pct: float
    ) -> Reason:
        """Return the reason bits of an estimate [%] after a corrected sample."""
        memory, line, time_s = self._memory, self.online.delay_line, sample.time_s
        known = self.voltage_model.range
        # In plain bits: operations on flags are slow. Comparisons with NaN are false.
        bits = int(self.always) | int(implausible)
        for is_set, reason in (
            (math.isnan(soc_pct), Reason.NO_INITIAL_SOC),
            (std_pct > self.settings.valid_std_pct, Reason.SOC_UNCERTAIN),
            (line.filled_s < line.longest_s, Reason.DELAY_LINE_FILLING),
            (time_s < memory.gap_until_s, Reason.CURRENT_GAP),
            (memory.is_unseen or math.isnan(sample.voltage_v), Reason.VOLTAGE_MISSING),
            (math.isnan(sample.temperature_c), Reason.TEMPERATURE_MISSING),
            (not memory.newton_inside, Reason.VOLTAGE_OUTSIDE_MODEL),
            (time_s < memory.contradicted_until_s, Reason.INNOVATION_LARGE),
            (time_s < memory.mismatch_until_s, Reason.MODEL_MISMATCH),
            (memory.is_sign_wrong, Reason.SIGN_SUSPECT),
            (_is_outside(soc_pct, known.soc_pct), Reason.SOC_OUTSIDE_MODEL),
            (
                _is_outside(sample.temperature_c, known.temperature_c),
                Reason.TEMPERATURE_OUTSIDE_MODEL,
            ),
            (_is_outside(sample.current_a, known.current_a), Reason.CURRENT_OUTSIDE_MODEL),
        ):
            if is_set:
                bits |= int(reason)
        return REASONS[bits]

    # --- restart, and another model

    @property
    def writer(self) -> str:
        """Name of the estimators that read each other's states: release, method and capacity."""
        implementation = f"{self.core} {self._release}"
        return f"{implementation}, {self.settings.method}, {self.capacity_ah!r} Ah"

    def snapshot(self, stamp_shift_s: float = 0.0) -> EstimatorState:
        """Return a copy of everything needed to continue as if not interrupted.

        Parameters
        ----------
        stamp_shift_s : float
            What is added to the latest stamps, and not to those after the restart [s].
        """
        latest = self.estimate
        return EstimatorState.model_construct(
            writer=self.writer,
            samples=latest.samples,
            time_s=latest.time_s,
            soc_pct=latest.soc_pct,
            soc_std_pct=latest.soc_std_pct,
            block=b64encode(self._packed(stamp_shift_s)).decode(),
        )

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Continue from a state of the same model, and return its last estimate.

        A state of the same release, method and capacity continues bit for bit. From any other one
        the SoC is kept, with a standard deviation for the age.

        Parameters
        ----------
        state : EstimatorState
        age_s : float
            Least age of the state [s] by a clock other than the samples' stamps, which overrides
            stamps that show less; NaN if no clock measured it: the age then counts as unknown.

        Returns
        -------
        Estimate

        Raises
        ------
        InputError
            If the state is damaged, or of another model; the estimator must then not be used.
        """
        if state.writer != self.writer:
            away_s = UNKNOWN_INTERRUPTION_S if math.isnan(age_s) else age_s
            self.start_from(state.soc_pct, state.soc_std_pct, away_s)
            return Estimate.unknown(Reason.INPUT_STALE)._replace(
                time_s=state.time_s, soc_pct=state.soc_pct, soc_std_pct=state.soc_std_pct
            )
        try:
            self._unpack(b64decode(state.block), age_s)
            latest = self.estimate
        except (InputError, ValueError, TypeError, LookupError) as error:
            raise InputError("damaged, or of another model", field="estimator.block") from error
        return latest

    def start_from(self, soc_pct: float, soc_std_pct: float, away_s: float) -> None:
        """Start from the SoC of an estimator that ended `away_s` ago, and its deviation [%]."""
        self._start(soc_pct, soc_std_pct, is_doubtful=False)
        if away_s > 0.0:
            self._be_away(away_s, parked_std_pct(away_s, 0.0))

    def take_over(self, before: Estimator) -> None:
        """Continue from another estimator, of another model or with other settings.

        SoC and standard deviation, the delay line, the last sample (so that counting continues),
        the ends of gaps, the learned capacity and the current's offset are carried over. What the
        filter has learned of the other model's voltage is not. An unknown SoC stays unknown. From
        an estimator of the other implementation only the SoC is.
        """
        latest = before.estimate
        if before.core != self.core:
            if not math.isnan(latest.soc_pct):
                self.start_from(latest.soc_pct, latest.soc_std_pct, 0.0)
            return
        self._follow(before)

    def _follow(self, before: Estimator) -> None:
        """Take over from another estimator of this implementation."""
        latest = before._latest
        self._clock = replace(before._clock)
        settled = {"capacity_ah": self.capacity_ah, "gap_s": self.settings.gap_s}
        self._counter = replace(before._counter, **settled)
        self._predicted_to = replace(self._counter)
        self._memory = memory = replace(before._memory, innovations=[])
        memory.mismatch_until_s = memory.coulomb_start_pct = math.nan
        memory.is_known = False
        # Without its sums: the load row of another model has another length.
        self._block = replace(before._block, is_broken=True, sums=None)
        self._latest, self.is_refused = latest, False
        self.online.take_over(before.online)
        if not math.isnan(latest.soc_pct):
            self._start(latest.soc_pct, latest.soc_std_pct, is_doubtful=False)
        elif not math.isnan(latest.soc_coulomb_pct):  # the inverse has none without a voltage
            self._start(latest.soc_coulomb_pct, UNKNOWN_STD_PCT, is_doubtful=False)
        self.hypotheses.take_over(before.hypotheses)

    def _packed(self, stamp_shift_s: float) -> bytes:
        """Return the whole state as bytes."""
        clock = replace(self._clock, shift_s=self._clock.shift_s + stamp_shift_s)
        parts = {
            "clock": asdict(clock),
            "counts": [
                asdict(self._counter),
                asdict(self._predicted_to),
                asdict(self._counted_from),
            ],
            "block": vars(self._block),
            "memory": asdict(self._memory),
            "hypotheses": self.hypotheses.state(),
            "line": self.online.delay_line.contents,
            "online": self.online.state(),
            "latest": self._latest,
        }
        return json.dumps(parts, default=np.ndarray.tolist).encode()

    def _unpack(self, packed: bytes, age_s: float) -> None:
        """Continue from the bytes of an equal estimator, of an age [s]."""
        parts = json.loads(packed)
        self._clock = EstimatorClock(**parts["clock"] | {"age_s": age_s})
        counts = (CoulombCounter(**each) for each in parts["counts"])
        self._counter, self._predicted_to, self._counted_from = counts
        self._counter.gap_s = self.settings.gap_s
        self._block = BlockState(**parts["block"])
        if self._block.sums is not None:
            *scalars, load, drives = self._block.sums
            self._block.sums = Block._make([*scalars, np.array(load), np.array(drives)])
        self._memory = EstimatorMemory(**parts["memory"])
        self.hypotheses.resume(**parts["hypotheses"])
        self.online.delay_line.fill(*parts["line"])
        self.online.restore(parts["online"])
        *numbers, status, reasons, samples = parts["latest"]
        self._latest = Estimate._make([*numbers, Status(status), Reason(reasons), samples])
        self.is_refused = False


def _is_outside(value: float, within: tuple[float, float]) -> bool:
    """Return whether a value is below or above a range; NaN is not."""
    return value < within[0] or value > within[1]


def _clip(soc_pct: float) -> float:
    """Return the SoC within 0–100 %; NaN stays NaN."""
    return min(max(soc_pct, 0.0), 100.0)
