"""What may be wrong with a gauge and with its log, and the evidence of each.

Every quantity of the chain is a `Term`: a column of the linear Gaussian model with what it adds to
the true SoC, to the published one, and to the voltage. A healthy pack has some of small standard
deviation. A fault is one of large standard deviation and small prior probability. Faults are added
one at a time by their evidence (`model.gaussian`), and at the end every set of faults that differs
by one counts with its probability: nothing is certain because it was chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy.special import logsumexp

from cangauge._typing import FloatArray, IntArray
from cangauge.extras.judge.chain import Chain, Stretch
from cangauge.model.gaussian import Rows

FREE_PCT: Final = 60.0
"""Standard deviation of the SoC at the start of a stretch [%]: unknown."""
JOINT_PCT: Final = 0.1
"""Noise of the SoC where one stretch continues another [%]."""
FULL_STD_PCT: Final = 1.5
"""Standard deviation of the SoC at the end of a full charge [%]: cut-off current and balancing."""
LEVEL_PCT: Final = 15.0
"""Standard deviation of the level of a piece that is wrong [%]: anything."""
SCALE_PCT: Final = 8.0
"""Standard deviation of a wrong scale or capacity [%]: what ageing takes until it is noticed."""
PIECE_PCT: Final = 0.5
"""Standard deviation of the level of a piece that is right [%]."""
SHARED: Final = 1.0
"""Standard deviation of the level of the voltage that all stretches share: as much as differs
from log to log, since a model is off in the same way on days that are alike."""

P_LEVEL: Final = 0.5
"""Prior probability that the level of a piece is wrong: whoever asks has a reason."""
P_FAULT: Final = 0.05
"""Prior probability of each other fault."""
P_SELDOM: Final = 0.02
"""Prior probability that the log or the model is wrong instead: that a voltage sensor is beyond its
class, or that the pack has another capacity than the model and the gauge knows it."""
MOST_MOVES: Final = 10
"""Sets of faults that are tried one after the other."""
BEYOND: Final = 3.0
"""A fault whose size is beyond so many of its prior standard deviations is no explanation."""

LATE_S: Final = (30.0, 60.0, 120.0, 240.0, 480.0)
"""Lags that are tried [s]."""
HEALTHY: Final = (1, 1)
"""Sizes of the noise of a usual pack and gauge."""
VOLTAGE_SCALES: Final = (0.5, 1.0, 2.0, 4.0)
"""Factors on the model's errors of the voltage: a pack on other days may follow its model worse
than left-out logs did."""
ITERATIONS: Final = 8
"""Linearisations at most, …"""
DAMPING: Final = 0.6
"""… each this part of the way, since the slope of a curve jumps between its features, …"""
SETTLED_PCT: Final = 0.1
"""… until no SoC moves by more [%]."""
LEAST_SHARE: Final = 0.003
"""Least probability of a set of faults that counts."""
LEAST_SLOPE: Final = 0.1
"""Least slope of the curve, relative to its mean, for a SoC read from a voltage [-]."""


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
"""From a pure counter (a BMW i3's) to a gauge that follows the voltage (`batic_car1`'s)."""


Noise = tuple[int, int]
"""Sizes of the noise of voltage and gauge: places in `VOLTAGE_SCALES` and `GAUGES`."""


class Contribution(NamedTuple):
    """What one unit of a term adds in a stretch; arrays of shape (n,), or 0."""

    soc: FloatArray | float = 0.0
    """To the true SoC [%], …"""
    shown: FloatArray | float = 0.0
    """… to the published one [%], each relative to a stretch that starts with s, …"""
    volts: FloatArray | float = 0.0
    """… and to the voltage beside the change of SoC [V]."""
    at_full: FloatArray | float = 0.0
    """To the true SoC where a charge ended full, shape (charges,)."""
    at_end: float = 0.0
    """To the true SoC at the end of the stretch, where the next may continue it."""


@dataclass(frozen=True, eq=False)
class Term:
    """A column of the model.

    Parameters
    ----------
    name, unit : str
    std : float
        Prior standard deviation [unit].
    blocks : dict
        Number of a stretch → what a unit adds in it.
    log_prior : float
        Log of the prior probability relative to none; 0 for what is always there.
    piece, since : int
        Piece whose level it is, and stretch with which it begins.
    per_unit : float
        Size that is reported for a unit of the term.
    is_positive, is_of_one_piece : bool
        Whether its size has one sign, and whether it is the level of one piece alone.
    """

    name: str
    unit: str
    std: float
    blocks: dict[int, Contribution]
    log_prior: float = 0.0
    piece: int = -1
    since: int = 0
    per_unit: float = 1.0
    is_positive: bool = False
    is_of_one_piece: bool = False

    @property
    def place(self) -> tuple[str, int, int]:
        """What a set has one shape of."""
        if self.name == "start_or_reset":
            return self.name, self.piece, self.since
        is_scale = self.name in {"count_scale", "pack_capacity", "model_capacity"}
        return "scale" if is_scale else self.name, 0, 0


@dataclass(frozen=True)
class Priors:
    """How well capacity, zero and voltage of the pack are known, as standard deviations."""

    capacity_ah: float
    capacity_std_pct: float
    zero_std_pct: float
    """Of the gauge's own zero beside the model's [% SoC]."""
    voltage_std_pct: float
    """Of the scale of the voltage beside the model's [%]."""


