"""Which faults explain the logs, each set of them with its probability.

All quantities of the chain are one linear Gaussian model (`model.gaussian`). Faults are added,
exchanged and dropped one at a time while that raises the evidence, and at the end every set of
faults that differs by one counts with its probability: nothing is certain because it was chosen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from operator import attrgetter
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.special import logsumexp

from cangauge._typing import BoolArray, FloatArray
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


class Linearised:
    """The model of a chain whose voltage is linearised at a SoC.

    Parameters
    ----------
    chain : Chain
    known : mapping
        As of `healthy`.
    soc_pct : array of shape (blocks,)
    only : sequence of int, optional
        Numbers of the faults that it has; by default all.
    varies : float
        Part of the voltage's errors that varies within a stretch.
    """

    def __init__(
        self,
        chain: Chain,
        known: Mapping[str, float],
        soc_pct: FloatArray,
        only: Sequence[int] | None = None,
        varies: float = VARIES,
    ) -> None:
        self._chain = chain
        always, every = healthy(chain, known, soc_pct), faults(chain, soc_pct)
        self.faults = every if only is None else [every[k] for k in only]
        columns = [*always, *self.faults]
        self._n = len(always)
        self._std = np.array([each.std for each in columns])
        self._S, self._Y, volts = (
            _sparse([getattr(each, of) for each in columns], soc_pct.size)
            for of in ("soc", "shown", "volts")
        )
        starts = [each.blocks.start for each in chain.stretches]
        self._start_pct = (soc_pct + chain.blocks.drawn_pct)[starts][chain.blocks.stretch]
        self._counted_pct = self._start_pct - chain.blocks.drawn_pct
        slope = chain.slope(soc_pct)
        error_v = chain.blocks.voltage_v - chain.voltage_v(soc_pct)
        error_v += slope * (soc_pct - self._counted_pct)
        self._rows = dict[int | None, Rows]()
        self._pack = _total(self._pack_parts(slope, error_v, volts, varies))

    def _pack_parts(
        self, slope: FloatArray, error_v: FloatArray, volts: csr_array, varies: float
    ) -> Iterator[Part]:
        """Yield the prior, all voltages, full charges and joints."""
        chain, S, counted_pct = self._chain, self._S, self._counted_pct
        prior = np.eye(self._n, self._std.size)
        yield prior, np.zeros(self._n), np.diag(self._std[: self._n])
        for at, root in chain.voltages(varies):
            yield slope[at, None] * S[at].toarray() + volts[at].toarray(), error_v[at], root
        full = np.flatnonzero(chain.is_full)
        # Standard deviation of the SoC at the end of a full charge: cut-off current and balancing.
        yield S[full].toarray(), 100.0 - counted_pct[full], 1.5 * np.eye(full.size)
        later = [each for each in chain.stretches if each.continues]
        first = np.array([each.blocks.start for each in later], dtype=np.intp)
        ends = np.array([each.samples.start - 1 for each in later], dtype=np.intp)
        drawn_pct = chain.blocks.drawn_pct
        between_pct = drawn_pct[first] + chain.samples.drawn_pct[ends] - drawn_pct[first - 1]
        apart_pct = counted_pct[first - 1] - counted_pct[first] - between_pct
        # Where one stretch continues another, the SoC is the same but for the resolution of a log.
        yield (S[first] - S[first - 1]).toarray(), apart_pct, 0.1 * np.eye(first.size)

    def _gauge_parts(self, gauge: int) -> Iterator[Part]:
        """Yield all counts at one of `GAUGES`."""
        white, walk, drift, scale, level = GAUGES[gauge].tolist()
        chain, blocks = self._chain, self._chain.blocks
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
            yield self._Y[at].toarray(), blocks.count_pct[at] - self._start_pct[at], root

    def rows(self, gauge: int | None) -> Rows:
        """Return the rows of the pack, and of all counts at one of `GAUGES`; None: of none."""
        if gauge not in self._rows:
            pack = self._pack
            self._rows[gauge] = pack if gauge is None else pack + _total(self._gauge_parts(gauge))
        return self._rows[gauge]

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

    def fitted(self, chosen: Sequence[int], gauge: int | None, share: float = 1.0) -> Fitted:
        """Return the posterior of a set of faults of a probability at one of `GAUGES`."""
        of = [*(self._n + k for k in chosen), *range(self._n)]
        prior = Rows.prior(self._std[of[: len(chosen)]], others=self._n)
        posterior = (self.rows(gauge).with_columns(of) + prior).posterior()
        X, zero = self._S[:, of], len(chosen) + self._chain.functions.number
        pack_pct = self._counted_pct + X @ posterior.mean
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


def explain(chain: Chain, known: Mapping[str, float]) -> list[Fitted]:
    """Return the sets of faults that explain the logs, the most probable first.

    The first linearisation is at the SoC that the voltage shows itself, with the gauge withheld.
    Each set is weighed at its own; its neighbours count with their probabilities.
    """
    soc_pct = _settled(chain, known, chain.fitting_pct)
    best, seen = Set(), set[Set]()
    while best not in seen:
        seen.add(best)
        at = Linearised(chain, known, soc_pct)
        weights = at.neighbourhood(best)
        totals = [logsumexp(of_gauges) for of_gauges in weights.values()]
        best = list(weights)[int(np.argmax(totals))]
        if best not in seen:
            soc_pct = _settled(chain, known, soc_pct, sorted(best), int(np.argmax(weights[best])))
    fits = []
    for is_free in (False, True):
        some = {chosen: each for chosen, each in weights.items() if at.is_free(chosen) == is_free}
        most = max((float(each.max()) for each in some.values()), default=0.0)
        for chosen, of_gauges in some.items():
            for gauge in np.flatnonzero(of_gauges >= most + np.log(0.003)).tolist():
                share = float(np.exp(of_gauges[gauge] - logsumexp(totals)))
                fits.append(at.fitted(sorted(chosen), gauge, share))
    return sorted(fits, key=attrgetter("share"), reverse=True)


def _settled(
    chain: Chain,
    known: Mapping[str, float],
    soc_pct: FloatArray,
    chosen: Sequence[int] = (),
    gauge: int | None = None,
) -> FloatArray:
    """Return the SoC at which the voltage is linearised: that which follows from it.

    With the gauge withheld all of the voltage's errors may vary.
    """
    for _ in range(8):  # a part of the way each, as the slope jumps between features of a curve
        at = Linearised(chain, known, soc_pct, chosen, 1.0 if gauge is None else VARIES)
        found = at.fitted(range(len(chosen)), gauge).pack_pct
        step = np.clip(found, -3.0, 103.0) - soc_pct
        if np.abs(step).max() < 0.1:
            break
        soc_pct = soc_pct + 0.6 * step
    return soc_pct
