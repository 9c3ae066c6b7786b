"""The linear Gaussian model of all logs: voltages, full charges and counts of the gauge.

With θ the coefficients of the columns of `faults`, the true SoC is S(θ), linear in θ. Two parts of
the model are not: the voltage over S, and an error of scale, a coefficient times a distance in S.
`Linearised` holds their derivatives at some θ.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import csc_array, csr_array

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.extras.judge.chain import Chain
from cangauge.extras.judge.faults import FAULTS, Column, faults, healthy
from cangauge.model.gaussian import GaussianPosterior, Rows

VARIES: Final = 0.5
"""Part of the model's voltage errors that varies within a stretch [-]: they hold what differs from
log to log too. Of 0.5, 1, 2 and 4 the evidence of every development chain chose the least."""
BEYOND: Final = 3.0
"""Largest size of a fault that can explain an error [prior standard deviations]."""
GAUGES: Final = np.array(
    [
        (0.05, 0.05, 0.1, 0.5, 0.3),
        (0.1, 0.15, 0.3, 2.0, 0.6),
        (0.5, 0.5, 1.0, 10.0, 1.5),
        (3.0, 1.5, 3.0, 30.0, 3.0),
    ]
)
"""Errors of a healthy gauge relative to counted charge, as standard deviations: of each block
alone, of a random walk in an hour, of a steady drift over an hour, of the charge that a stretch
counts, and of the level between stretches [%]. From a pure counter (a BMW i3's) to a gauge that
follows the voltage, which counts nothing."""

Part = tuple[FloatArray, FloatArray, FloatArray]
"""X, y and a root of the covariance of the noise of some rows."""
Set = frozenset[int]
"""Numbers of faults."""


class Fitted(NamedTuple):
    """Posterior of a set of faults."""

    share: float
    """Probability among all sets and sizes of the gauge's noise."""
    is_counter: bool
    """Whether the gauge counts: what is left of its SoC is below the largest noise."""
    is_free: bool
    """Whether the level of the last piece is free: then the gauge does not confirm itself."""
    faults: tuple[Column, ...]
    posterior: GaussianPosterior
    """Of the faults, then of what is always there."""
    pack_pct: FloatArray
    """SoC of each block beside the model, …"""
    soc_pct: FloatArray
    """… and on the gauge's scale, with its σ [%]."""
    std_pct: FloatArray


class Terms:
    """What each coefficient does to a chain, as far as that does not depend on the SoC.

    Parameters
    ----------
    chain : Chain
    known : mapping
        As of `healthy`.

    Attributes
    ----------
    columns : list of Column
        What is always there, then the faults.
    healthy : int
        Number of columns that are always there.
    S, Y, volts : sparse array of shape (blocks, columns)
        `soc`, `shown` and `volts` of the columns.
    """

    def __init__(self, chain: Chain, known: Mapping[str, float]) -> None:
        self.chain = chain
        always = healthy(chain, known)
        self.columns, self.healthy = [*always, *faults(chain)], len(always)
        self.S, self.Y, self.volts = (
            _sparse([getattr(each, of) for each in self.columns], chain.piece.size)
            for of in ("soc", "shown", "volts")
        )

    def of(self, chosen: Set) -> IntArray:
        """Return the numbers of the columns of a set of faults."""
        return np.array([*range(self.healthy), *(self.healthy + k for k in sorted(chosen))])


class Linearised:
    """The model of a chain, linearised at given coefficients.

    Parameters
    ----------
    terms : Terms
    theta : array of shape (columns,)
        Coefficients of all columns.
    chosen : set of int, optional
        Numbers of the faults that it has; by default all.
    varies : float
        Part of the voltage's errors that varies within a stretch.
    """

    def __init__(
        self, terms: Terms, theta: FloatArray, chosen: Set | None = None, varies: float = VARIES
    ) -> None:
        self._chain, self._n = terms.chain, terms.healthy
        of = np.arange(theta.size) if chosen is None else terms.of(chosen)
        columns = [terms.columns[k] for k in of]
        self.faults, self._std = columns[self._n :], np.array([each.std for each in columns])
        soc_pct, theta = terms.chain.fitting_pct + terms.S @ theta, theta[of]
        self._S, volts = terms.S[:, of], terms.volts[:, of]
        distances, moves = list[FloatArray | float](), csr_array(self._S.shape)
        for each, coefficient in zip(columns, theta.tolist(), strict=True):
            if each.right_at is None:
                distances.append(0.0)
                continue
            if isinstance(each.right_at, float):
                distance, moved = soc_pct - each.right_at, self._S
            else:
                distance = soc_pct - soc_pct[each.right_at]
                moved = self._S - self._S[each.right_at]
            distances.append(distance / 100.0)
            if coefficient:
                moves = moves + coefficient / 100.0 * moved
        self._Y = terms.Y[:, of] + _sparse(distances, soc_pct.size) + moves
        self._moved_pct = moves @ theta
        self._rows = dict[int | None, Rows]()
        self._pack = _total(self._pack_parts(soc_pct, theta, volts, varies))

    def _pack_parts(
        self, soc_pct: FloatArray, theta: FloatArray, volts: csr_array, varies: float
    ) -> Iterator[Part]:
        """Yield the prior, all voltages, full charges and joints."""
        chain, S, functions = self._chain, self._S, self._chain.functions.number
        prior = np.eye(self._n, self._std.size)
        yield prior, np.zeros(self._n), np.diag(self._std[: self._n])
        slope = chain.tangent(soc_pct, theta[:functions])
        error_v = chain.blocks.voltage_v - chain.voltage_v(soc_pct)
        error_v += slope * (soc_pct - chain.fitting_pct)
        of_functions = chain.function_columns(soc_pct)
        for at, root in chain.voltages(varies):
            X = slope[at, None] * S[at].toarray() + volts[at].toarray()
            X[:, :functions] += of_functions[at]
            yield X, error_v[at], root
        full = np.flatnonzero(chain.is_full)
        # Standard deviation of the SoC at the end of a full charge: cut-off current and balancing.
        yield S[full].toarray(), 100.0 - chain.fitting_pct[full], 1.5 * np.eye(full.size)
        later = [each for each in chain.stretches if each.continues]
        first = np.array([each.blocks.start for each in later], dtype=np.intp)
        ends = np.array([each.samples.start - 1 for each in later], dtype=np.intp)
        drawn_pct = chain.blocks.drawn_pct
        between_pct = drawn_pct[first] + chain.samples.drawn_pct[ends] - drawn_pct[first - 1]
        apart_pct = chain.fitting_pct[first - 1] - chain.fitting_pct[first] - between_pct
        # Where one stretch continues another, the SoC is the same but for the resolution of a log.
        yield (S[first] - S[first - 1]).toarray(), apart_pct, 0.1 * np.eye(first.size)

    def _gauge_parts(self, gauge: int) -> Iterator[Part]:
        """Yield all counts at one of `GAUGES`."""
        white, walk, drift, scale, level = GAUGES[gauge].tolist()
        chain, blocks = self._chain, self._chain.blocks
        left_pct = blocks.count_pct - blocks.drawn_pct - chain.fitting_pct + self._moved_pct
        for stretch in chain.stretches:
            at = np.flatnonzero(np.isfinite(blocks.count_pct[stretch.blocks]))
            at += stretch.blocks.start
            hours, last = blocks.hours[at], stretch.samples.stop - 1
            drift_pct = drift * hours / np.sqrt(max(float(chain.samples.hours[last]), 1.0))
            scale_pct = scale * blocks.drawn_pct[at] / 100.0
            own = white**2 + float(chain.samples.step_pct[last]) ** 2 / 12.0
            covariance = walk**2 * np.minimum(hours[:, None], hours) + own * np.eye(at.size)
            covariance += np.outer(drift_pct, drift_pct) + np.outer(scale_pct, scale_pct) + level**2
            root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
            yield self._Y[at].toarray(), left_pct[at], root

    def rows(self, gauge: int | None) -> Rows:
        """Return the rows of the pack, and of all counts at one of `GAUGES`; None: of none."""
        if gauge not in self._rows:
            pack = self._pack
            self._rows[gauge] = pack if gauge is None else pack + _total(self._gauge_parts(gauge))
        return self._rows[gauge]

    def all_rows(self, gauge: int | None) -> Rows:
        """Return the rows with the priors of the faults."""
        of_faults = np.eye(self._std.size)[self._n :]
        prior = Rows.of(of_faults, np.zeros(len(of_faults)), self._std[self._n :])
        return self.rows(gauge) + prior

    @cached_property
    def _of_faults(self) -> list[Rows]:
        """Rows of the faults at each of `GAUGES`."""
        return [self.rows(k).eliminated(self._n) for k in range(len(GAUGES))]

    def neighbourhood(self, chosen: Set) -> dict[Set, FloatArray]:
        """Return ln weights, over `GAUGES`, of a set and of all that differ from it by one fault.

        Those of no fault and of one alone are always among them.
        """
        found = dict[Set, FloatArray]()
        for left in ((), chosen, *(chosen - {one} for one in sorted(chosen))):
            found |= self._weights(sorted(left))
        return found

    def log_weight(self) -> float:
        """Return the ln weight of the set of all its faults."""
        (of_gauges,) = self._weights(range(len(self.faults))).values()
        return float(np.logaddexp.reduce(of_gauges))

    def _weights(self, chosen: Sequence[int]) -> dict[Set, FloatArray]:
        """Return ln weights, over `GAUGES`, of a set, and with each other fault added to it."""
        taken = {self.faults[k].place for k in chosen}
        free = [k for k, fault in enumerate(self.faults) if fault.place not in taken]
        others = np.array(free, dtype=np.intp)
        is_signed = np.array([any(FAULTS[self.faults[k].fault].sides) for k in others], dtype=bool)
        log_prior = np.array([fault.log_prior for fault in self.faults])
        std = self._std[self._n :]
        prior = Rows.prior(std[list(chosen)], others=len(others))
        weights = []
        for rows in self._of_faults:
            given = rows.with_columns([*chosen, *others]) + prior
            added = given.added(len(chosen), std[others])
            base = added.log_evidence + log_prior[list(chosen)].sum()
            size = added.mean / std[others]
            is_sound = (np.abs(size) <= BEYOND) & ((size > 0.0) | is_signed)
            more = np.where(is_sound, base + added.log_factor + log_prior[others], -np.inf)
            weights.append([base, *more])
        sets = [frozenset(chosen), *(frozenset([*chosen, k]) for k in others)]
        return {
            each: weight
            for each, weight in zip(sets, np.array(weights).T, strict=True)
            if np.isfinite(weight).any()
        }

    def fitted(self, chosen: Sequence[int], gauge: int, share: float = 1.0) -> Fitted:
        """Return the posterior of a set of faults of a probability at one of `GAUGES`."""
        of = [*(self._n + k for k in chosen), *range(self._n)]
        prior = Rows.prior(self._std[of[: len(chosen)]], others=self._n)
        posterior = (self.rows(gauge).with_columns(of) + prior).posterior()
        X, zero = self._S[:, of], len(chosen) + self._chain.functions.number
        pack_pct = self._chain.fitting_pct + X @ posterior.mean
        std_pct = [
            np.linalg.norm(X[each.blocks] @ posterior.root + posterior.root[zero], axis=1)
            for each in self._chain.stretches
        ]
        return Fitted(
            share,
            gauge != len(GAUGES) - 1,
            self.is_free(chosen),
            tuple(self.faults[k] for k in chosen),
            posterior,
            pack_pct,
            pack_pct + posterior.mean[zero],
            np.concatenate(std_pct),
        )

    def is_free(self, chosen: Iterable[int]) -> bool:
        """Return whether a set has a level for the last count of the gauge."""
        counts = np.flatnonzero(self._chain.piece >= 0)
        levels = [self.faults[k].shown for k in chosen if self.faults[k].piece >= 0]
        return not counts.size or any(np.asarray(shown)[counts[-1]] for shown in levels)


def _total(parts: Iterable[Part]) -> Rows:
    """Return all rows as one.

    Within a stretch most columns are 0 or alike: its own few rows wait until they are as many as
    pay for a reduction of all columns. (A Gram matrix would square the condition number.)
    """
    tables, waiting, log_norm = list[FloatArray](), 0, 0.0
    for X, y, root in parts:
        first = dict[bytes, int]()
        alike = [first.setdefault(column.tobytes(), k) for k, column in enumerate(X.T)]
        distinct, place = np.unique(alike, return_inverse=True)
        rows = Rows.correlated(X[:, distinct], y, root)
        tables.append(rows.table[:, [*place.tolist(), -1]])
        log_norm += rows.log_norm
        waiting += len(rows.table)
        if waiting > 2 * (X.shape[1] + 1):
            tables, waiting = [Rows(np.concatenate(tables), 0.0).reduced().table], 0
    return Rows(np.concatenate(tables), log_norm).reduced()


def _sparse(columns: Sequence[FloatArray | BoolArray | float], size: int) -> csr_array:
    """Return columns as a matrix: most are 0 but in a few stretches."""
    every = [np.broadcast_to(each, size) for each in columns]
    rows = [np.flatnonzero(each) for each in every]
    values = np.concatenate([each[at] for each, at in zip(every, rows, strict=True)])
    edges = np.cumsum([0, *(at.size for at in rows)])
    shape = (size, len(columns))
    return csc_array((values, np.concatenate(rows), edges), shape=shape, dtype=np.float64).tocsr()
