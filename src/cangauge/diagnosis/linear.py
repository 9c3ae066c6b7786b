"""The voltage model's own coefficients: what the references correct about it.

They are the curve at `KNOTS_PCT` [V], kt [V/K], the resistances [Ω] and Arrhenius' part b [-].
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.rows import Simulated
from cangauge.model.curve import KNOTS_PCT, HermiteCurve, hermite_basis
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model
from cangauge.model.prior import CHEMISTRIES, LOW_PASS_S, PackPrior
from cangauge.model.voltage_model import Arrhenius

N: Final = KNOTS_PCT.size
"""Coefficients of the curve."""


def with_all_loads(model: ExtendedModel) -> ExtendedModel:
    """Return the same model with low-passed currents and Arrhenius' part, where it has none."""
    loads = model.model.loads
    low_pass_s = loads.low_pass_s or LOW_PASS_S
    ohm = np.zeros(len(loads.delays_s) + len(low_pass_s))
    ohm[: len(loads.resistance_ohm)] = loads.resistance_ohm
    same = tuple(ohm.tolist())
    mean_c = 0.5 * sum(model.model.range.temperature_c)
    loads = loads.model_copy(
        update={
            "low_pass_s": low_pass_s,
            "resistance_ohm": same,
            "arrhenius": loads.arrhenius
            or Arrhenius(factor=0.0, resistance_ohm=same, mean_c=mean_c),
        }
    )
    return replace(model, model=replace(model.model, loads=loads))


def coefficients(model: ExtendedModel) -> FloatArray:
    """Return the coefficients of a model with all loads, shape (p,)."""
    return np.asarray(np.r_[model.model.curve.values(KNOTS_PCT), model.model.load_coefficients])


def coefficient_columns(of: Simulated) -> FloatArray:
    """Return the change of voltage by each coefficient on the rows of a log, shape (m, p)."""
    rows, plain = of.trace.rows, of.plain
    load = of.model.model.load_columns(plain.signals.temperature_c[rows], plain.currents_a)
    return np.column_stack([hermite_basis(plain.soc_pct[rows]), load])


def corrected(model: ExtendedModel, change: FloatArray) -> ExtendedModel:
    """Return a model with all loads whose coefficients are changed."""
    now, loads = coefficients(model) + change, model.model.loads
    update = {
        "kt_v_per_k": float(now[N]),
        "resistance_ohm": tuple(now[N + 1 : -1].tolist()),
        "arrhenius": loads.arrhenius
        and loads.arrhenius.model_copy(update={"factor": float(now[-1])}),
    }
    curve = HermiteCurve.rising(KNOTS_PCT, now[:N])
    return replace(
        model, model=replace(model.model, curve=curve, loads=loads.model_copy(update=update))
    )


def prior(
    about: ExtendedModel, given: Model, mean_v: float, mean_soc_pct: float
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a change of the coefficients, by the chemistry's prior."""
    known = PackPrior(CHEMISTRIES[given.chemistry], given.capacity_ah).coefficients(
        mean_v, mean_soc_pct
    )
    now = coefficients(about)
    # All resistances but the first, whatever their delay, have the prior of the second.
    kept = [*range(N + 2), *[N + 2] * (now.size - N - 3), known.coefficients.size - 1]
    covariance = known.covariance[np.ix_(kept, kept)]
    covariance[N:, N:] = np.diag(np.diag(covariance[N:, N:]))
    return known.coefficients[kept] - now, covariance


def stated_covariance(about: ExtendedModel, given: Model) -> FloatArray:
    """Return the covariance of the coefficients that a model file states.

    Its principal functions leave a part of it: 2 % of the chemistry's uncertainty are added.
    """
    functions, voltage = given.functions, given.voltage_model()
    loads, of_load = voltage.loads, functions.load_parts(voltage.load_coefficients.size)
    ohms = 1 + len(loads.resistance_ohm)
    _, typical = prior(about, given, about.pack.voltage_v, 50.0)
    change = np.zeros((len(typical), functions.number))
    for k in range(functions.number):
        change[:N, k] = np.interp(KNOTS_PCT, functions.soc_pct, functions.value[:, k])
    change[N : N + ohms] = of_load[:ohms]
    if loads.arrhenius is not None:
        change[-1] = of_load[ohms]
    return np.asarray(change @ change.T + 0.02**2 * np.diag(np.diag(typical)))
