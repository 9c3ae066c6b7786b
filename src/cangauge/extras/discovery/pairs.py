"""Pairs of a voltage and a current, ΔU = −R·ΔI, among the fields of a capture.

For each pair the evidence is the likelihood ratio of a common variation against none, with as many
independent samples as the pair has independent moves; a copy of one quantity (an exact or
proportional one) is no evidence. To it come log priors of what such fields look like: bits, level,
usual scales, resistance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.extras.discovery.candidate import MOST_A, SHOWN, Candidate
from cangauge.extras.discovery.rows import Grid, Row, zero_of

CURRENT_SCALES: Final = {
    0.1: 0.0,
    0.5: -0.3,
    0.25: -0.5,
    0.01: -0.5,
    0.05: -0.5,
    1.0: -1.0,
    0.025: -1.0,
    0.125: -1.2,
    0.02: -1.5,
}
"""Usual scales [A] and their log priors [nats], by their frequency in public DBC files."""
MOVE_S: Final = 0.5
"""Time of one move [s]: the load of a car changes no faster."""
LARGEST_R2: Final = 0.97
"""Polarisation within seconds leaves some of a voltage's variance without the current: a closer
relation is no further evidence of a pack."""
POLARISATION_S: Final = 3.0
"""Time constant with which a sustained current is seen [s]: the diffusion of lithium-ion cells
shows from seconds on, and slower parts are taken away as a trend."""
IMPOSSIBLE: Final = -99.0


class _Moves:
    """Rows on a grid, freed of their slow part, in units of their standard deviation.

    Parameters
    ----------
    rows : sequence of Row
    level : array (m, n)
        Raw numbers on the grid.
    step_s : float
        Step of the grid [s].

    Attributes
    ----------
    values : array (m, n)
        Raw numbers freed of their slow part.
    std : array (m,)
    independent : array (m,)
        Number of independent moves.
    memory : array (m,)
        Autocorrelation over one move.
    """

    def __init__(self, rows: Sequence[Row], level: FloatArray, step_s: float) -> None:
        self.rows, self.level = rows, level
        # The trend over 10 s: SoC and temperature move more slowly.
        width = max(3, min(int(10.0 / step_s), level.shape[1] // 2))
        free = level - uniform_filter1d(level, width, axis=1, mode="nearest")
        bound = 5.0 * np.sqrt((free**2).mean(1, keepdims=True))
        free = np.clip(free, -bound, bound)
        free -= free.mean(1, keepdims=True)
        self.std = free.std(1)
        group = max(1, round(MOVE_S / step_s))
        # One lone step moves the mean of many slots, and is still one.
        moves = np.sqrt(
            _participation(np.diff(_grouped(level, group), axis=1))
            * _participation(_grouped(free, group))
        )
        values = (free / np.maximum(self.std, 1e-12)[:, None]).astype(np.float32)
        self.values = values
        self.memory = (values[:, group:] * values[:, :-group]).mean(1, dtype=np.float64)
        # A measured quantity dithers: several changes make one independent move. From 60 on a
        # chance is excluded: two minutes of driving have as many, and the noise of a sensor that
        # is sent twice has more.
        most = np.minimum(60.0, [row.steps / 4.0 for row in rows])
        self.independent = np.minimum(moves, most)


def _grouped(rows: FloatArray, group: int) -> FloatArray:
    count = rows.shape[1] // group
    return np.asarray(rows[:, : count * group].reshape(len(rows), count, group).mean(2))


def _participation(rows: FloatArray) -> FloatArray:
    """Return the number of entries that carry the squares of each row."""
    return np.asarray((rows**2).sum(1) ** 2 / np.maximum((rows**4).sum(1), 1e-12))


class _Pairs:
    """All pairs of a voltage (rows) and a current (columns).

    Parameters
    ----------
    u, i : _Moves
        Of the m voltages and of the n currents.
    step_s : float
        Step of their grid [s].

    Attributes
    ----------
    r, slope : array (m, n)
        Correlation of their moves, and |dU/dI| in raw numbers.
    evidence, score : array (m, n)
        Log likelihood ratio of a common variation against none, and log posterior [nats].
    amps : array (m, n)
        Likeliest scale of the current [A].
    """

    def __init__(self, u: _Moves, i: _Moves, step_s: float) -> None:
        self.u, self.i = u, i
        self.r = r = _product(u.values, i.values)
        self.slope = slope = np.abs(r) * u.std[:, None] / np.maximum(i.std, 1e-9)
        evidence = _evidence(u, i, r, slope, step_s)
        is_impossible = _is_copy(u, i, r, slope) | _sags_too_far(u, i, slope, evidence)
        likely, self.amps = _scales(u, i, slope, evidence >= 1.0)
        self.evidence = np.where(likely > IMPOSSIBLE / 2.0, evidence, 0.0)
        self.score = (
            self.evidence
            + _polarisation(u, i, r, step_s)
            + np.array([row.prior for row in u.rows])[:, None]
            + np.array([row.prior for row in i.rows])
            + np.maximum(likely, -3.0)
            # One frame holds both in 5 of 7 public layouts, against one of a car's dozens of ids.
            + 4.0 * (_streams(u)[:, None] == _streams(i))
            - 1.5 * _has_sibling(u)[:, None]
        )
        self.score[is_impossible] = IMPOSSIBLE

    def ranked(self) -> Iterator[tuple[int, int]]:
        """Yield voltage and current of the possible pairs, best first; each bit keeps its role."""
        of_voltages: set[Any] = set()
        of_currents: set[Any] = set()
        for place in np.argsort(-self.score, axis=None)[: 200 * 200].tolist():
            a, b = divmod(place, len(self.i.rows))
            if self.score[a, b] < IMPOSSIBLE / 2.0:
                return
            voltage, current = self.u.rows[a].bits, self.i.rows[b].bits
            if not (voltage & (current | of_currents) or current & of_voltages):
                of_voltages |= voltage
                of_currents |= current
                yield a, b

    def candidates(self, a: int, b: int) -> tuple[Candidate, Candidate]:
        """Return the current and the voltage of a pair."""
        voltage, current = self.u.rows[a], self.i.rows[b]
        scale_v, scale_a = voltage.levels[0].scale, float(self.amps[a, b])
        facts = {
            "score": float(self.score[a, b]),
            "evidence": float(self.evidence[a, b]),
            "correlation": float(self.r[a, b]),
            "resistance_ohm": float(self.slope[a, b]) * scale_v / scale_a,
            "halves_ohm": tuple(half * scale_v / scale_a for half in self._halves(a, b)),
        }
        return (
            current.candidate(
                "current",
                scale_a,
                -scale_a * zero_of(current),
                sign=1 if self.r[a, b] < 0.0 else -1,
                partner=voltage.name,
                **facts,
            ),
            voltage.candidate("voltage", scale_v, 0.0, partner=current.name, **facts),
        )

    def _halves(self, a: int, b: int) -> list[float]:
        """Return R by each half of the capture, in raw numbers, positive as in the whole."""
        volts, amps = self.u.values[a], self.i.values[b]
        whole = math.copysign(float(self.u.std[a] / self.i.std[b]), float(volts @ amps))
        found = []
        for half in zip(np.array_split(volts, 2), np.array_split(amps, 2), strict=True):
            (_, both), (_, power) = np.cov(*half, dtype=np.float64)
            found.append(whole * float(both / power) if power else math.nan)
        return found


def best_pairs(
    voltages: Sequence[Row], currents: Sequence[Row], grid: Grid
) -> tuple[list[Candidate], list[Candidate], Row | None]:
    """Return the best candidates for current and voltage, and the row of the first current."""
    u, i = (
        _Moves(rows, np.array([row.means_on(grid) for row in rows]), grid.step_s)
        for rows in (voltages, currents)
    )
    pairs = _Pairs(u, i, grid.step_s)
    found: tuple[list[Candidate], list[Candidate]] = ([], [])
    chosen: Row | None = None
    for a, b in pairs.ranked():
        chosen = chosen or currents[b]
        for kept, new in zip(found, pairs.candidates(a, b), strict=True):
            if not any(new.bits & each.bits or _are_siblings(new, each) for each in kept):
                kept.append(new)
        if min(map(len, found)) >= SHOWN:
            break
    return found[0][:SHOWN], found[1][:SHOWN], chosen


def _is_copy(u: _Moves, i: _Moves, r: FloatArray, slope: FloatArray) -> BoolArray:
    """Return which pairs are one quantity twice: proportional, level and moves alike."""
    middle_u, middle_i = (np.median(each.level, axis=1) for each in (u, i))
    return np.asarray((np.abs(slope * middle_i / middle_u[:, None] - 1.0) < 0.25) & (r > 0.5))


def _sags_too_far(u: _Moves, i: _Moves, slope: FloatArray, evidence: FloatArray) -> BoolArray:
    """Return which voltages fall by over a fifth: inverters switch off a pack before."""
    away = np.array([row.away for row in i.rows])
    middle = np.median(u.level, axis=1)[:, None]
    return np.asarray((slope * away > 0.2 * middle) & (evidence >= 1.0))


def _streams(of: _Moves) -> IntArray:
    return np.array([id(row.field.stream) for row in of.rows])


def _scales(
    u: _Moves, i: _Moves, slope: FloatArray, is_known: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the log prior of each pair's resistance, and the current's scale [A] that gives it.

    Where the slope is not known it is chance, and constrains neither.
    """
    volts = np.array([row.levels[0].scale for row in u.rows])[:, None]
    full = 2.0 ** (np.array([row.place.width for row in i.rows]) - 1)
    away = np.array([row.away for row in i.rows])
    likely, best = np.full(slope.shape, IMPOSSIBLE), np.ones(slope.shape)
    for amps, usual in CURRENT_SCALES.items():
        ohm = np.where(is_known, slope * volts / amps, 0.12)
        # From 12 V starter packs to old car packs.
        prior = usual - 0.5 * (np.log(np.maximum(ohm, 1e-12) / 0.12) / 1.2) ** 2
        # Cars reach 100–1000 A.
        prior = prior - np.select([amps * full < 60.0, amps * full < 150.0], [3.0, 1.0])
        prior = np.where((ohm < 0.008) | (ohm > 1.2) | (amps * away > MOST_A), IMPOSSIBLE, prior)
        best = np.where(prior > likely, amps, best)
        likely = np.maximum(prior, likely)
    return likely, best


