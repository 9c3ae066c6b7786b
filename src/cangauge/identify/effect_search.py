"""Selection of effects as further columns of the same least squares, by logs left out in turn.

Every effect with every trial value of its shapes gives columns: the change of the model's voltage
with each amplitude. The sums of all columns are made once; selection then needs no row any more. In
each round the columns that fit best are compared on left-out logs, and the best is added if its
gain is significant and worthwhile.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.least_squares import (
    LOGS_AT_LEAST,
    LogSums,
    P,
    Solution,
    log_sums,
    solve,
    solve_without,
)
from cangauge.identify.rows import FitRows
from cangauge.logs.log import Log
from cangauge.model.effects.base import Effect, Load, Signals, Values
from cangauge.model.effects.library import LIBRARY, Candidate, candidates, effect_of
from cangauge.model.extended import ExtendedModel, Prediction
from cangauge.model.prior import LOW_PASS_S, Chemistry

_LOG = logging.getLogger(__name__)

AUTO = "auto"
NONE = "none"

SEARCHED: Final = (
    "resistance_soc", "resistance_asymmetry", "charge_transfer", "fast_polarization",
    "slow_diffusion", "hysteresis", "entropic_coefficient", "temperature_lag", "core_temperature",
)  # fmt: skip
"""Effects that `auto` tries: structure of a healthy pack that the equation lacks."""

NOT_IDENTIFIABLE: Final[Mapping[str, str]] = {
    "initial_soc": "it belongs to one log: give --initial-soc",
    "resistance_step": "it belongs to one log, not to a healthy pack",
    "capacity": "give --capacity-ah; the curve over SoC follows it",
    "current_gain": "resistances and capacity absorb it: give --capacity-ah",
    "voltage_offset": "the curve absorbs it",
    "voltage_gain": "the coefficients absorb it",
    "ocv_shape": "the curve's knots express it",
    "resistance_temperature": "the equation has it (b)",
}
"""Effects that a fit cannot separate from its own coefficients, and why."""

AUTO_LOGS: Final = 5
"""Logs from which on `auto` is the default: with fewer the error of the mean gain is unknown."""
EFFECTS_AT_MOST: Final = 6
COMPARED: Final = 4
"""Candidates of a round that are compared on left-out logs, the best fits first."""
T_AT_LEAST: Final = 2.0
"""Mean gain over its standard error [-]: 3 % by chance with nineteen logs, 6 % with five."""
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
    ids = [part.strip() for text in given for part in text.split(",")]
    if ids == [NONE]:
        return ()
    if ids == [AUTO]:
        return (AUTO,)
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
    return tuple(ids)


@dataclass(frozen=True)
class SearchStep:
    """One effect added, or the best one that was not.

    Parameters
    ----------
    what : {"added", "not added"}
    effect_id : str
    before_rmse_v, after_rmse_v : float
        Error of left-out logs [V].
    gain : float
        Mean of ln(mean square error without / with) of the left-out logs.
    t_value : float
        Gain over its standard error.
    """

    what: str
    effect_id: str
    before_rmse_v: float
    after_rmse_v: float
    gain: float
    t_value: float

    @property
    def is_worth(self) -> bool:
        """Whether the gain is significant and worthwhile."""
        return self.t_value >= T_AT_LEAST and self.gain >= GAIN_AT_LEAST

    def to_dict(self) -> dict[str, object]:
        """Return the step for `fit --json`."""
        return {
            "step": self.what,
            "effect": self.effect_id,
            "held_out_rmse_without_v": self.before_rmse_v,
            "held_out_rmse_with_v": self.after_rmse_v,
            "t_value": self.t_value,
            "t_needed": T_AT_LEAST,
        }


@dataclass(frozen=True, eq=False)
class Selected:
    """Effects of a fit, and how they were found.

    Parameters
    ----------
    chosen : tuple of Candidate
    steps : tuple of SearchStep
    """

    chosen: tuple[Candidate, ...]
    steps: tuple[SearchStep, ...]

    @property
    def amplitude_std(self) -> FloatArray:
        """Prior standard deviation of each amplitude: its widest bound."""
        return np.array([float(np.abs(b).max()) for c in self.chosen for b in c.bounds])

    def effects(self, solution: Solution) -> tuple[tuple[Effect, Values], ...]:
        """Return the effects with the amplitudes of a solution."""
        parts = _parts(self.chosen, solution.coefficients[P:])
        return tuple(
            (item.effect, item.values(part)) for item, part in zip(self.chosen, parts, strict=True)
        )


def _parts(chosen: Sequence[Candidate], amplitudes: FloatArray) -> list[FloatArray]:
    ends = np.cumsum([len(item.amplitudes) for item in chosen]).tolist()
    return [amplitudes[end - len(c.amplitudes) : end] for c, end in zip(chosen, ends, strict=True)]


def effect_columns(
    model: ExtendedModel, log: Log, rows: FitRows, chosen: Sequence[Candidate]
) -> FloatArray:
    """Return dU/d(amplitude) about the neutral values on the rows of a log, shape (m, e).

    Parameters
    ----------
    model : ExtendedModel
        Without effects.
    log : Log
    rows : FitRows
    chosen : sequence of Candidate
    """
    voltage, pack = model.model, model.pack
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    soc = rows.soc_pct
    first = log.first_soc()
    if first is None:
        raise ValueError("a log of a fit has a start")
    row, start_pct = first
    currents = voltage.currents(log.time_s, log.current_a, slice(None))
    load_columns = voltage.load_columns(log.temperature_c, currents)
    drop_v = load_columns[:, 1:] @ voltage.load_coefficients[1:]
    load = Load(log.time_s, log.current_a, log.temperature_c, drop_v)
    plain_v: FloatArray | None = None
    columns = []

    def predict(changed: ExtendedModel) -> Prediction:
        return changed.predict(
            signals, start_pct, rows.at, initial_row=row, currents_a=currents[rows.at]
        )

    for item in chosen:
        effect = item.effect
        for number, step in enumerate(item.steps.tolist()):
            amplitude = np.zeros(len(item.steps))
            amplitude[number] = step
            values = item.values(amplitude)
            if effect.adds_voltage:
                drive = effect.drive(load, values, voltage, pack, effect.memory(values, pack))
                if drive is None:
                    raise ValueError("an effect of the voltage has a drive")
                added = drive[rows.at] * effect.over_soc(soc, values, voltage, pack)
            else:
                if plain_v is None:
                    plain_v = predict(model).residual_v
                added = plain_v - predict(model.with_effect(effect, values)).residual_v
            columns.append(added / step)
    return np.column_stack(columns) if columns else np.empty((len(rows), 0))


def offered(effect_ids: Sequence[str], model: ExtendedModel, time_s: FloatArray) -> list[Candidate]:
    """Return the candidates of some effects, without those whose column the equation has."""
    effects = [LIBRARY[effect_id] for effect_id in effect_ids]
    return [
        item
        for item in candidates(effects, model.pack, time_s)
        if not any(
            max(tau_s / of_model, of_model / tau_s) <= TAU_RATIO
            for (_, tau_s), of_model in product(
                item.effect.rc_elements(item.values(item.steps)), LOW_PASS_S
            )
        )
    ]


class Search:
    """Forward selection.

    Parameters
    ----------
    model : ExtendedModel
        Fitted without effects.
    logs, rows : sequences of Log and FitRows
    chemistry : Chemistry
    effect_ids : sequence of str
        Ids to add in their best shape, or `AUTO`.
    """

    def __init__(
        self,
        model: ExtendedModel,
        logs: Sequence[Log],
        rows: Sequence[FitRows],
        chemistry: Chemistry,
        effect_ids: Sequence[str],
    ) -> None:
        self._is_auto = tuple(effect_ids) == (AUTO,)
        self._capacity_ah, self._chemistry = model.capacity_ah, chemistry
        ids = SEARCHED if self._is_auto else effect_ids
        self._wanted = list(ids)
        self._offered = offered(ids, model, logs[0].time_s)
        widths = [len(item.amplitudes) for item in self._offered]
        ends = np.cumsum(widths)
        self._places = [
            list(range(end - width, end)) for end, width in zip(ends.tolist(), widths, strict=True)
        ]
        self._sums: list[LogSums] = []
        for number, (log, of_log) in enumerate(zip(logs, rows, strict=True), start=1):
            _LOG.debug("columns of the effects: log %d of %d", number, len(logs))
            extra = effect_columns(model, log, of_log, self._offered)
            self._sums.append(log_sums(of_log, chemistry, extra))

    def select(self) -> Selected:
        """Return the effects; those asked for by id are all taken, in their best shapes."""
        chosen: list[int] = []
        steps: list[SearchStep] = []
        at_most = EFFECTS_AT_MOST if self._is_auto else len(self._wanted)
        if self._is_auto and len(self._sums) < LOGS_AT_LEAST:
            return Selected((), ())
        before = self._left_out(chosen)
        while len(chosen) < at_most:
            compared = self._compared(chosen, before)
            worth = [item for item in compared if item[1].is_worth] if self._is_auto else compared
            if not worth:
                steps += [step for _, step, _ in compared[:1]]
                break
            number, step, before = worth[0]
            steps.append(replace(step, what="added"))
            _LOG.info("effect %s: left-out error %.4g V", step.effect_id, step.after_rmse_v)
            chosen.append(number)
        return Selected(tuple(self._offered[number] for number in chosen), tuple(steps))

    def _solved(self, chosen: Sequence[int]) -> tuple[list[LogSums], dict[str, Any]]:
        columns = [place for number in chosen for place in self._places[number]]
        items = [self._offered[number] for number in chosen]
        std = Selected(tuple(items), ()).amplitude_std if items else None
        sums = [item.with_columns(columns) for item in self._sums]
        return sums, {
            "capacity_ah": self._capacity_ah,
            "chemistry": self._chemistry,
            "amplitude_std": std,
        }

    def _left_out(self, chosen: Sequence[int]) -> FloatArray:
        """Return the mean square error of each left-out log [V²]; of the fit for too few logs."""
        sums, options = self._solved(chosen)
        without = solve_without(sums, **options) or [solve(sums, **options)] * len(sums)
        return np.array(
            [other.square_error(item) for item, other in zip(sums, without, strict=True)]
        )

    def _compared(
        self, chosen: list[int], before: FloatArray
    ) -> list[tuple[int, SearchStep, FloatArray]]:
        """Return the best candidates, the largest gain on left-out logs first."""
        taken = {self._offered[number].effect.id for number in chosen}
        fits: list[tuple[float, int]] = []
        for number, item in enumerate(self._offered):
            if item.effect.id in taken:
                continue
            sums, options = self._solved([*chosen, number])
            solution = solve(sums, **options)
            if self._within_bounds([*chosen, number], solution):
                fits.append((solution.residual_v, number))
        found = []
        for _, number in sorted(fits)[:COMPARED]:
            after = self._left_out([*chosen, number])
            gain = np.log(before / after)
            spread = float(gain.std(ddof=1)) / gain.size**0.5 if gain.size > 1 else float("inf")
            step = SearchStep(
                "not added",
                self._offered[number].effect.id,
                float(before.mean()) ** 0.5,
                float(after.mean()) ** 0.5,
                float(gain.mean()),
                float(gain.mean()) / max(spread, 1e-12),
            )
            found.append((number, step, after))
        return sorted(found, key=lambda item: -item[1].gain)

    def _within_bounds(self, chosen: Sequence[int], solution: Solution) -> bool:
        items = [self._offered[number] for number in chosen]
        for item, part in zip(items, _parts(items, solution.coefficients[P:]), strict=True):
            low, high = item.bounds.T
            rounding = 1e-9 * (high - low)
            if np.any((part < low - rounding) | (part > high + rounding)):
                return False
        return True
