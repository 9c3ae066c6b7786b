"""The model about which the diagnosis is linear: columns and prior of its coefficients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.rows import Simulated
from cangauge.model.effects.base import Pack
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model
from cangauge.model.prior import CHEMISTRIES, LOW_PASS_S, PackPrior
from cangauge.model.voltage_model import (
    KNOTS_PCT,
    Arrhenius,
    HermiteCurve,
    Loads,
    hermite_basis,
    past_currents,
    resistance_factor,
)

N: Final = KNOTS_PCT.size
"""Coefficients of the curve."""

UNKNOWN_PART: Final = 0.02
"""Part of the chemistry's uncertainty that a model leaves beside its principal functions."""


@dataclass(frozen=True, eq=False)
class Linear:
    """The model about which the diagnosis is linear, and the columns of its coefficients."""

    model: ExtendedModel
    ohm: FloatArray
    """Resistances that the Arrhenius column scales [Ω], shape (M,)."""
    mean_c: float
    low_pass_s: tuple[float, ...]

    @classmethod
    def of(cls, model: Model) -> Linear:
        """Return the given model."""
        extended = model.extended_model()
        loads = extended.model.loads
        low_pass_s = loads.low_pass_s or LOW_PASS_S
        ohm = np.zeros(len(loads.delays_s) + len(low_pass_s))
        ohm[: len(loads.resistance_ohm)] = loads.resistance_ohm
        mean_c = 0.5 * sum(extended.model.range.temperature_c)
        if loads.arrhenius is not None:
            ohm, mean_c = np.array(loads.arrhenius.resistance_ohm), loads.arrhenius.mean_c
        return cls(extended, ohm, mean_c, low_pass_s)

    @property
    def pack(self) -> Pack:
        """Sizes of the pack."""
        return self.model.pack

    @property
    def p(self) -> int:
        """Number of coefficients."""
        return N + 2 + self.ohm.size

    @property
    def coefficients(self) -> FloatArray:
        """Curve at the knots [V], temperature [V/K], resistances [Ω] and Arrhenius' part."""
        loads = self.model.model.loads
        now = np.zeros(self.p)
        now[:N] = self.model.model.curve.values(KNOTS_PCT)
        now[N] = loads.kt_v_per_k
        now[N + 1 : N + 1 + len(loads.resistance_ohm)] = loads.resistance_ohm
        now[-1] = 0.0 if loads.arrhenius is None else loads.arrhenius.factor
        return now

    def columns(self, of: Simulated) -> FloatArray:
        """Return the change of voltage by each coefficient on the rows of a log, shape (m, p)."""
        true, rows = of.plain.signals, of.of.rows
        delays = self.model.model.loads.delays_s
        currents = past_currents(true.time_s, true.current_a, rows, delays, self.low_pass_s)
        celsius = true.temperature_c[rows]
        colder = resistance_factor(celsius) / resistance_factor(self.mean_c) - 1.0
        return np.column_stack(
            [
                hermite_basis(of.plain.soc_pct[rows]),
                celsius - self.model.model.loads.t_ref_c,
                currents,
                colder * (currents @ self.ohm),
            ]
        )

    def prior(
        self, model: Model, mean_v: float, mean_soc_pct: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the change of the coefficients by the chemistry's prior."""
        pack = PackPrior(CHEMISTRIES[model.chemistry], model.capacity_ah)
        known = pack.coefficients(mean_v, mean_soc_pct)
        number = self.ohm.size
        first = N + 1
        kept = [*range(first + 1), *[first + 1] * (number - 1), known.coefficients.size - 1]
        mean, covariance = known.coefficients[kept], known.covariance[np.ix_(kept, kept)].copy()
        later = slice(first + 1, first + number)
        covariance[later, later] = np.diag(np.diag(covariance[later, later]))
        return mean - self.coefficients, covariance

    def stated(self, model: Model) -> FloatArray:
        """Return the covariance of the coefficients that the model file itself states."""
        functions = model.principal_functions()
        load = functions.load
        ohms = len(self.model.model.loads.resistance_ohm)
        change = np.zeros((self.p, functions.number))
        for k in range(functions.number):
            change[:N, k] = np.interp(KNOTS_PCT, functions.soc_pct, functions.value[:, k])
        change[N : N + 1 + ohms] = load[: 1 + ohms]
        if load.shape[0] > 1 + ohms:
            change[-1] = load[1 + ohms]
        _, typical = self.prior(model, self.pack.voltage_v, 50.0)
        return np.asarray(change @ change.T + UNKNOWN_PART**2 * np.diag(np.diag(typical)))

    def moved(self, change: FloatArray) -> Linear:
        """Return the model with other coefficients."""
        voltage, loads = self.model.model, self.model.model.loads
        now = self.coefficients + change
        changed = Loads(
            t_ref_c=loads.t_ref_c,
            kt_v_per_k=float(now[N]),
            delays_s=loads.delays_s,
            low_pass_s=self.low_pass_s,
            resistance_ohm=tuple(now[N + 1 : -1].tolist()),
            arrhenius=Arrhenius(
                factor=float(now[-1]),
                resistance_ohm=tuple(self.ohm.tolist()),
                mean_c=self.mean_c,
            ),
        )
        curve = HermiteCurve.rising(KNOTS_PCT, now[:N])
        corrected = replace(voltage, curve=curve, loads=changed)
        return replace(self, model=replace(self.model, model=corrected))