class Axis(NamedTuple):
    """Where each stretch and piece begins, at a linearisation."""

    start_pct: list[float]
    """SoC at the start of each stretch."""
    hours: list[float]
    """Hours since the first row at which each stretch begins."""
    pieces: dict[int, tuple[float, float]]
    """Hours and SoC at which each piece begins."""

    @classmethod
    def of(cls, chain: Chain, soc_pct: Sequence[FloatArray], *, logged: bool) -> Axis:
        """Place stretches and pieces in time, by logged hours or by stamps."""
        starts, hours, before = list[float](), list[float](), 0.0
        pieces = dict[int, tuple[float, float]]()
        first_s = chain.stretches[0].time_s[0]
        for part, soc in zip(chain.stretches, soc_pct, strict=True):
            begin = before if logged else float(part.time_s[0] - first_s) / 3600.0
            starts.append(float(soc[0] + part.drawn_pct[0]))
            hours.append(begin)
            for number in np.unique(part.piece[part.piece >= 0]).tolist():
                at = int(np.argmax(part.piece == number))
                pieces.setdefault(number, (begin + part.hours[at], float(soc[at])))
            before += float(part.hours[-1])
        return cls(starts, hours, pieces)


def healthy_terms(chain: Chain, priors: Priors, soc_pct: Sequence[FloatArray]) -> list[Term]:
    """Return what a healthy pack and gauge show; first the start of each stretch, then the zero."""
    parts, per_ah = chain.stretches, 100.0 / priors.capacity_ah
    terms = [
        Term("start", "%", FREE_PCT, {k: Contribution(1.0, 1.0, at_full=1.0, at_end=1.0)})
        for k in range(len(parts))
    ]
    terms.append(
        Term("zero", "%", priors.zero_std_pct, _each(parts, lambda _: Contribution(shown=1.0)))
    )
    functions = [
        chain.function_columns(part, soc) for part, soc in zip(parts, soc_pct, strict=True)
    ]
    terms += [
        Term("curve", "-", 1.0, {k: Contribution(volts=of[:, j]) for k, of in enumerate(functions)})
        for j in range(chain.functions.number)
    ]
    terms.append(
        Term("level", "-", SHARED, _each(parts, lambda part: Contribution(volts=part.level_v)))
    )
    volts = _each(parts, lambda part: Contribution(volts=np.nan_to_num(part.voltage_v) / 100.0))
    terms.append(Term("voltage", "%", priors.voltage_std_pct, volts))
    offset = _each(parts, lambda part: _of_hours(part, per_ah))
    terms.append(Term("offset", "A", priors.capacity_ah / 400.0, offset))
    drawn = _each(parts, _of_charge)
    terms.append(Term("capacity", "%", priors.capacity_std_pct, drawn))
    terms += [Term("piece", "%", PIECE_PCT, _shown_in(parts, [n])) for n in _pieces(chain)]
    return terms


def _each(
    parts: Sequence[Stretch], of: Callable[[Stretch], Contribution]
) -> dict[int, Contribution]:
    return {k: of(part) for k, part in enumerate(parts)}


