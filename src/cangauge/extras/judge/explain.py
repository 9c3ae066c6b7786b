"""Which faults explain the logs, each set of them with its probability.

All quantities of the chain are one linear Gaussian model (`model.gaussian`). Faults are added,
exchanged and dropped one at a time while that raises the evidence, and at the end every set of
faults that differs by one counts with its probability: nothing is certain because it was chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from operator import attrgetter
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.special import logsumexp

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.extras.judge.chain import Chain
from cangauge.extras.judge.faults import Column, Priors, faults, healthy
from cangauge.model.gaussian import Rows

JOINT_PCT: Final = 0.1
"""NoiseSize of the SoC where one stretch continues another [%]."""
FULL_STD_PCT: Final = 1.5
"""Standard deviation of the SoC at the end of a full charge [%]: cut-off current and balancing."""
VARIES: Final = 0.5
"""Part of the model's voltage errors that varies within a stretch [-]: they hold what differs from
log to log too. Of 0.5, 1, 2 and 4 the evidence of every development chain chose the least."""
MOST_MOVES: Final = 10
"""Sets of faults that are tried one after the other."""
BEYOND: Final = 3.0
"""Largest size of a fault that can explain an error [prior standard deviations]."""
ITERATIONS: Final = 8
"""Linearisations at most, …"""
DAMPING: Final = 0.6
"""… each this part of the way, since the slope of a curve jumps between its features, …"""
SETTLED_PCT: Final = 0.1
"""… until no SoC moves by more [%]."""
LEAST_SHARE: Final = 0.003
"""Least probability of a set of faults that counts."""


class GaugeNoise(NamedTuple):
    """Errors of a healthy gauge relative to counted charge, as standard deviations."""

    white_pct: float
    """Of each block alone [%]."""
    walk_pct: float
    """Random walk in an hour [%]."""
    drift_pct: float
    """Steady drift over an hour [%]."""
    scale_pct: float
    """Error of the charge that a stretch counts [%]."""
    error_pct: float
    """Difference of its error between stretches [% SoC]."""


GAUGES: Final = (
    GaugeNoise(0.05, 0.05, 0.1, 0.5, 0.3),
    GaugeNoise(0.1, 0.15, 0.3, 2.0, 0.6),
    GaugeNoise(0.5, 0.5, 1.0, 10.0, 1.5),
    GaugeNoise(3.0, 1.5, 3.0, 30.0, 3.0),
)
"""From a pure counter (a BMW i3's) to a gauge that follows the voltage, which counts nothing."""


USUAL: Final = 1
"""Place of a usual gauge among them."""


class Fitted(NamedTuple):
    """Posterior of a set of faults."""

    share: float
    """Probability among all sets and sizes of the gauge's noise."""
    is_counter: bool
    """Whether the gauge counts: what is left of its SoC is below the largest noise."""
    faults: tuple[Column, ...]
    size: FloatArray
    """Of each fault, and its σ."""
    std: FloatArray
    pack_pct: FloatArray
    """SoC of each block beside the model, …"""
    soc_pct: FloatArray
    """… and on the gauge's scale, with its σ [%]."""
    std_pct: FloatArray
    functions: FloatArray
    """Principal functions of the curve after the logs, and their covariance."""
    covariance: FloatArray
    is_free: bool
    """Whether the level of the last piece is free: then the gauge does not confirm itself."""


class Linearised:
    """The model of a chain whose voltage is linearised at a SoC.

    Parameters
    ----------
    chain : Chain
    priors : Priors
    soc_pct : array of shape (blocks,)
    only : sequence of int, optional
        Numbers of the faults that it has; by default all.
    varies : float
        Part of the voltage's errors that varies within a stretch.
    """

    def __init__(
        self,
        chain: Chain,
        priors: Priors,
        soc_pct: FloatArray,
        only: Sequence[int] | None = None,
        varies: float = VARIES,
    ) -> None:
        self.chain, self.soc_pct, self._varies = chain, soc_pct, varies
        self.healthy, every = healthy(chain, priors, soc_pct), faults(chain, soc_pct)
        self.faults = every if only is None else [every[k] for k in only]
        columns = [*self.healthy, *self.faults]
        self._S, self._Y, self._V = (
            _sparse([getattr(each, of) for each in columns], soc_pct.size)
            for of in ("soc", "shown", "volts")
        )
        self._std = np.array([each.std for each in columns])
        self._log_prior = np.array([fault.log_prior for fault in self.faults])
        starts = [each.blocks.start for each in chain.stretches]
        self._start_pct = (soc_pct + chain.blocks.drawn_pct)[starts][chain.blocks.stretch]
        self._counted_pct = self._start_pct - chain.blocks.drawn_pct

    @cached_property
    def all_rows(self) -> list[Rows]:
        """Rows at each of `GAUGES`."""
        return [self.rows(noise) for noise in GAUGES]

    def rows(self, noise: GaugeNoise) -> Rows:
        """Return the rows at one size of the gauge's noise."""
        return self.pack_rows + self._gauge_rows(noise)

    @cached_property
    def pack_rows(self) -> Rows:
        """Rows of the pack: those of the prior, of all voltages, full charges and joints.

        The level of the voltage of each stretch is integrated out.
        """
        chain, counted_pct = self.chain, self._counted_pct
        slope = chain.slope(self.soc_pct)
        error_v = chain.blocks.voltage_v - chain.voltage_v(self.soc_pct)
        error_v += slope * (self.soc_pct - counted_pct)
        total = Rows.prior(self._std[: len(self.healthy)], others=len(self.faults))
        for at, root in chain.voltage_noise(self._varies):
            X = slope[at, None] * self._S[at].toarray() + self._V[at].toarray()
            with_level = np.column_stack([chain.level_v[at], X])
            rows = Rows.correlated(with_level, error_v[at], root)
            total += (rows + Rows.prior(np.ones(1), others=self._std.size)).eliminated(1)
        full = np.flatnonzero(chain.is_full)
        total += Rows.of(self._S[full].toarray(), 100.0 - counted_pct[full], FULL_STD_PCT)
        later = [k for k, each in enumerate(chain.stretches) if each.continues]
        first = np.array([chain.stretches[k].blocks.start for k in later], dtype=np.intp)
        ends = np.array([chain.stretches[k].samples.start - 1 for k in later], dtype=np.intp)
        drawn_pct = chain.blocks.drawn_pct
        between_pct = drawn_pct[first] + chain.samples.drawn_pct[ends] - drawn_pct[first - 1]
        apart_pct = counted_pct[first - 1] - counted_pct[first] - between_pct
        joints = (self._S[first] - self._S[first - 1]).toarray()
        return total + Rows.of(joints, apart_pct, JOINT_PCT)

    def _gauge_rows(self, noise: GaugeNoise) -> Rows:
        """Return the rows of all counts, what is of each stretch alone integrated out."""
        chain = self.chain
        total = Rows(np.zeros((0, self._std.size + 1)), 0.0)
        for stretch in chain.stretches:
            at = np.flatnonzero(np.isfinite(chain.count_pct[stretch.blocks]))
            at += stretch.blocks.start
            hours, drawn = chain.blocks.hours[at], chain.blocks.drawn_pct[at] / 100.0
            last = stretch.samples.stop - 1
            step_pct = float(chain.published.step_pct[last])
            white = noise.white_pct**2 + step_pct**2 / 12.0
            walk = noise.walk_pct**2 * np.minimum(hours[:, None], hours) + np.eye(at.size) * white
            X = np.column_stack([np.ones(at.size), hours, drawn, self._Y[at].toarray()])
            y = chain.count_pct[at] - self._start_pct[at]
            root = np.asarray(np.linalg.cholesky(walk), dtype=np.float64)
            rows = Rows.correlated(X, y, root)
            drift = noise.drift_pct / np.sqrt(max(float(chain.samples.hours[last]), 1.0))
            own = np.array([noise.error_pct, drift, noise.scale_pct])
            total += (rows + Rows.prior(own, others=self._std.size)).eliminated(own.size)
        return total

    def log_weights(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return ln of the weight of a set of faults, and with each other fault added to it.

        Returns
        -------
        base : array of shape (gauges,)
        more : array of shape (gauges, faults)
            −∞ for other shapes of those in the set.
        """
        taken = {self.faults[k].place for k in chosen}
        others = np.array(
            [k for k, fault in enumerate(self.faults) if fault.place not in taken], dtype=np.intp
        )
        std = self._fault_std(others)
        base, more = [], np.full((len(self.all_rows), len(self.faults)), -np.inf)
        for k, rows in enumerate(self.all_rows):
            of_set = self._chosen(rows, chosen, others)
            added = of_set.added(len(self.healthy) + len(chosen), std)
            base.append(added.log_evidence + float(self._log_prior[list(chosen)].sum()))
            size = added.mean / std
            is_positive = np.array([self.faults[k].is_positive for k in others], dtype=bool)
            is_sound = (np.abs(size) <= BEYOND) & ((size > 0.0) | ~is_positive)
            gain = np.where(is_sound, added.log_factor, -np.inf)
            more[k, others] = base[k] + gain + self._log_prior[others]
        return np.array(base), more

    def _fault_std(self, numbers: Sequence[int] | IntArray) -> FloatArray:
        return self._std[len(self.healthy) + np.array(numbers, dtype=np.intp)]

    def _chosen(self, rows: Rows, chosen: Sequence[int], others: IntArray) -> Rows:
        """Return the rows with a set of faults and its priors, then the columns of others."""
        n = len(self.healthy)
        rows = rows.with_columns([*range(n), *(n + k for k in chosen), *(n + others)])
        prior = np.eye(len(chosen), rows.table.shape[1] - 1, n)
        return rows + Rows.of(prior, np.zeros(len(chosen)), self._fault_std(chosen))

    def fitted(
        self, chosen: Sequence[int], rows: Rows, share: float = 1.0, *, is_counter: bool = True
    ) -> Fitted:
        """Return the posterior of a set of faults of a probability."""
        chain, n, zero = self.chain, len(self.healthy), len(self.chain.stretches)
        posterior = self._chosen(rows, chosen, np.zeros(0, dtype=np.intp)).posterior()
        X = self._S[:, [*range(n), *(n + k for k in chosen)]]
        pack_pct = self._counted_pct + X @ posterior.mean
        root = posterior.root
        std_pct = np.concatenate(
            [np.linalg.norm(X[each.blocks] @ root + root[zero], axis=1) for each in chain.stretches]
        )
        units = np.array([self.faults[k].per_unit for k in chosen])
        functions = slice(zero + 1, zero + 1 + chain.functions.number)
        return Fitted(
            share=share,
            is_counter=is_counter,
            faults=tuple(self.faults[k] for k in chosen),
            size=posterior.mean[n:] * units,
            std=np.sqrt(np.diag(posterior.covariance)[n:]) * units,
            pack_pct=pack_pct,
            soc_pct=pack_pct + posterior.mean[zero],
            std_pct=std_pct,
            functions=posterior.mean[functions],
            covariance=posterior.covariance[functions, functions],
            is_free=self.is_free(chosen),
        )

    def is_free(self, chosen: Sequence[int]) -> bool:
        """Return whether a set has a level for the last count of the gauge."""
        counts = np.flatnonzero(np.isfinite(self.chain.count_pct))
        levels = [self.faults[k].shown for k in chosen if self.faults[k].place[0] == "level"]
        return not counts.size or any(np.asarray(shown)[counts[-1]] for shown in levels)


def _sparse(columns: Sequence[FloatArray | BoolArray | float], size: int) -> csr_array:
    """Return columns as a matrix: most are 0 but in a few stretches."""
    every = [np.broadcast_to(each, size) for each in columns]
    rows = [np.flatnonzero(each) for each in every]
    values = np.concatenate([each[at] for each, at in zip(every, rows, strict=True)])
    edges = np.cumsum([0, *(at.size for at in rows)])
    shape = (size, len(columns))
    return csc_array((values, np.concatenate(rows), edges), shape=shape, dtype=np.float64).tocsr()


class _Weighed(NamedTuple):
    """A set of faults at a size of the gauge's noise, with ln of its weight."""

    log_weight: float
    faults: tuple[int, ...]
    gauge: int
    at: Linearised


def explain(chain: Chain, priors: Priors) -> list[Fitted]:
    """Return the sets of faults that explain the logs, the most probable first.

    The voltage is linearised at the SoC that it shows itself, with the gauge withheld, and at the
    published one, so that its curvature accuses no gauge.
    """
    withheld = _settled(chain, priors, chain.fitting_pct, [], None, varies=1.0)
    published = chain.published_or(chain.fitting_pct)
    right = _settled(chain, priors, published, [], USUAL, varies=1.0)
    found = [*_explained(chain, priors, withheld), *_explained(chain, priors, right)]
    log_total = logsumexp([each.log_weight for each in found])
    fits = []
    for is_free in (False, True):
        some = [each for each in found if each.at.is_free(each.faults) == is_free]
        least = max((each.log_weight for each in some), default=0.0) + np.log(LEAST_SHARE)
        for weight, chosen, gauge, at in some:
            if weight >= least:
                share, is_counter = float(np.exp(weight - log_total)), gauge < len(GAUGES) - 1
                rows = at.all_rows[gauge]
                fits.append(at.fitted(chosen, rows, share, is_counter=is_counter))
    return sorted(fits, key=attrgetter("share"), reverse=True)


def _explained(chain: Chain, priors: Priors, soc_pct: FloatArray) -> list[_Weighed]:
    """Move from one set of faults to the next better one while there is one.

    Each set is weighed at its own linearisation; its neighbours count with their probabilities.
    """
    chosen, soc = frozenset[int](), soc_pct
    for _ in range(MOST_MOVES):
        at = Linearised(chain, priors, soc)
        weights = _neighbourhood(at, sorted(chosen))
        best = max(weights, key=lambda faults: float(logsumexp(weights[faults])))
        if best == chosen:
            break
        chosen = best
        soc = _settled(chain, priors, soc, sorted(chosen), int(np.argmax(weights[best])))
    return [
        _Weighed(float(weight), tuple(sorted(some)), gauge, at)
        for some, of_gauges in weights.items()
        for gauge, weight in enumerate(of_gauges)
    ]


def _neighbourhood(at: Linearised, chosen: Sequence[int]) -> dict[frozenset[int], FloatArray]:
    """Return ln weights, over `GAUGES`, of a set and of all that differ from it by one fault.

    Those of no fault and of one alone are always among them.
    """
    found = dict[frozenset[int], FloatArray]()
    for left in ([], chosen, *([j for j in chosen if j != one] for one in chosen)):
        base, more = at.log_weights(left)
        found[frozenset(left)] = base
        for j in np.flatnonzero(np.isfinite(more).any(axis=0)).tolist():
            found[frozenset([*left, j])] = more[:, j]
    return found


def _settled(
    chain: Chain,
    priors: Priors,
    soc_pct: FloatArray,
    chosen: Sequence[int],
    gauge: int | None,
    *,
    varies: float = VARIES,
) -> FloatArray:
    """Return the SoC at which the voltage is linearised: that which follows from it."""
    soc = soc_pct
    for _ in range(ITERATIONS):
        at = Linearised(chain, priors, soc, chosen, varies)
        rows = at.pack_rows if gauge is None else at.rows(GAUGES[gauge])
        found = at.fitted(range(len(chosen)), rows).pack_pct
        step = np.clip(found, -3.0, 103.0) - soc
        if np.abs(step).max() < SETTLED_PCT:
            break
        soc = soc + DAMPING * step
    return soc
