"""Selection of effects as further columns of the same least squares, by logs left out in turn.

Every effect with every trial value of its shapes gives columns: the change of the model's voltage
with each amplitude. The sums of all columns are made once; selection then needs no row any more. In
each round the columns that fit best are compared on left-out logs, and the best is added if its
gain is significant and worthwhile.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.least_squares import (
    LOGS_AT_LEAST,
    LogSums,
    N,
    P,
    Solution,
    features,
    load_features,
    log_sums,
    solve,
    solve_without,
)
from cangauge.identify.rows import FitRows, dequantize
from cangauge.model.coulomb_counting import start_of
from cangauge.model.effects.base import Effect, Inputs, Signals, Values
from cangauge.model.effects.library import LIBRARY, EffectCandidate, candidates, effect_of
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.prior import LOW_PASS_S, PackPrior

_LOG = logging.getLogger(__name__)

AUTO = "auto"
NONE = "none"

SEARCHED: Final = (
    "resistance_soc",
    "resistance_asymmetry",
    "charge_transfer",
    "fast_polarization",
    "slow_diffusion",
    "hysteresis",
    "entropic_coefficient",
    "temperature_lag",
    "core_temperature",
)
"""Effects that `auto` tries: structure of a healthy pack that the equation lacks."""

NOT_IDENTIFIABLE: Final[Mapping[str, str]] = {
    "initial_soc": "it belongs to one log: give --initial-soc",
    "resistance_step": "it belongs to one log, not to a healthy pack",
    "capacity": "give --capacity-ah; the curve over SoC follows it",
    "current_gain": "resistances and capacity absorb it: give --capacity-ah",
    "voltage_offset": "the curve absorbs it",
    "voltage_gain": "the coefficients absorb it",
    "resistance_temperature": "the equation has it (b)",
    "resistance_growth": "the resistances absorb it",
    "temperature_offset": "temperature coefficient and resistances absorb it",
}
"""Effects that a fit cannot separate from its own coefficients, and why."""

EFFECTS_AT_MOST: Final = 6
COMPARED: Final = 4
"""Candidates of a round that are compared on left-out logs, the best fits first."""
SIGNIFICANCE: Final = 0.05
"""Probability that any of the effects offered looks significant by chance [-]: the usual level.
Divided by their number (Bonferroni), it asks for a mean gain of 4.5 standard errors with five logs
and 2.8 with nineteen, by Student's t."""
GAIN_AT_LEAST: Final = 0.03
"""Least mean relative decrease of a left-out log's mean square error [-]: an effect costs
understanding."""
TAU_RATIO: Final = 2.0
"""Ratio of time constants within which an effect repeats a low-passed current of the equation."""


def parse_effect_ids(given: Sequence[str]) -> tuple[str, ...]:
    """Return effect ids from texts that may hold several, separated by commas; () for "none".

    Raises
    ------
    InputError
        If an id is unknown, not identifiable by a fit, repeated, or combined with `auto`.
    """
    ids = tuple(part.strip() for text in given for part in text.split(","))
    if ids in {(AUTO,), (NONE,)}:
        return () if ids == (NONE,) else ids
    for effect_id in ids:
        if effect_id in {AUTO, NONE} or ids.count(effect_id) > 1:
            raise InputError(
                "given together with others" if effect_id in {AUTO, NONE} else "given twice",
                field="--effects",
                value=", ".join(ids),
                cure="give auto alone, none alone, or each id once",
            )
        effect_of(effect_id, "--effects")
        if effect_id in NOT_IDENTIFIABLE:
            raise InputError(
                "not identifiable by a fit",
                field="--effects",
                value=effect_id,
                cure=NOT_IDENTIFIABLE[effect_id],
            )
    return ids


@dataclass(frozen=True)
class SearchStep:
    """One effect added, or the best one that was not: an entry of `fit --json`.

    Parameters
    ----------
    step : {"added", "not added"}
    effect : str
        Its id.
    held_out_rmse_without_v, held_out_rmse_with_v : float
        Error of left-out logs [V].
    gain : float
        Mean of ln(mean square error without / with) of the left-out logs.
    t_value, t_needed : float
        Gain over its standard error, and what is significant for this many logs and effects.
    """

    step: str
    effect: str
    held_out_rmse_without_v: float
    held_out_rmse_with_v: float
    gain: float
    t_value: float
    t_needed: float

    @property
    def is_worth(self) -> bool:
        """Whether the gain is significant and worthwhile."""
        return self.t_value >= self.t_needed and self.gain >= GAIN_AT_LEAST