def _of_hours(part: Stretch, per_ah: float) -> Contribution:
    """Return an offset of the sensor of 1 A, which the gauge counts with."""
    return Contribution(
        soc=per_ah * part.hours,
        at_full=per_ah * part.full_hours,
        at_end=per_ah * float(part.row_hours[-1]),
    )


def _of_charge(part: Stretch) -> Contribution:
    """Return a surplus of capacity of 1 %, which the gauge does not know."""
    return Contribution(
        soc=part.drawn_pct / 100.0,
        at_full=part.full_drawn_pct / 100.0,
        at_end=float(part.row_drawn_pct[-1]) / 100.0,
    )


def faults(chain: Chain, priors: Priors, soc_pct: Sequence[FloatArray]) -> list[Term]:
    """Return everything that may be wrong, in all its shapes."""
    found = list[Term]()
    for shapes, probability in _shapes(chain, priors, soc_pct):
        odds = np.log(probability / (1.0 - probability))
        # Half of it began before the first log.
        early = sum(shape.since == 0 for shape in shapes)
        late = len(shapes) - early
        for shape in shapes:
            count = early if shape.since == 0 else late
            part = np.log(count * (2.0 if early and late else 1.0))
            found.append(replace(shape, log_prior=float(odds - part)))
    return found


def _shapes(
    chain: Chain, priors: Priors, soc_pct: Sequence[FloatArray]
) -> Iterator[tuple[list[Term], float]]:
    """Yield the shapes of each fault, and its prior probability."""
    parts, pieces = chain.stretches, _pieces(chain)
    for number, inside in pieces.items():
        yield list(_levels(parts, number, inside[0], max(pieces))), P_LEVEL
    yield list(_in_pauses(parts, pieces)), P_FAULT
    logged, stamped = (Axis.of(chain, soc_pct, logged=of) for of in (True, False))
    yield list(_offsets(parts, logged, stamped, priors.capacity_ah)), P_FAULT
    yield list(_scales(parts, soc_pct, logged, gauge=True)), P_FAULT
    yield list(_scales(parts, soc_pct, logged, gauge=False)), P_FAULT
    aged = {
        k: _of_charge(part)._replace(shown=part.drawn_pct / 100.0) for k, part in enumerate(parts)
    }
    yield [Term("model_capacity", "%", SCALE_PCT, aged)], P_SELDOM
    volts = {
        k: Contribution(volts=np.nan_to_num(part.voltage_v) / 100.0) for k, part in enumerate(parts)
    }
    sensors = [
        Term("voltage_sensor", "%", 1.5, {k: volts[k] for k in volts if k >= since}, since=since)
        for since in range(len(parts))
    ]
    yield sensors, P_SELDOM
    mean_slope = float(np.ptp(chain.extended.model.pseudo_ocv([5.0, 95.0]))) / 90.0
    under_load = {}
    for k, (part, soc) in enumerate(zip(parts, soc_pct, strict=True)):
        slope = np.maximum(chain.slope(part, soc), LEAST_SLOPE * mean_slope)
        under_load[k] = Contribution(shown=part.load_v / slope)
    yield [Term("voltage_table", "-", 1.0, under_load, is_positive=True)], P_FAULT
    yield [_late(parts, seconds) for seconds in LATE_S], P_FAULT


def _pieces(chain: Chain) -> dict[int, list[int]]:
    """Return the stretches that each piece is in."""
    found = dict[int, list[int]]()
    for k, part in enumerate(chain.stretches):
        for number in np.unique(part.piece[part.piece >= 0]).tolist():
            found.setdefault(number, []).append(k)
    return found


def _levels(parts: Sequence[Stretch], number: int, begin: int, last: int) -> Iterator[Term]:
    """Yield a wrong level of one piece, of all from it on, and of all up to it."""
    shapes = [(number, number)]
    if number < last:
        shapes.append((number, last))
    if 0 < number < last:
        shapes.append((0, number))
    for low, high in shapes:
        blocks = _shown_in(parts, range(low, high + 1))
        yield Term(
            "start_or_reset",
            "%",
            LEVEL_PCT,
            blocks,
            piece=number,
            since=begin,
            is_of_one_piece=low == high,
        )