def _evidence(u: _Moves, i: _Moves, r: FloatArray, slope: FloatArray, step_s: float) -> FloatArray:
    """Return the log likelihood ratio of a common variation against none."""
    count = np.minimum(u.independent[:, None], i.independent)
    # Bartlett (1946): what moves slowly, such as speeds, has few independent samples.
    memory = np.clip(u.memory[:, None] * i.memory, 0.0, 0.99)
    slots = u.level.shape[1] * step_s / MOVE_S
    count = np.minimum(count, np.maximum(slots * (1.0 - memory) / (1.0 + memory), 1.0))
    evidence = -0.5 * count * np.log(1.0 - np.minimum(r**2, LARGEST_R2))
    evidence = np.maximum(evidence - 0.5 * np.log(np.maximum(count, 1.0)), 0.0)
    # Few levels of a voltage that rests are crossed by chance.
    few = np.array([len(np.unique(row.values)) < 4 for row in u.rows])
    evidence[few] = np.minimum(evidence[few], 2.0)
    # One quantity twice has no residual but quantization. Two roundings of one number differ by a
    # sixth of a step squared on average, by a quarter where they are half a step apart; one has at
    # most a bit or two more.
    lost = (1.0 - np.minimum(r**2, 1.0)) * u.std[:, None] ** 2
    u_step = np.array([row.field.step for row in u.rows])[:, None]
    i_step = slope * np.array([row.field.step for row in i.rows])
    alike = (i_step > u_step / 3.5) & (i_step < u_step * 3.5)
    is_rounded = alike & (lost < 0.15 * (u_step**2 + i_step**2))
    # In many moves a voltage shows its polarisation: what follows closer is the same quantity.
    evidence[is_rounded | ((r**2 > 0.9985) & (count > 20.0))] = 0.0
    # Loads are correlated (torque, power): from 20 nats on further samples count half.
    return np.asarray(20.0 * np.log1p(evidence / 20.0))


