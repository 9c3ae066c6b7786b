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
from cangauge.diagnosis.evidence import (
    Columns,
    EffectEvidence,
    References,
    held_out_sizes,
    soc_covered,
)
from cangauge.diagnosis.pack_fit import Trace
from cangauge.diagnosis.trials import additive_column, undone
from cangauge.logs.log import Log
from cangauge.model.effects.base import BOUND_MARGIN, Pack, Values
from cangauge.model.effects.library import LIBRARY, effect_entries, shape_key
from cangauge.model.model_file import Made, Model

LOG_EFFECTS: Final = frozenset({"initial_soc"})
"""Effects of one log, which a model for later drives does not have."""

CHANGED_PART: Final = 0.1
"""A cause can change a row where its voltage is at least this part of its usual largest (95 %)."""

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
        {"activation_k": b, "delayed": 1.0, "reference_c": known.pack.mean_c, "lag_s": 0.0}
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
        {"tau_s": max(tau_s, 70.0), "spread": 0.0, "activation_k": 0.0, "by_slope": 0.0}
    ],
    "hysteresis": lambda part, _: [{"travel_pct": 100.0 * part}],
    "entropic_coefficient": lambda _, __: [{"lag_s": 0.0}],
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

    def to_dict(self) -> dict[str, object]:
        """Return the object of `gap --json`."""
        ci = None if self.ci is None else list(self.ci)
        return {"value": self.value, "ci": ci, "unit": self.unit}


@dataclass(frozen=True, eq=False)
class JudgedRows:
    """Errors of one log at 1 Hz; m rows that count."""

    log: Columns
    before_v: FloatArray
    """Measured less given model, shape (m,) [V]."""
    after_v: FloatArray
    """With the cause, sized without these rows, shape (m,) [V]."""
    judged: BoolArray
    """Rows that the cause can change, shape (m,)."""


def interval(evidence: EffectEvidence) -> tuple[float, float]:
    """Return the 95 % interval of an effect's size [unit of the trial]."""
    half = TWO_SIDED * float(np.hypot(evidence.std, TANGENT_STD * evidence.size))
    return evidence.size - half, evidence.size + half


def at_1_hz(log: Trace) -> Log:
    """Return a trace as a log, for the model."""
    return Log(
        np.arange(len(log.current_a), dtype=np.float64),
        log.current_a,
        log.voltage_v,
        log.temperature_c,
    )


def residual_v(model: Model, log: Trace) -> FloatArray:
    """Return corrected measured less predicted voltage of a model at 1 Hz [V], shape (n,)."""
    return model.predict(at_1_hz(log), initial_soc_pct=log.start_pct).residual_v