def _in_pauses(parts: Sequence[Stretch], pieces: Mapping[int, list[int]]) -> Iterator[Term]:
    """Yield a level that is wrong from a pause within a piece on, or until it."""
    for number, inside in pieces.items():
        blocks, begin = _shown_in(parts, [number]), inside[0]
        for since in inside[1:]:
            if not parts[since].continues:
                after = {k: block for k, block in blocks.items() if k >= since}
                before = {k: block for k, block in blocks.items() if k < since}
                for part, at in ((after, since), (before, begin)):
                    yield Term("start_or_reset", "%", LEVEL_PCT, part, piece=number, since=at)


def _shown_in(parts: Sequence[Stretch], numbers: Sequence[int]) -> dict[int, Contribution]:
    """Return a published SoC that is 1 % higher in some pieces."""
    return {
        k: Contribution(shown=np.isin(part.piece, numbers).astype(np.float64))
        for k, part in enumerate(parts)
        if np.isin(part.piece, numbers).any()
    }


def _late(parts: Sequence[Stretch], seconds: float) -> Term:
    """Return a published SoC that is late."""
    blocks = {
        k: Contribution(shown=part.drawn_pct - part.drawn_before_pct(seconds))
        for k, part in enumerate(parts)
    }
    return Term("late", "s", 1.0, blocks, per_unit=seconds, is_positive=True)


def _offsets(
    parts: Sequence[Stretch], logged: Axis, stamped: Axis, capacity_ah: float
) -> Iterator[Term]:
    """Yield offsets of the current in the gauge's count alone, or in the log's sensor as well.

    The gauge's error grows while it logs, also while it does not, or within each log alone.
    """
    per_ah = 100.0 / capacity_ah
    for std in (capacity_ah / 25.0, capacity_ah / 250.0):
        for since in range(len(parts)):
            for in_sensor in (False, True):
                for axis, is_within in ((logged, False), (stamped, False), (logged, True)):
                    blocks = {}
                    for k, part in enumerate(parts):
                        if k < since:
                            continue
                        begin = max(axis.hours[since], axis.hours[k] if is_within else 0.0)
                        before = np.full(part.hours.size, axis.hours[k])
                        for n in np.unique(part.piece[part.piece >= 0]).tolist():
                            at = max(begin, axis.pieces[n][0])
                            before[part.piece == n] -= at
                        shown = -per_ah * before
                        if in_sensor:
                            blocks[k] = _of_hours(part, per_ah)._replace(shown=shown)
                        else:
                            blocks[k] = Contribution(shown=shown - per_ah * part.hours)
                    yield Term("current_offset", "A", std, blocks, since=since)


def _scales(
    parts: Sequence[Stretch], soc_pct: Sequence[FloatArray], axis: Axis, *, gauge: bool
) -> Iterator[Term]:
    """Yield wrong scales: of the gauge's count, or of the pack's capacity.

    The gauge is right when a piece begins, when it is full, or when it is empty; or its error is
    of each log alone.
    """
    for reference in ("piece", "full", "empty", "log"):
        blocks = {}
        for k, (part, soc) in enumerate(zip(parts, soc_pct, strict=True)):
            zero = np.full(part.hours.size, axis.start_pct[k])
            if reference == "full":
                zero[:] = 100.0
            elif reference == "empty":
                zero[:] = 0.0
            else:
                for n in np.unique(part.piece[part.piece >= 0]).tolist():
                    hours, at_pct = axis.pieces[n]
                    if reference == "piece" or hours >= axis.hours[k]:
                        zero[part.piece == n] = at_pct
            if gauge:
                blocks[k] = Contribution(shown=(soc - zero) / 100.0)
            else:
                blocks[k] = _of_charge(part)._replace(shown=(axis.start_pct[k] - zero) / 100.0)
        if gauge:
            yield Term("count_scale", "%", SCALE_PCT, blocks)
        else:
            yield Term("pack_capacity", "%", SCALE_PCT, blocks)


@dataclass(frozen=True, eq=False)
class Fitted:
    """Posterior of a set of faults at a size of the noise.

    Parameters
    ----------
    share, log_weight : float
        Probability among all, and ln of it without normalisation.
    faults : tuple of Term
    size, std : array of shape (faults,)
    pack_pct, soc_pct, std_pct : list of array
        SoC of each stretch's blocks beside the model, and on the gauge's scale with its σ.
    noise : tuple of int
    functions, covariance : array of shape (c,), (c, c)
        Principal functions of the curve after the logs.
    """

    share: float
    log_weight: float
    faults: tuple[Term, ...]
    size: FloatArray
    std: FloatArray
    pack_pct: list[FloatArray]
    soc_pct: list[FloatArray]
    std_pct: list[FloatArray]
    noise: Noise
    functions: FloatArray
    covariance: FloatArray
    is_free: bool
    """Whether the level of the last piece is free: then the gauge does not confirm itself."""