def _polarisation(u: _Moves, i: _Moves, r: FloatArray, step_s: float) -> FloatArray:
    """Return the evidence that the voltage sags on under a sustained current.

    U = a − R·(I + ρ·⟨I⟩), ⟨I⟩ the current through a low pass. Polarisation makes ρ > 0; torque,
    power and speed follow each other with ρ = 0. The evidence is the likelihood ratio of the
    two, where the relation is close enough to show it.
    """
    keep = math.exp(-step_s / POLARISATION_S)
    past = lfilter([1.0 - keep], [1.0, -keep], i.level - i.level[:, :1], axis=1)
    low = _Moves(i.rows, np.asarray(past), step_s)
    with_past = _product(u.values, low.values)
    own = (i.values * low.values).mean(1, dtype=np.float64)
    spread = low.std / np.maximum(i.std, 1e-9)
    best = np.zeros(r.shape)
    # A cell's 10-s resistance is 1.2 to 2 times that of the first 0.1 s.
    for ratio in (0.1, 0.2, 0.4, 0.8):
        share = ratio * spread
        both = (r + share * with_past) ** 2 / (1.0 + 2.0 * share * own + share**2)
        best = np.maximum(best, both)
    count = u.level.shape[1] * step_s / POLARISATION_S
    left = np.maximum(1.0 - best, 1e-6) / np.maximum(1.0 - r**2, 1e-6)
    # Bounded: the model is not exact, and cells sag as the pack does, in finer numbers.
    return np.asarray(np.clip(-0.5 * count * np.log(left), -10.0, 5.0))


def _has_sibling(u: _Moves) -> BoolArray:
    """Return which voltages are one of two in a frame: lowest and highest cell."""
    stream, level = _streams(u), np.median(u.level, axis=1)
    found = np.zeros(len(level), dtype=np.bool_)
    for number, row in enumerate(u.rows):
        near = (stream == stream[number]) & (np.abs(level / level[number] - 1.0) < 0.02)
        for other in np.flatnonzero(near).tolist():
            if not row.bits & u.rows[other].bits:
                found[number] |= bool((u.values[number] * u.values[other]).mean() > 0.95)
    return found


def _are_siblings(one: Candidate, two: Candidate) -> bool:
    """Return whether two candidates are cells in one message: alike, but for cut bits."""
    middles = [(each.low + each.high) / 2.0 / each.scale for each in (one, two)]
    if one.message != two.message or min(one.low, two.low) <= 0.0:
        return False
    octaves = math.log2(middles[0] / middles[1])
    return abs(octaves - round(octaves)) < 0.02


def _product(one: FloatArray, two: FloatArray) -> FloatArray:
    """Return the mean products of rows."""
    return np.asarray(one @ two.T / one.shape[1], dtype=np.float64)
