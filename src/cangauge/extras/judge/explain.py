"""Which faults explain the logs, each set of them with its probability.

All quantities of the chain are one Gaussian model (`Linearised`). Faults are added, exchanged and
dropped one at a time while that raises the evidence of the set, at its own most probable
coefficients. At the end every set of faults that differs by one counts with its probability:
nothing is certain because it was chosen.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.judge.chain import Chain
from cangauge.extras.judge.linearised import VARIES, Fitted, Linearised, Set, Terms
from cangauge.model.gaussian import Rows

SETTLED: Final = 0.03
"""Distance from the most probable coefficients at which they are found [their σ]."""
STEPS_AT_MOST: Final = 60
"""Most linearisations of a set of faults. Logs that agree with a model take 2 to 10."""


def explain(chain: Chain, known: Mapping[str, float]) -> list[Fitted]:
    """Return the sets of faults that explain the logs, the most probable first.

    The search begins at the SoC that the voltage shows itself, with the gauge withheld.

    Raises
    ------
    InputError
        If the coefficients of the best set stay more than 1 σ from the most probable ones.
    """
    terms = Terms(chain, known)
    theta, left = _settled(terms, np.zeros(len(terms.columns)), Set(), None)
    at = Linearised(terms, theta)
    best, evidence, tried = Set(), -np.inf, set[Set]()
    weights = at.neighbourhood(best)
    while (candidate := _candidate(weights, best, tried)) is not None:
        tried.add(candidate)
        gauge = int(np.argmax(weights[candidate]))
        its_theta, its_left = _settled(terms, theta, candidate, gauge)
        its_evidence = Linearised(terms, its_theta, candidate).log_weight() - 0.5 * its_left**2
        if its_evidence > evidence:
            best, evidence, theta, left = candidate, its_evidence, its_theta, its_left
            at = Linearised(terms, theta)
            weights = at.neighbourhood(best)
    if left > 1.0:
        raise InputError(
            "the logs contradict themselves: no SoC fits voltage, charge and published SoC",
            cure="check the signals, and that all logs are of one pack",
        )
    return _fits(at, weights)


def _candidate(weights: Mapping[Set, FloatArray], best: Set, tried: set[Set]) -> Set | None:
    """Return the most probable untried set, if it is at least as probable as the best.

    Weights are rounded, so that of equally probable sets the first is taken on every machine.
    """
    total = {each: round(float(np.logaddexp.reduce(of)), 6) for each, of in weights.items()}
    better = [each for each in total if each not in tried and total[each] >= total[best]]
    return max(better, key=total.__getitem__, default=None)


def _fits(at: Linearised, weights: Mapping[Set, FloatArray]) -> list[Fitted]:
    """Return the posteriors of the sets that count, the most probable first."""
    total = np.logaddexp.reduce(list(weights.values()), axis=None)
    fits = []
    for is_free in (False, True):
        some = {chosen: each for chosen, each in weights.items() if at.is_free(chosen) == is_free}
        most = max((float(each.max()) for each in some.values()), default=0.0)
        for chosen, of_gauges in some.items():
            for gauge in np.flatnonzero(of_gauges >= most + np.log(0.003)).tolist():
                share = float(np.exp(of_gauges[gauge] - total))
                fits.append(at.fitted(sorted(chosen), gauge, share))
    return sorted(fits, key=attrgetter("share"), reverse=True)


def _settled(
    terms: Terms, theta: FloatArray, chosen: Set, gauge: int | None
) -> tuple[FloatArray, float]:
    """Return the most probable coefficients of a set of faults, and the distance left to them [σ].

    By the method of Levenberg and Marquardt, since full steps circle where the slope of the curve
    changes. With the gauge withheld all of the voltage's errors may vary.
    """
    of, varies = terms.of(chosen), 1.0 if gauge is None else VARIES

    def rows_at(coefficients: FloatArray) -> Rows:
        every = np.zeros(theta.size)
        every[of] = coefficients
        return Linearised(terms, every, chosen, varies).all_rows(gauge)

    now, damping = theta[of], 0.0
    rows = rows_at(now)
    for _ in range(STEPS_AT_MOST):
        cost = _squares(rows, now)
        left = np.sqrt(max(0.0, cost - _squares(rows, rows.posterior().mean)))
        if left <= SETTLED:
            break
        scale = np.sqrt(damping) * np.diag(np.linalg.norm(rows.table[:, :-1], axis=0))
        damped = rows + Rows(np.column_stack([scale, scale @ now]), 0.0)
        trial = damped.posterior().mean
        rows_there = rows_at(trial)
        promised, kept = cost - _squares(rows, trial), cost - _squares(rows_there, trial)
        if kept > 0.1 * promised:
            now, rows = trial, rows_there
            damping = 0.1 * damping if damping > 0.01 else 0.0
        else:
            damping = max(0.01, 10.0 * damping)
    settled = np.zeros(theta.size)
    settled[of] = now
    return settled, float(left)


def _squares(rows: Rows, coefficients: FloatArray) -> float:
    """Return the sum of the squares of what coefficients leave."""
    return float(np.sum((rows.table[:, :-1] @ coefficients - rows.table[:, -1]) ** 2))