class Linearised:
    """All rows of a chain whose voltage is linearised at a SoC.

    Parameters
    ----------
    chain : Chain
    priors : Priors
    soc_pct : sequence of array
        Of each stretch [%].
    """

    def __init__(
        self,
        chain: Chain,
        priors: Priors,
        soc_pct: Sequence[FloatArray],
        only: Sequence[int] | None = None,
    ) -> None:
        self.chain, self.soc_pct = chain, soc_pct
        self.healthy = healthy_terms(chain, priors, soc_pct)
        every = faults(chain, priors, soc_pct)
        self.faults = every if only is None else [every[k] for k in only]
        self.terms = [*self.healthy, *self.faults]
        self._columns = [self._columns_of(k, part) for k, part in enumerate(chain.stretches)]
        self._std = np.array([term.std for term in self.terms])
        self._is_positive = np.array([term.is_positive for term in self.faults], dtype=bool)
        self._log_prior = np.array([term.log_prior for term in self.faults])

    @property
    def noises(self) -> list[Noise]:
        """Sizes of the noise, in the order of `log_weights`."""
        return list(self.all_rows)

    @cached_property
    def all_rows(self) -> dict[Noise, Rows]:
        """Rows at each size of the noise."""
        voltage = [self._voltage_rows(v) for v in range(len(VOLTAGE_SCALES))]
        gauge = [self._gauge_rows(g) for g in range(len(GAUGES))]
        rest = self._rest()
        return {
            (v, g): of_v + of_g + rest
            for v, of_v in enumerate(voltage)
            for g, of_g in enumerate(gauge)
        }

    def rows(self, noise: Noise) -> Rows:
        """Return the rows at one size of the noise."""
        return self._voltage_rows(noise[0]) + self._gauge_rows(noise[1]) + self._rest()

    def _counted(self, k: int) -> FloatArray:
        """Return the SoC counted from the start of the linearisation [%], to which terms add."""
        drawn_pct = self.chain.stretches[k].drawn_pct
        return np.asarray(self.soc_pct[k][0] + drawn_pct[0] - drawn_pct)

    def _rest(self) -> Rows:
        prior = Rows.prior(self._std[: len(self.healthy)], others=len(self.faults))
        return self._ties() + prior

    def _voltage_rows(self, v: int) -> Rows:
        """Return the rows of all voltages, the level of each stretch integrated out."""
        found, scale = [], VOLTAGE_SCALES[v]
        for k, part in enumerate(self.chain.stretches):
            S, _, V = self._columns[k]
            has = np.isfinite(part.voltage_v)
            slope = self.chain.slope(part, self.soc_pct[k])
            X = np.column_stack([part.level_v, slope[:, None] * S + V])[has]
            error_v = self.chain.error_v(part, self.soc_pct[k])
            error_v = (error_v + slope * (self.soc_pct[k] - self._counted(k)))[has]
            root = _root(scale**2 * part.scaled_v2 + part.axis_v2)
            rows = Rows.correlated(X, error_v, root)
            # The level is one number of a stretch: quiet voltages do not prove it small.
            level = np.array([max(scale, 1.0)])
            rows = rows + Rows.prior(level, others=len(self.terms))
            found.append(rows.eliminated(1))
        return _sum(found)

    def _gauge_rows(self, g: int) -> Rows:
        """Return the rows of all counts, what is of each stretch alone integrated out."""
        found, noise = [], GAUGES[g]
        for k, part in enumerate(self.chain.stretches):
            counted = np.isfinite(part.count_pct)
            start = float(self.soc_pct[k][0] + part.drawn_pct[0])
            h, drawn = part.hours[counted], part.drawn_pct[counted] / 100.0
            white = noise.white_pct**2 + part.published.step_pct**2 / 12.0
            walk = noise.walk_pct**2 * np.minimum(h[:, None], h) + np.eye(h.size) * white
            X = np.column_stack([np.ones(h.size), h, drawn, self._columns[k][1][counted]])
            rows = Rows.correlated(X, part.count_pct[counted] - start, _root(walk))
            drift = noise.drift_pct / np.sqrt(max(float(part.hours[-1]), 1.0))
            own = np.array([noise.error_pct, drift, noise.scale_pct])
            rows = rows + Rows.prior(own, others=len(self.terms))
            found.append(rows.eliminated(own.size))
        return _sum(found)

    def _columns_of(self, k: int, part: Stretch) -> tuple[FloatArray, FloatArray, FloatArray]:
        S, Y, V = np.zeros((3, part.hours.size, len(self.terms)))
        for j, term in enumerate(self.terms):
            block = term.blocks.get(k)
            if block is not None:
                S[:, j], Y[:, j], V[:, j] = block.soc, block.shown, block.volts
        return S, Y, V

    def _ties(self) -> Rows:
        """Return the rows of full charges, and of stretches that continue others."""
        X, y, std = list[FloatArray](), list[float](), list[float]()
        for k, part in enumerate(self.chain.stretches):
            start = float(self.soc_pct[k][0] + part.drawn_pct[0])
            of = [term.blocks.get(k, Contribution()) for term in self.terms]
            for c in range(part.full_hours.size):
                at_full = [np.broadcast_to(b.at_full, part.full_hours.shape)[c] for b in of]
                X.append(np.array(at_full, dtype=np.float64))
                y.append(100.0 + part.full_drawn_pct[c] - start)
                std.append(FULL_STD_PCT)
            if part.continues:
                before = self.chain.stretches[k - 1]
                was = [term.blocks.get(k - 1, Contribution()).at_end for term in self.terms]
                own = [1.0 if j == k else 0.0 for j in range(len(self.terms))]
                X.append(np.array(own) - np.array(was))
                begin = float(self.soc_pct[k - 1][0] + before.drawn_pct[0])
                y.append(begin - float(before.row_drawn_pct[-1]) - start)
                std.append(JOINT_PCT)
        if not X:
            return Rows(np.zeros((0, len(self.terms) + 1)), 0.0)
        return Rows.of(np.array(X), np.array(y), np.array(std))

    def log_weights(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return ln of the weight of a set of faults, and with each other fault added to it.

        Returns
        -------
        base : array of shape (noises,)
        more : array of shape (noises, faults)
            −∞ for other shapes of those in the set.
        """
        taken = {self.faults[k].place for k in chosen}
        others = np.array(
            [k for k, fault in enumerate(self.faults) if fault.place not in taken], dtype=np.intp
        )
        base, more = [], np.full((len(self.all_rows), len(self.faults)), -np.inf)
        for k, rows in enumerate(self.all_rows.values()):
            at = self._chosen(rows, chosen, others)
            added = at.added(len(self.healthy) + len(chosen), self._fault_std(others))
            base.append(added.log_evidence + float(self._log_prior[list(chosen)].sum()))
            size = added.mean / self._fault_std(others)
            is_sound = (np.abs(size) <= BEYOND) & ((size > 0.0) | ~self._is_positive[others])
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
        self, chosen: Sequence[int], noise: Noise, rows: Rows, log_weight: float = 0.0
    ) -> Fitted:
        """Return the posterior of a set of faults."""
        n, zero = len(self.healthy), len(self.chain.stretches)
        posterior = self._chosen(rows, chosen, np.zeros(0, dtype=np.intp)).posterior()
        pack, soc, std = [], [], []
        for k, (S, _, _) in enumerate(self._columns):
            X = S[:, [*range(n), *(n + j for j in chosen)]]
            pack.append(self._counted(k) + X @ posterior.mean)
            X[:, zero] = 1.0
            soc.append(self._counted(k) + X @ posterior.mean)
            std.append(posterior.std_of(X))
        units = np.array([self.faults[k].per_unit for k in chosen])
        functions = slice(zero + 1, zero + 1 + self.chain.functions.number)
        return Fitted(
            1.0,
            log_weight,
            tuple(self.faults[k] for k in chosen),
            posterior.mean[n:] * units,
            np.sqrt(np.diag(posterior.covariance)[n:]) * units,
            pack,
            soc,
            std,
            noise,
            posterior.mean[functions],
            posterior.covariance[functions, functions],
            self.is_free(chosen),
        )

    def is_free(self, chosen: Sequence[int]) -> bool:
        """Return whether a set has a level for the last count of the gauge."""
        counts = [
            (k, int(np.flatnonzero(np.isfinite(part.count_pct))[-1]))
            for k, part in enumerate(self.chain.stretches)
            if np.isfinite(part.count_pct).any()
        ]
        if not counts:
            return True
        last, at = counts[-1]
        levels = [self.faults[j] for j in chosen if self.faults[j].name == "start_or_reset"]
        shown = [level.blocks[last].shown for level in levels if last in level.blocks]
        return any(np.atleast_1d(of)[at] != 0.0 for of in shown)


def _root(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


def _sum(rows: Sequence[Rows]) -> Rows:
    return Rows(
        np.concatenate([each.table for each in rows]), sum(each.log_norm for each in rows)
    ).reduced()


def explain(chain: Chain, priors: Priors) -> list[Fitted]:
    """Return the sets of faults that explain the logs, the most probable first.

    The voltage is linearised at the SoC that it shows itself, with the gauge withheld, and at the
    published one, so that its curvature accuses no gauge.
    """
    by_voltage = [part.fitting_pct for part in chain.stretches]
    published = [part.published_or(part.fitting_pct) for part in chain.stretches]
    of_pieces = [
        number
        for number, fault in enumerate(faults(chain, priors, by_voltage))
        if fault.name == "start_or_reset" and fault.is_of_one_piece
    ]
    withheld = _settled(chain, priors, by_voltage, of_pieces, HEALTHY)
    right = _settled(chain, priors, published, [], HEALTHY)
    found = [*_explained(chain, priors, withheld), *_explained(chain, priors, right)]
    values = np.array([each.log_weight for each in found])
    share = np.exp(values - logsumexp(values))
    result = [replace(each, share=float(of)) for each, of in zip(found, share, strict=True)]
    kept = [each for each in result if each.share >= LEAST_SHARE * _best(result, each.is_free)]
    return sorted(kept, key=lambda each: -each.share)


def _best(fits: Sequence[Fitted], is_free: bool) -> float:
    return max(each.share for each in fits if each.is_free == is_free)


def _explained(chain: Chain, priors: Priors, soc_pct: Sequence[FloatArray]) -> list[Fitted]:
    """Move from one set of faults to the next better one while there is one.

    Each set is weighed at its own linearisation; its neighbours count with their probabilities.
    """
    chosen, soc = frozenset[int](), list(soc_pct)
    for _ in range(MOST_MOVES):
        at = Linearised(chain, priors, soc)
        weights = _neighbourhood(at, sorted(chosen))
        best = max(weights, key=lambda faults: float(logsumexp(weights[faults])))
        if best == chosen:
            break
        chosen, noise = best, at.noises[int(np.argmax(weights[best]))]
        soc = _settled(chain, priors, soc, sorted(chosen), noise)
    found = [
        (float(weight), sorted(faults), noise, at.is_free(sorted(faults)))
        for faults, of_noises in weights.items()
        for noise, weight in zip(at.noises, of_noises, strict=True)
    ]
    result = list[Fitted]()
    for of in (False, True):
        some = [each for each in found if each[3] == of]
        least = max((each[0] for each in some), default=0.0) + np.log(LEAST_SHARE)
        result += [
            at.fitted(faults, noise, at.all_rows[noise], weight)
            for weight, faults, noise, _ in some
            if weight >= least
        ]
    return result


def _neighbourhood(at: Linearised, chosen: Sequence[int]) -> dict[frozenset[int], FloatArray]:
    """Return ln weights, over the noises, of a set and of all that differ from it by one fault.

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
    chain: Chain, priors: Priors, soc_pct: Sequence[FloatArray], chosen: Sequence[int], noise: Noise
) -> list[FloatArray]:
    """Return the SoC at which the voltage is linearised: that which follows from it."""
    soc = list(soc_pct)
    for _ in range(ITERATIONS):
        at = Linearised(chain, priors, soc, chosen)
        found = at.fitted(range(len(chosen)), noise, at.rows(noise)).pack_pct
        steps = [np.clip(new, -3.0, 103.0) - old for new, old in zip(found, soc, strict=True)]
        if max(float(np.abs(step).max()) for step in steps) < SETTLED_PCT:
            break
        soc = [old + DAMPING * step for old, step in zip(soc, steps, strict=True)]
    return soc