@dataclass(frozen=True, eq=False)
class Selected:
    """Effects of a fit, and how they were found.

    Parameters
    ----------
    chosen : tuple of EffectCandidate
    steps : tuple of SearchStep
    """

    chosen: tuple[EffectCandidate, ...]
    steps: tuple[SearchStep, ...] = ()

    @property
    def bounds(self) -> FloatArray:
        """Bounds of all amplitudes, shape (e, 2)."""
        return np.concatenate([np.empty((0, 2)), *(item.bounds for item in self.chosen)])

    @property
    def amplitude_std(self) -> FloatArray:
        """Prior standard deviation of each amplitude: its widest bound."""
        return np.asarray(np.abs(self.bounds).max(axis=1))

    def with_parts(
        self, of_amplitudes: NDArray[Any]
    ) -> Iterator[tuple[EffectCandidate, NDArray[Any]]]:
        """Yield each effect with its part of an array over all amplitudes, shape (e,)."""
        end = 0
        for item in self.chosen:
            first, end = end, end + len(item.amplitudes)
            yield item, of_amplitudes[first:end]

    def clipped(self, solution: Solution) -> Solution:
        """Return the solution with the amplitudes within their physical bounds."""
        amplitudes = np.clip(solution.coefficients[P:], *self.bounds.T)
        return replace(solution, coefficients=np.r_[solution.coefficients[:P], amplitudes])

    def at_bound(self, solution: Solution) -> list[EffectCandidate]:
        """Return the effects with an amplitude at or beyond a bound other than neutral."""
        (low, high), amplitudes = self.bounds.T, solution.coefficients[P:]
        reached = ((amplitudes <= low) & (low < 0.0)) | (amplitudes < low) | (amplitudes >= high)
        return [item for item, part in self.with_parts(reached) if part.any()]

    def effects(self, solution: Solution) -> tuple[tuple[Effect, Values], ...]:
        """Return the effects with the amplitudes of a solution."""
        parts = self.with_parts(solution.coefficients[P:])
        return tuple((item.effect, item.values(part)) for item, part in parts)


class Linearized(NamedTuple):
    """A model with effects on the rows of one log, to first order."""

    rows: FitRows
    """With the SoC that the effects give."""
    table: FloatArray
    """dU/d of knots, kt, resistances, their Arrhenius parts and amplitudes, shape (m, BASE + e)."""
    residual_v: FloatArray
    """Shape (m,)."""


def linearize(
    model: ExtendedModel, rows: FitRows, selected: Selected, amplitudes: FloatArray
) -> Linearized:
    """Return the model's prediction of a log and its derivatives on the rows of the fit.

    Parameters
    ----------
    model : ExtendedModel
        Without effects, or with the selected ones.
    rows : FitRows
    selected : Selected
    amplitudes : array of shape (e,)
        Of the model's effects, relative to neutral; 0 without.
    """
    voltage, log = model.model, rows.log
    row, start_pct = start_of(log)
    signals = Signals.of(dequantize(log))
    currents_a = voltage.currents(log.time_s, log.current_a, slice(None))

    def predict(effects: tuple[tuple[Effect, Values], ...]) -> Prediction:
        changed = replace(model, effects=effects)
        return changed.predict(signals, start_pct, rows.at, initial_row=row, currents_a=currents_a)

    # Added voltages are linear in their amplitudes, so their columns give them too.
    correcting = tuple(item for item in model.effects if not item[0].adds_voltage)
    plain = predict(correcting)
    true, soc_pct = plain.signals, plain.soc_pct[rows.at]
    load_columns = voltage.load_columns(true.temperature_c, currents_a)
    drop_v = load_columns[:, 1:] @ voltage.load_coefficients[1:]
    inputs = Inputs(true.time_s, true.current_a, true.temperature_c, drop_v)

    def added_v(effect: Effect, values: Values, drop_v: FloatArray = drop_v) -> FloatArray:
        return effect.added_v(inputs._replace(drop_v=drop_v), rows.at, soc_pct, values, model)

    features_at = features(soc_pct, true.temperature_c[rows.at], plain.currents_a)
    columns, residual_v = [features_at], plain.residual_v
    for item, amounts in selected.with_parts(amplitudes):
        effect = item.effect
        if effect.scales_drop and amounts.any():
            # Linear in the drop: the response to each current is that to a drop of 1 Ω.
            values = item.values(amounts)
            nothing_v = added_v(effect, values, np.zeros_like(drop_v))
            drops_v = load_features(true.temperature_c, currents_a)[:, 1:].T
            for place, drop_of_1_ohm_v in enumerate(drops_v, start=N + 1):
                features_at[:, place] += added_v(effect, values, drop_of_1_ohm_v) - nothing_v
        others = tuple(other for other in correcting if other[0] is not effect)
        for amount, step, one in zip(amounts, item.steps, np.diag(item.steps), strict=True):
            if effect.adds_voltage:
                change_v = added_v(effect, item.values(one))
                residual_v = residual_v - change_v * (amount / step)
            else:
                changed = predict((*others, (effect, item.values(amounts + one))))
                change_v = plain.residual_v - changed.residual_v
            columns.append(change_v / step)
    return Linearized(replace(rows, soc_pct=soc_pct), np.column_stack(columns), residual_v)