class Extension:
    """The given model with one cause.

    Parameters
    ----------
    model : Model
        As given.
    known : References
    logs : sequence of Columns
        The diagnosed logs.
    evidence : EffectEvidence
        Of the cause.
    """

    def __init__(
        self, model: Model, known: References, logs: Sequence[Columns], evidence: EffectEvidence
    ) -> None:
        self.model, self.known, self.logs, self.evidence = model, known, logs, evidence
        self.effect = LIBRARY[evidence.trial.effect]
        self._values = self._at_the_size()

    def values(self, size: float, log: int = -1) -> Values | None:
        """Return the effect's parameters at a size; None in a log before a step of resistance.

        Parameters
        ----------
        size : float
            [unit of the trial].
        log : int
            Number of the diagnosed log; −1: for later drives.
        """
        trial, pack = self.evidence.trial, self._pack
        if trial.effect in _SIGNAL:
            return self.effect.clipped(
                self.effect.neutral(pack) | _SIGNAL[trial.effect](size, trial.number), pack
            )
        part = size / self.evidence.size if self.evidence.size else 0.0
        names = {item.name for item in self.effect.amplitudes}
        values = {k: part * v if k in names else v for k, v in self._values.items()}
        if self.evidence.in_logs:
            place = 0.0 if log < 0 else self.evidence.in_logs[log]
            if place is None:
                return None
            duration_s = 0.0 if log < 0 else len(self.logs[log].log.current_a)
            values["start_s"] = place * duration_s
        return self.effect.clipped(values, pack)

    @property
    def parameters(self) -> dict[str, Quantity]:
        """The effect's parameters with 95 % intervals of its amplitudes."""
        low, high = (self.values(size) or {} for size in interval(self.evidence))
        values = self.values(self.evidence.size) or {}
        step = [k for k, place in enumerate(self.evidence.in_logs) if place is not None]
        if step:
            values = {**values, **(self.values(self.evidence.size, step[0]) or {})}
        amplitudes = {item.name for item in self.effect.amplitudes}
        amplitudes |= {"skew_s"} & {item.name for item in self.effect.parameters}
        return {
            item.name: Quantity(
                values[item.name],
                item.unit,
                (min(low[item.name], high[item.name]), max(low[item.name], high[item.name]))
                if item.name in amplitudes
                else None,
            )
            for item in self.effect.parameters
        }

    def judge(self) -> list[JudgedRows]:
        """Return the errors of each log, with the cause sized without the rows judged."""
        sizes = held_out_sizes(self.known, self.logs, self.evidence)
        judged = []
        for k, (log, of_rows) in enumerate(zip(self.logs, sizes, strict=True)):
            before = residual_v(self.model, log.log)[log.rows]
            after = np.empty_like(before)
            for size in np.unique(of_rows):
                at = of_rows == size
                after[at] = self._residual_v(log.log, float(size), k)[log.rows][at]
            change = np.abs(after - before)
            usual = float(np.quantile(change, 0.95)) if change.size else 0.0
            rows = (change >= CHANGED_PART * usual) & self._covered_after(log)
            judged.append(JudgedRows(log, before, after, rows))
        return judged

    def model_file(self, rmse_v: float) -> Model:
        """Return the extended model, ready to save and run.

        Parameters
        ----------
        rmse_v : float
            Its RMS error on held-out rows [V].
        """
        values = None if self.effect.id in LOG_EFFECTS else self.values(self.evidence.size)
        made = Made(
            by=f"cangauge {__version__} gap",
            options=self.model.made.options,
            logs=self.model.made.logs,
            fingerprint=self.model.made.fingerprint,
        )
        noise = self.model.noise.model_copy(
            update={"voltage_rmse_v": rmse_v, "judged_on": "logs left out by `cangauge gap`"}
        )
        return self._with(values).model_copy(
            update={
                "name": f"{self.model.name}, extended",
                "noise": noise,
                "information": None,
                "made": made,
            }
        )

    @property
    def _pack(self) -> Pack:
        return self.model.extended_model().pack

    def _covered_after(self, log: Columns) -> BoolArray:
        """Return the rows at SoC that references visit with the cause undone; all if few."""
        trial = self.evidence.trial
        if not trial.changes_signal:
            return np.ones(len(log.rows), dtype=bool)
        without = undone(self.known.pack, log.log, trial, self.evidence.size)
        covered = soc_covered(self.known.pack, without, self.known.logs)[log.rows]
        return covered if covered.any() else np.ones(len(log.rows), dtype=bool)

    def _with(self, values: Values | None) -> Model:
        """Return the given model with the effect, added to one of the same shape."""
        if values is None:
            return self.model
        extended = self.model.extended_model()
        key, neutral = shape_key(self.effect, values), self.effect.neutral(extended.pack)
        effects = [item for item in extended.effects if shape_key(*item) != key]
        total = dict(values)
        for _, known in (item for item in extended.effects if shape_key(*item) == key):
            for item in self.effect.amplitudes:
                total[item.name] += known[item.name] - neutral[item.name]
        added = self.effect, self.effect.clipped(total, extended.pack)
        return self.model.model_copy(update={"effects": effect_entries([*effects, added])})

    def _residual_v(self, log: Trace, size: float, number: int) -> FloatArray:
        return residual_v(self._with(self.values(size, number)), log)

    def _at_the_size(self) -> dict[str, float]:
        """Return the parameters whose voltage is nearest to the evidence's, at its size."""
        trial = self.evidence.trial
        pack, effect = self._pack, self.effect
        if trial.effect in _SIGNAL:
            return effect.neutral(pack) | _SIGNAL[trial.effect](self.evidence.size, trial.number)
        logs = [
            k
            for k in range(len(self.logs))
            if not self.evidence.in_logs or self.evidence.in_logs[k] is not None
        ]
        target = np.concatenate([self._added_v(k) for k in logs])
        best: tuple[float, dict[str, float]] = (np.inf, effect.neutral(pack))
        for shape in _SHAPES[trial.effect](trial.number, self.known):
            neutral = effect.neutral(pack) | shape
            bounds = {item.name: item.bounds(pack, BOUND_MARGIN) for item in effect.amplitudes}
            units = {name: 0.1 * max(abs(low), abs(high)) for name, (low, high) in bounds.items()}
            columns = np.column_stack([
                np.concatenate([self._change_v(k, neutral | {name: unit}) for k in logs]) / unit
                for name, unit in units.items()
            ])  # fmt: skip
            solution, *_ = np.linalg.lstsq(columns, target, rcond=None)
            values = neutral | dict(zip(units, solution.tolist(), strict=True))
            values = effect.clipped(values, pack)
            amplitude = np.array([values[name] for name in units])
            left = float(np.sum((target - columns @ amplitude) ** 2))
            if left < best[0]:
                best = left, values
        return best[1]

    def _added_v(self, number: int) -> FloatArray:
        """Return the evidence's voltage on the rows that count of a log [V]."""
        log, trial = self.logs[number], self.evidence.trial
        if self.evidence.in_logs:
            trial = replace(trial, shape=self.evidence.in_logs[number])
        return self.evidence.size * additive_column(self.known.pack, log.log, trial)[log.rows]

    def _change_v(self, number: int, values: Values) -> FloatArray:
        """Return the voltage that the model's effect adds on the same rows [V]."""
        log = self.logs[number]
        if self.evidence.in_logs:
            place = self.evidence.in_logs[number] or 0.0
            values = {**values, "start_s": place * len(log.log.current_a)}
        with_effect = residual_v(self._with(values), log.log)
        return np.asarray((residual_v(self.model, log.log) - with_effect)[log.rows])
