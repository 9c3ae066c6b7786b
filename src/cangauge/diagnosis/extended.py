"""The extended model: the given model with the cause, as a file that the service runs.

The size of the cause is that of the evidence. The voltage that it adds there is expressed by the
parameters of the effect's own equation (`cangauge.model.effects`), and the model with it is judged
on rows that did not size it, among those that the cause can change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge._version import __version__
from cangauge.diagnosis.columns import Columns, soc_covered
from cangauge.diagnosis.evidence import EffectEvidence, References, held_out_sizes
from cangauge.diagnosis.pack_fit import Trace
from cangauge.diagnosis.trials import additive_column, undone
from cangauge.model.effects.base import BOUND_MARGIN, Signals, Values
from cangauge.model.effects.library import LIBRARY, effect_entries, shape_key
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model

LOG_EFFECTS: Final = frozenset({"initial_soc"})
"""Effects of one log, which a model for later drives does not have."""

CHANGED_PART: Final = 0.1
"""A cause can change a row where its voltage is at least this part of its usual largest (95 %)."""

LATER_S: Final = 1e7
"""Start of a step that happens after a log [s]."""

TWO_SIDED: Final = 1.96
"""Standard deviations of a 95 % interval."""

TANGENT_STD: Final = 0.05
"""Relative uncertainty of a size by the cause's shape, which is the library's and not the pack's.
On development cases with much evidence sizes were off by 1 to 15 %."""

_SIGNAL: Final[dict[str, Callable[[float, float], dict[str, float]]]] = {
    "current_offset": lambda a, _: {"offset_a": a},
    "current_gain": lambda a, _: {"gain_pct": 100.0 * a},
    "voltage_offset": lambda a, _: {"offset_v": a},
    "voltage_gain": lambda a, _: {"gain_pct": 100.0 * a},
    "time_skew": lambda a, _: {"skew_s": a},
    "temperature_lag": lambda a, _: {"tau_s": a},
    "core_temperature": lambda a, tau_s: {"rise_k": a, "late": 0.0, "tau_s": tau_s},
    "capacity": lambda a, _: {"change_pct": 100.0 * a},
    "initial_soc": lambda a, _: {"offset_pct": -a},
    "coulombic_efficiency": lambda a, _: {"efficiency": 1.0 - a},
}
"""Effect that changes a signal → its parameters at an amplitude and a shape of the evidence."""

_SHAPES: Final[dict[str, Callable[[float, References], list[dict[str, float]]]]] = {
    "resistance_temperature": lambda b, known: [
        {"activation_k": b, "delayed": 1.0, "reference_c": known.pack.mean_c}
    ],
    "resistance_soc": lambda _, __: [
        {"width_pct": width, "delayed": 1.0} for width in (5.0, 10.0, 20.0, 40.0)
    ],
    "resistance_asymmetry": lambda _, __: [{}],
    "resistance_step": lambda _, __: [{}],
    "charge_transfer": lambda x, known: [
        {"exchange_a": x * known.pack.capacity_ah, "bend_only": 1.0, "activation_k": 0.0}
    ],
    "fast_polarization": lambda tau_s, _: [{"tau_s": min(tau_s, 9.0), "activation_k": 0.0}],
    "slow_diffusion": lambda tau_s, _: [
        {"tau_s": max(tau_s, 70.0), "activation_k": 0.0, "by_slope": 0.0}
    ],
    "hysteresis": lambda part, _: [{"travel_pct": 100.0 * part}],
    "entropic_coefficient": lambda _, __: [{}],
    "weak_cell": lambda _, __: [
        {"deficit_pct": deficit} for deficit in (4.0, 7.0, 11.0, 16.0, 23.0, 33.0, 48.0)
    ],
}
"""Effect that adds a voltage → the shapes that are tried for a shape of the evidence."""


@dataclass(frozen=True)
class Quantity:
    """Value of a parameter with its 95 % interval."""

    value: float
    unit: str
    ci: tuple[float, float] | None
    """None for a shape."""


def residual_v(model: ExtendedModel, log: Trace) -> FloatArray:
    """Return corrected measured less predicted voltage of a model at 1 Hz [V], shape (n,)."""
    rows = np.arange(len(log.current_a))
    signals = Signals(rows.astype(np.float64), log.current_a, log.voltage_v, log.temperature_c)
    return model.predict(signals, log.start_pct, rows).residual_v


class Extension:
    """The given model with one cause; `before_v` are its errors on the rows that count [V]."""

    def __init__(
        self,
        model: ExtendedModel,
        known: References,
        logs: Sequence[Columns],
        before_v: Sequence[FloatArray],
        evidence: EffectEvidence,
    ) -> None:
        self.model, self.known, self.logs, self.before_v = model, known, logs, before_v
        self.evidence, self.effect = evidence, LIBRARY[evidence.trial.effect]
        self._neutral = self.effect.neutral(model.pack)
        self._values = {} if evidence.trial.effect in _SIGNAL else self._nearest()

    @property
    def _starts_s(self) -> list[float]:
        """Start of a step of resistance in each log; beyond its end where it happens later."""
        places = self.evidence.in_logs or (0.0,) * len(self.logs)
        return [
            LATER_S if place is None else place * len(log.log.current_a)
            for place, log in zip(places, self.logs, strict=True)
        ]

    def values(self, size: float, start_s: float = 0.0) -> Values:
        """Return the effect's parameters at a size [unit of the trial], and start of a step."""
        trial = self.evidence.trial
        if trial.effect in _SIGNAL:
            return self._neutral | _SIGNAL[trial.effect](size, trial.number)
        part = size / self.evidence.size if self.evidence.size else 0.0
        names = {item.name for item in self.effect.amplitudes}
        values = {k: part * v if k in names else v for k, v in self._values.items()}
        return values | ({"start_s": start_s} if self.evidence.in_logs else {})

    @property
    def parameters(self) -> dict[str, Quantity]:
        """The effect's parameters with 95 % intervals of its amplitudes."""
        size, std = self.evidence.size, self.evidence.std
        half = TWO_SIDED * float(np.hypot(std, TANGENT_STD * size))
        start_s = next(start for start in self._starts_s if start < LATER_S)
        values, *ends = (self.values(x, start_s) for x in (size, size - half, size + half))
        found = {}
        for item in self.effect.parameters:
            low, high = sorted(end[item.name] for end in ends)
            ci = None if item.neutral is None else (low, high)
            found[item.name] = Quantity(values[item.name], item.unit, ci)
        return found

    def judge(self) -> tuple[list[FloatArray], list[BoolArray]]:
        """Return the errors of each log with the cause, and the rows judged, shape (m,) each.

        The cause is sized without the rows judged. These are the ones that it can change, at SoC
        that references visit with it undone.
        """
        sizes = held_out_sizes(self.known, self.logs, self.evidence)
        after, judged = [], []
        for k, (log, before) in enumerate(zip(self.logs, self.before_v, strict=True)):
            errors = np.empty_like(before)
            for size in np.unique(sizes[k]):
                at = sizes[k] == size
                values = self.values(float(size), self._starts_s[k])
                errors[at] = residual_v(self._with(values), log.log)[log.rows][at]
            change = np.abs(errors - before)
            usual = float(np.quantile(change, 0.95)) if change.size else 0.0
            judged.append((change >= CHANGED_PART * usual) & self._covered_after(log))
            after.append(errors)
        return after, judged

    def model_file(self, given: Model, rmse_v: float) -> Model:
        """Return the extended model with its error on held-out rows, ready to save and run."""
        extended = self.model
        if self.effect.id not in LOG_EFFECTS:
            extended = self._with(self.values(self.evidence.size))
        made = given.made.model_copy(update={"by": f"cangauge {__version__} gap"})
        judged = {"voltage_rmse_v": rmse_v, "judged_on": "logs left out by `cangauge gap`"}
        return given.model_copy(
            update={
                "name": f"{given.name}, extended",
                "effects": effect_entries(extended.effects),
                "noise": given.noise.model_copy(update=judged),
                "information": None,
                "made": made,
            }
        )

    def _covered_after(self, log: Columns) -> BoolArray:
        """Return the rows at SoC that references visit with the cause undone; all if none."""
        covered = np.ones(len(log.rows), dtype=bool)
        if self.evidence.trial.changes_signal:
            without = undone(self.known.pack, log.log, self.evidence.trial, self.evidence.size)
            after = soc_covered(self.known.pack, without, self.known.logs)[log.rows]
            covered = after if after.any() else covered
        return covered

    def _with(self, values: Values) -> ExtendedModel:
        """Return the given model with the effect, added to one of the same shape."""
        key = shape_key(self.effect, values)
        effects = tuple(item for item in self.model.effects if shape_key(*item) != key)
        total = dict(values)
        for _, known in (item for item in self.model.effects if shape_key(*item) == key):
            for item in self.effect.amplitudes:
                total[item.name] += known[item.name] - self._neutral[item.name]
        added = self.effect, self.effect.clipped(total, self.model.pack)
        return replace(self.model, effects=(*effects, added))

    def _nearest(self) -> dict[str, float]:
        """Return the parameters whose voltage is nearest to the evidence's, at its size."""
        trial = self.evidence.trial
        places = self.evidence.in_logs or (trial.shape,) * len(self.logs)
        chosen = [
            item
            for item in zip(self.logs, self.before_v, places, self._starts_s, strict=True)
            if item[3] < LATER_S
        ]
        target = self.evidence.size * np.concatenate([
            additive_column(self.known.pack, log.log, replace(trial, shape=place))[log.rows]
            for log, _, place, _ in chosen
        ])  # fmt: skip
        units = {
            item.name: 0.1 * max(map(abs, item.bounds(self.model.pack, BOUND_MARGIN)))
            for item in self.effect.amplitudes
        }
        best: tuple[float, dict[str, float]] = (np.inf, self._neutral)
        for shape in _SHAPES[trial.effect](trial.number, self.known):
            neutral = self._neutral | shape
            columns = []
            for name, unit in units.items():
                changes = []
                for log, before, _, start_s in chosen:
                    values = neutral | {name: unit}
                    if self.evidence.in_logs:
                        values["start_s"] = start_s
                    after = residual_v(self._with(values), log.log)[log.rows]
                    changes.append((before - after) / unit)
                columns.append(np.concatenate(changes))
            design = np.column_stack(columns)
            solution, *_ = np.linalg.lstsq(design, target, rcond=None)
            values = neutral | dict(zip(units, solution.tolist(), strict=True))
            values = self.effect.clipped(values, self.model.pack)
            left = float(np.sum((target - design @ [values[name] for name in units]) ** 2))
            if left < best[0]:
                best = left, values
        return best[1]