def offered(effect_ids: Sequence[str], model: ExtendedModel) -> list[EffectCandidate]:
    """Return the candidates of some effects, without those whose column the equation has."""
    effects = [LIBRARY[effect_id] for effect_id in effect_ids]
    return [item for item in candidates(effects, model.pack) if not _repeats_a_low_pass(item)]


def _repeats_a_low_pass(item: EffectCandidate) -> bool:
    return item.effect.is_rc and any(
        max(item.shape["tau_s"] / tau_s, tau_s / item.shape["tau_s"]) <= TAU_RATIO
        for tau_s in LOW_PASS_S
    )


class Search:
    """Forward selection.

    Parameters
    ----------
    model : ExtendedModel
        Fitted without effects.
    rows : sequence of FitRows
        Of each log.
    pack : PackPrior
    effect_ids : sequence of str
        Ids to add in their best shape, or `AUTO`.
    """

    def __init__(
        self,
        model: ExtendedModel,
        rows: Sequence[FitRows],
        pack: PackPrior,
        effect_ids: Sequence[str],
    ) -> None:
        self._is_auto = tuple(effect_ids) == (AUTO,)
        self._at_most = EFFECTS_AT_MOST if self._is_auto else len(effect_ids)
        self._pack = pack
        every = Selected(tuple(offered(SEARCHED if self._is_auto else effect_ids, model)))
        chance = SIGNIFICANCE / max(len({item.effect.id for item in every.chosen}), 1)
        self._t_needed = float(stats.t.isf(chance, max(len(rows) - 1, 1)))
        self._columns = dict(every.with_parts(np.arange(len(every.bounds))))
        self.refused: list[EffectCandidate] = []
        """Candidates that are not offered any more."""
        self._sums: list[LogSums] = []
        for of_log in rows:
            linear = linearize(model, of_log, every, np.zeros(len(every.bounds)))
            self._sums.append(log_sums(of_log, pack.chemistry, linear.table))

    def select(self) -> Selected:
        """Return the effects; those asked for by id are all taken, in their best shapes."""
        chosen: list[EffectCandidate] = []
        steps: list[SearchStep] = []
        if self._is_auto and len(self._sums) < LOGS_AT_LEAST:
            return Selected(())
        before = self._left_out(chosen)
        while len(chosen) < self._at_most:
            compared = self._compared(chosen, before)
            worth = [each for each in compared if each[1].is_worth or not self._is_auto]
            if not worth:
                steps += [step for _, step, _ in compared[:1]]
                break
            item, step, before = worth[0]
            steps.append(replace(step, step="added"))
            _LOG.info("effect %s: left-out error %.4g V", step.effect, step.held_out_rmse_with_v)
            chosen.append(item)
        return Selected(tuple(chosen), tuple(steps))

    def _of(self, chosen: Sequence[EffectCandidate]) -> tuple[list[LogSums], PackPrior, FloatArray]:
        """Return the arguments of `solve` for some candidates."""
        columns = [column for item in chosen for column in self._columns[item].tolist()]
        sums = [of_log.with_columns(columns) for of_log in self._sums]
        return sums, self._pack, Selected(tuple(chosen)).amplitude_std

    def _left_out(self, chosen: Sequence[EffectCandidate]) -> FloatArray:
        """Return the mean square error of each left-out log [V²]; of the fit for too few logs."""
        sums, pack, std = self._of(chosen)
        without = solve_without(sums, pack, std) or [solve(sums, pack, std)] * len(sums)
        return np.array(
            [other.square_error(of_log) for of_log, other in zip(sums, without, strict=True)]
        )

    def _compared(
        self, chosen: Sequence[EffectCandidate], before: FloatArray
    ) -> list[tuple[EffectCandidate, SearchStep, FloatArray]]:
        """Return the best candidates, the largest gain on left-out logs first."""
        taken = {item.effect.id for item in chosen}
        fits = []
        for item in self._columns:
            if item.effect.id not in taken and item not in self.refused:
                solution = solve(*self._of([*chosen, item]))
                if not Selected((*chosen, item)).at_bound(solution):
                    fits.append((solution.residual_v, item))
        found = []
        for _, item in sorted(fits, key=itemgetter(0))[:COMPARED]:
            after = self._left_out([*chosen, item])
            gain = np.log(before / after)
            spread = float(gain.std(ddof=1)) / gain.size**0.5 if gain.size > 1 else float("inf")
            step = SearchStep(
                "not added",
                item.effect.id,
                float(before.mean()) ** 0.5,
                float(after.mean()) ** 0.5,
                float(gain.mean()),
                float(gain.mean()) / max(spread, 1e-12),
                self._t_needed,
            )
            found.append((step.gain, item, step, after))
        found.sort(key=itemgetter(0), reverse=True)
        return [each[1:] for each in found]
