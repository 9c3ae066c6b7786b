"""Pairs of a voltage and a current, ΔU = −R·ΔI, among the fields of a capture.

For each pair the evidence is the likelihood ratio of a common variation against none, with as many
independent samples as the pair has independent moves; a copy of one quantity (an exact or
proportional one) is no evidence. To it come log priors of what such fields look like: bits, level,
usual scales, resistance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.signal import lfilter

from cangauge._typing import FloatArray
from cangauge.extras.discovery.fields import Bits, Field, Ints, Place, Selector, Stream

MOST_ROWS: Final = 4000
TREND_S: Final = 10.0
"""Width of the moving average that is taken away [s]: shorter than SoC and temperature move."""
MOVE_S: Final = 0.5
"""Time of one move [s]: the load of a car changes no faster."""
MOST_MOVES: Final = 60.0
"""Independent moves from which on a chance is excluded: two minutes of driving have as many, and
the noise of a sensor that is sent twice has more."""
LARGEST_R2: Final = 0.97
"""Polarisation within seconds leaves some of a voltage's variance without the current: a closer
relation is no further evidence of a pack."""
FEW_MOVES: Final = 4.0
"""Fewer independent moves than this may be one coincidence, such as the wake-up of all nodes."""
ALIKE: Final = 3.5
"""Largest ratio of the steps of two copies: one has at most a bit or two more."""
MANY_MOVES: Final = 20.0
"""With more independent moves than this, a voltage shows its polarisation: what follows a current
closer than COPY_R2 is the same quantity."""
COPY_R2: Final = 0.9985
RESISTANCE_OHM: Final = (0.008, 1.2)
TYPICAL_OHM: Final = 0.12
RESISTANCE_SPREAD: Final = 1.2
"""Bounds, median and log spread of a pack's resistance: 12 V starter packs to old car packs."""
VOLTAGE_SCALES: Final = {
    0.1: 0.0, 0.5: -0.3, 0.25: -0.3, 0.01: -0.3, 0.125: -1.2, 0.05: -2.0, 0.02: -2.0, 1.0: -1.0,
    2.0: -3.0,
}  # fmt: skip
CURRENT_SCALES: Final = {
    0.1: 0.0, 0.5: -0.3, 0.25: -0.5, 0.01: -0.5, 0.05: -0.5, 1.0: -1.0, 0.025: -1.0, 0.125: -1.2,
    0.02: -1.5,
}  # fmt: skip
"""Usual scales [V, A] and their log priors [nats], by their frequency in public DBC files."""
SOC_SCALES: Final = (0.1, 0.5, 0.01, 1.0, 0.05, 0.025, 0.02, 0.4)
"""Usual scales of a SoC [%]."""
SHOWN: Final = 3
LARGEST_RATIO: Final = 2.0
"""Largest ratio of the resistances by two halves of a capture: a coincidence does not repeat."""
CLEARLY_NATS: Final = 3.0
"""Distance to the second candidate that makes the first clear: a likelihood ratio of 20."""
SATURATION_NATS: Final = 20.0
"""Evidence from which on further samples count half: loads of a car are correlated."""
SIBLING: Final = 0.02
"""Largest relative difference of two voltages of one frame that are those of two cells."""
POLARISATION_S: Final = 3.0
"""Time constant with which a sustained current is seen [s]: the diffusion of lithium-ion cells
shows from seconds on, and slower parts are taken away as a trend."""
POLARISATION: Final = (0.1, 0.2, 0.4, 0.8)
"""Ratios of the resistance that grows within that time to the ohmic one: a cell's 10-s resistance
is 1.2 to 2 times that of the first 0.1 s."""
TRUSTED_NATS: Final = 10.0
SHOWN_NATS: Final = 5.0
"""Most that this test counts against a pair, as its model is not exact, and for one: cells sag as
the pack does, and finer numbers show it better."""
SAME_FRAME_NATS: Final = 4.0
"""Log prior of a pair in one frame: 5 of 7 public layouts, against one of a car's dozens of ids."""
IMPOSSIBLE: Final = -99.0


@dataclass(frozen=True)
class SignalCandidate:
    """A field that may be the wanted signal.

    Parameters
    ----------
    bus : str
    arbitration_id : int
    is_extended : bool
    length : int
        Bytes of the frame.
    place : Place
    scale, offset : float
        value = scale × raw + offset, in A, V, % or °C.
    sign : int
        −1 where positive values charge.
    low, high : float
        Range of the values.
    steps : int
        Number of changes in the capture.
    period_s : float
    not_available : int or None
        Raw code in the capture that means "no value".
    selector : Selector or None
        Multiplexer value with which the field is in the frame.
    score, evidence : float
        Log posterior and its part from the physics [nats].
    correlation, resistance_ohm : float
        With its partner; NaN where there is none.
    halves_ohm : tuple of float
        Resistance by the first and by the second half of the capture.
    capacity_ah : float
        Charge of 100 % of a SoC [Ah]; else NaN.
    partner : str
    """

    bus: str
    arbitration_id: int
    is_extended: bool
    length: int
    place: Place
    scale: float
    offset: float
    sign: int
    low: float
    high: float
    steps: int
    period_s: float
    not_available: int | None
    selector: Selector | None
    score: float
    evidence: float
    correlation: float = math.nan
    resistance_ohm: float = math.nan
    halves_ohm: tuple[float, float] = (math.nan, math.nan)
    partner: str = ""
    capacity_ah: float = math.nan

    @property
    def is_repeated(self) -> bool:
        """Whether both halves of the capture show alike resistances."""
        one, two = self.halves_ohm
        return max(one, two) <= LARGEST_RATIO * min(one, two)

    @property
    def facts(self) -> str:
        """The evidence in a phrase."""
        if self.evidence < 1.0:
            return "smooth; nothing else proves it"
        r = abs(self.correlation)
        if math.isnan(self.resistance_ohm):
            return f"falls with the charge (correlation {r:.2f}), {self.partner}"
        text = f"voltage falls when current rises: with {self.partner}, correlation {r:.2f}"
        text += f", R {self.resistance_ohm:.2g} Ω"
        return text if self.is_repeated else f"{text}, but not in both halves of the capture"

    def rescaled(self, scale: float) -> SignalCandidate:
        """Return a SoC with another scale, and the capacity that follows."""
        ratio = scale / self.scale
        capacity_ah = self.capacity_ah / ratio
        return replace(
            self,
            scale=scale,
            low=self.low * ratio,
            high=self.high * ratio,
            capacity_ah=capacity_ah,
            partner=f"{capacity_ah:.0f} Ah per 100 %",
        )

    @property
    def start(self) -> int:
        """Start bit as in a DBC."""
        return self.place.start(self.length)

    @property
    def name(self) -> str:
        """Id and bits as in a DBC, such as "0x1DB 7|11@0-"."""
        order = "0" if self.place.is_motorola else "1"
        sign = "-" if self.place.is_signed else "+"
        name = f"0x{self.arbitration_id:X} {self.start}|{self.place.width}@{order}{sign}"
        if self.selector is not None:
            name += f" m{self.selector.value}"
        return name

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "id": f"0x{self.arbitration_id:X}",
            "bus": self.bus,
            "start": self.start,
            "length": self.place.width,
            "byte_order": "motorola" if self.place.is_motorola else "intel",
            "signed": self.place.is_signed,
            "scale": self.scale,
            "offset": self.offset,
            "sign": self.sign,
            "multiplexer_value": None if self.selector is None else self.selector.value,
            "range": [self.low, self.high],
            "steps": self.steps,
            "period_s": self.period_s,
            "score": self.score,
            "evidence": self.evidence,
            "correlation": self.correlation,
            "resistance_ohm": self.resistance_ohm,
            "halves_ohm": list(self.halves_ohm),
            "partner": self.partner,
        }


Candidates = tuple[SignalCandidate, ...]
_Found = list[SignalCandidate]


@dataclass
class Row:
    """A field on the grid, as a current or as a voltage."""

    field: Field
    place: Place
    prior: float
    scale: float
    level: float
    constant: int
    missing: Bits

    @property
    def steps(self) -> int:
        """Number of changes."""
        return int(np.count_nonzero(np.diff(self.field.raw[~self.missing])))


def range_text(low: float, high: float, unit: str, sign: int = 1) -> str:
    """Return a range of values of a sign."""
    ends = sorted((sign * low + 0.0, sign * high + 0.0))
    return f"{ends[0]:.5g} … {ends[1]:.5g} {unit}".replace("-", "−")


def is_capacity(capacity_ah: float) -> bool:
    """Return whether a pack may have this capacity: of a scooter to that of a truck."""
    return 2.0 < capacity_ah < 600.0


def overlap(
    one: SignalCandidate, bits: frozenset[int], two: SignalCandidate, others: frozenset[int]
) -> bool:
    """Return whether two fields share bits of a message."""
    same = (one.bus, one.arbitration_id, one.is_extended) == (
        two.bus, two.arbitration_id, two.is_extended,
    )  # fmt: skip
    return same and bool(bits & others)


@dataclass(frozen=True)
class _Moves:
    """Fields freed of their slow part, in units of their standard deviation."""

    values: FloatArray
    std: FloatArray
    independent: FloatArray
    """Number of independent moves."""
    memory: FloatArray
    """Autocorrelation over one move."""

    @classmethod
    def of(cls, grid: FloatArray, step_s: float) -> _Moves:
        width = max(3, min(int(TREND_S / step_s), grid.shape[1] // 2))
        padded = np.pad(grid, ((0, 0), (width // 2 + 1, width - width // 2 - 1)), mode="edge")
        sums = np.cumsum(padded, axis=1)
        free = grid - (sums[:, width:] - sums[:, :-width]) / width
        bound = 5.0 * np.sqrt((free**2).mean(1, keepdims=True))
        free = np.clip(free, -bound, bound)
        free -= free.mean(1, keepdims=True)
        std = free.std(1)
        group = max(1, round(MOVE_S / step_s))
        steps = _participation(np.diff(_grouped(grid, group), axis=1))
        # One lone step moves the mean of many slots, and is still one.
        both = np.sqrt(steps * _participation(_grouped(free, group)))
        values = (free / np.maximum(std, 1e-12)[:, None]).astype(np.float32)
        memory = (values[:, group:] * values[:, :-group]).mean(1, dtype=np.float64)
        return cls(values, std, np.minimum(np.where(steps < 3.0, steps, both), MOST_MOVES), memory)


def _grouped(rows: FloatArray, group: int) -> FloatArray:
    count = rows.shape[1] // group
    return np.asarray(rows[:, : count * group].reshape(len(rows), count, group).mean(2))


def _participation(rows: FloatArray) -> FloatArray:
    """Return the number of entries that carry the squares of each row."""
    return np.asarray((rows**2).sum(1) ** 2 / np.maximum((rows**4).sum(1), 1e-12))


class Pairs:
    """All pairs of a voltage (rows) and a current (columns), with their log posterior."""

    def __init__(  # noqa: PLR0917 - made in one place
        self,
        current_grid: list[FloatArray],
        voltage_grid: list[FloatArray],
        currents: Sequence[Row],
        voltages: Sequence[Row],
        streams: Sequence[Stream],
        step_s: float,
    ) -> None:
        self._currents, self._voltages, self._streams = currents, voltages, streams
        self._current_grid, self._voltage_grid = current_grid, voltage_grid
        one, two = np.array(voltage_grid), np.array(current_grid)
        u, i = _Moves.of(one, step_s), _Moves.of(two, step_s)
        rows = one.shape[1]
        self._u, self._i = u, i
        self.r = np.asarray(u.values @ i.values.T / rows, dtype=np.float64)
        polarisation = self._polarisation(two, step_s)
        # A measured quantity dithers: several changes make one independent move.
        moves = [np.array([row.steps / 4.0 for row in rows]) for rows in (voltages, currents)]
        count = np.minimum(
            np.minimum(u.independent, moves[0])[:, None],
            np.minimum(i.independent, moves[1])[None, :],
        )
        # Bartlett (1946): what moves slowly, such as speeds, has few independent samples.
        memory = np.clip(u.memory[:, None] * i.memory[None, :], 0.0, 0.99)
        slots = rows * step_s / MOVE_S
        count = np.minimum(count, np.maximum(slots * (1.0 - memory) / (1.0 + memory), 1.0))
        evidence = _ratio(self.r, count) - 0.5 * np.log(np.maximum(count, 1.0))
        half = rows // 2
        first = _correlation(u.values[:, :half], i.values[:, :half])
        second = _correlation(u.values[:, half:], i.values[:, half:])
        agree = (np.sign(first) == np.sign(self.r)) & (np.sign(second) == np.sign(self.r))
        both = np.sqrt(_ratio(first, count / 2.0) * _ratio(second, count / 2.0))
        # A relation that only one half shows may be one coincidence, such as the wake-up.
        capped = np.minimum(evidence, 2.0 + 3.0 * np.where(agree, both, 0.0))
        evidence = np.where(count < FEW_MOVES, capped, evidence)
        evidence = np.where(self._are_copies(count), 0.0, np.maximum(evidence, 0.0))
        few = np.array([len(np.unique(row.field.raw[~row.missing])) < 4 for row in voltages])
        evidence = np.where(few[:, None], np.minimum(evidence, 2.0), evidence)
        self.slope = np.abs(self.r) * u.std[:, None] / np.maximum(i.std[None, :], 1e-9)
        scale = np.array([row.scale for row in voltages])[:, None]
        likely = np.full(self.r.shape, IMPOSSIBLE)
        self.current_scale = np.ones(self.r.shape)
        widths = np.array([row.place.width for row in currents])[None, :]
        for amps, usual in CURRENT_SCALES.items():
            prior = _resistance_prior(self.slope * scale / amps) + usual
            prior = prior - _narrow(amps * 2.0 ** (widths - 1))
            self.current_scale = np.where(prior > likely, amps, self.current_scale)
            likely = np.maximum(prior, likely)
        evidence = np.where(likely <= IMPOSSIBLE + 5.0, 0.0, evidence)
        # Without evidence the slope is chance and constrains neither scale nor resistance.
        unknown = evidence < 1.0
        likely = np.where(unknown, -1.0, np.maximum(likely, -3.0))
        guessed = [max(CURRENT_SCALES, key=lambda each: _guess(each, width)) for width in widths[0]]
        self.current_scale = np.where(unknown, np.array(guessed)[None, :], self.current_scale)
        level = np.array([row.level for row in voltages])[:, None]
        constants = np.array([float(row.constant) for row in currents])
        middle = (np.median(two, axis=1) + constants)[None, :]
        is_copy = (np.abs(self.slope * middle / level - 1.0) < 0.25) & (self.r > 0.5)
        ids = np.array([row.field.stream for row in currents])
        same = np.array([row.field.stream for row in voltages])[:, None] == ids[None, :]
        # Correlated loads (torque, power) are no independent samples: evidence saturates.
        self.evidence = SATURATION_NATS * np.log1p(evidence / SATURATION_NATS)
        self.score = (
            self.evidence
            + polarisation
            + np.array([row.prior for row in voltages])[:, None]
            + np.array([row.prior for row in currents])[None, :]
            + likely
            + np.where(same, SAME_FRAME_NATS, 0.0)
            + np.where(is_copy, IMPOSSIBLE, 0.0)
            - 1.5 * self._has_sibling(voltages)[:, None]
        )

    def _polarisation(self, current: FloatArray, step_s: float) -> FloatArray:
        """Return the evidence that the voltage sags on under a sustained current.

        U = a − R·(I + ρ·⟨I⟩), ⟨I⟩ the current through a low pass. Polarisation makes ρ > 0; torque,
        power and speed follow each other with ρ = 0. The evidence is the likelihood ratio of the
        two, where the relation is close enough to show it.
        """
        keep = math.exp(-step_s / POLARISATION_S)
        past = lfilter([1.0 - keep], [1.0, -keep], current - current[:, :1], axis=1)
        low = _Moves.of(np.asarray(past), step_s)
        rows = current.shape[1]
        with_past = np.asarray(self._u.values @ low.values.T / rows, dtype=np.float64)
        own = (self._i.values * low.values).mean(1, dtype=np.float64)
        spread = low.std / np.maximum(self._i.std, 1e-9)
        best = np.full(self.r.shape, -np.inf)
        for ratio in POLARISATION:
            share = ratio * spread
            r = self.r + share * with_past
            r /= np.sqrt(1.0 + 2.0 * share * own + share**2)
            best = np.maximum(best, r**2)
        count = rows * step_s / POLARISATION_S
        left = np.maximum(1.0 - best, 1e-6) / np.maximum(1.0 - self.r**2, 1e-6)
        return np.asarray(np.clip(-0.5 * count * np.log(left), -TRUSTED_NATS, SHOWN_NATS))

    def _has_sibling(self, voltages: Sequence[Row]) -> Bits:
        """Return which voltages are one of two in a frame: lowest and highest cell."""
        level = np.array([row.level for row in voltages])
        stream = np.array([row.field.stream for row in voltages])
        found = np.zeros(len(voltages), dtype=np.bool_)
        for number, row in enumerate(voltages):
            near = (stream == stream[number]) & (np.abs(level / level[number] - 1.0) < SIBLING)
            for other in np.flatnonzero(near).tolist():
                if other != number and not self._share_bits(row, voltages[other]):
                    both = self._u.values[number] @ self._u.values[other] / self._u.values.shape[1]
                    found[number] |= bool(both > 0.95)
        return found

    def _are_copies(self, count: FloatArray) -> Bits:
        """Return which pairs are one quantity twice: no residual but quantization."""
        lost = (1.0 - np.minimum(self.r**2, 1.0)) * self._u.std[:, None] ** 2
        # Of rounding: a twelfth of a step squared in each, the current's by the slope.
        slope = np.abs(self.r) * self._u.std[:, None] / np.maximum(self._i.std[None, :], 1e-9)
        alike = (slope > 1.0 / ALIKE) & (slope < ALIKE)
        return np.asarray(
            (self.r**2 > COPY_R2)
            & ((alike & (lost < 0.1 * (1.0 + slope**2))) | (count > MANY_MOVES))
        )

    def best(self, make: Any) -> tuple[Candidates, Candidates, Row | None]:
        """Return the best candidates for current and voltage, and the row of the first current."""
        chosen: Row | None = None
        roles: tuple[list[Row], list[Row]] = ([], [])
        found: tuple[_Found, _Found] = ([], [])
        flat = np.argsort(-self.score, axis=None)[: 200 * 200]
        for place in flat:
            a, b = divmod(int(place), self.score.shape[1])
            u, i = self._voltages[a], self._currents[b]
            if self.score[a, b] < IMPOSSIBLE / 2.0:
                break
            # A field of a better pair keeps its role.
            rivals = [
                (u, i),
                *((u, other) for other in roles[0]),
                *((i, other) for other in roles[1]),
            ]
            if any(self._share_bits(*pair) for pair in rivals):
                continue
            roles[0].append(i)
            roles[1].append(u)
            chosen = chosen or i
            self._add(found, a, b, make)
            if min(map(len, found)) >= SHOWN:
                break
        return tuple(found[0][:SHOWN]), tuple(found[1][:SHOWN]), chosen

    def _share_bits(self, one: Row, two: Row) -> bool:
        """Whether two fields share bits; a gateway repeats frames on other buses."""
        a, b = self._streams[one.field.stream], self._streams[two.field.stream]
        if (a.arbitration_id, a.is_extended) != (b.arbitration_id, b.is_extended):
            return False
        return bool(one.place.bits(a.length) & two.place.bits(b.length))

    def _add(self, pair: tuple[_Found, _Found], a: int, b: int, make: Any) -> None:
        u, i = self._voltages[a], self._currents[b]
        amps = float(self.current_scale[a, b])
        halves = self._halves(a, b)
        sign = 1 if self.r[a, b] < 0.0 else -1
        facts = {
            "score": float(self.score[a, b]),
            "evidence": float(self.evidence[a, b]),
            "correlation": float(self.r[a, b]),
            "resistance_ohm": float(self.slope[a, b]) * u.scale / amps,
            "halves_ohm": (halves[0] * u.scale / amps, halves[1] * u.scale / amps),
        }
        zero = self._zero(i)
        current = make(i, amps, -amps * zero, sign=sign, **facts)
        voltage = make(u, u.scale, 0.0, sign=1, **facts)
        for found, each, partner in zip(pair, (current, voltage), (voltage, current), strict=True):
            bits = each.place.bits(each.length)
            if not any(
                overlap(each, bits, one, one.place.bits(one.length))
                or _same_numbers(each, one)
                or _are_siblings(each, one)
                for one in found
            ):
                found.append(replace(each, partner=partner.name))

    def _halves(self, a: int, b: int) -> tuple[float, float]:
        """Return dU/dI by each half of the capture, in raw numbers; discharge gives R > 0."""
        u = self._u.values[a].astype(np.float64) * self._u.std[a]
        i = self._i.values[b].astype(np.float64) * self._i.std[b]
        half, found = len(u) // 2, []
        for part in (slice(0, half), slice(half, None)):
            y, x = u[part] - u[part].mean(), i[part] - i[part].mean()
            power = float(x @ x)
            turn = -1.0 if self.r[a, b] < 0.0 else 1.0
            found.append(turn * float(x @ y) / power if power > 0.0 else math.nan)
        return found[0], found[1]

    @staticmethod
    def _zero(row: Row) -> float:
        """Return the raw number of no current: 0 if signed, else a round one that was passed."""
        if row.place.is_signed:
            return 0.0
        good = row.field.raw[~row.missing] + row.constant
        resting = most_common(good)
        zeros = round_zeros(float(good.min()), float(good.max()), row.place.width) or [0.0]
        return min(zeros, key=lambda each: abs(each - resting))


def most_common(values: Ints) -> float:
    """Return the most common value, to a fiftieth of the range."""
    counts, edges = np.histogram(values, bins=50)
    most = int(counts.argmax())
    return float(edges[most] + edges[most + 1]) / 2.0


def round_zeros(low: float, high: float, width: int) -> list[float]:
    """Return the round raw numbers within a range that may mean no current."""
    found = [0.0] if low <= 0.05 * (high - low) else []
    found += [float(1 << bit) for bit in range(max(width - 3, 7), width)]
    if width > 10:
        found += [float(each) for each in range(500, 5000, 500)]
        found += [float(each) for each in range(5000, 65_000, 1000)]
    return [each for each in found if each == 0.0 or low - 1.0 <= each <= high + 1.0]


def _narrow(full_a: FloatArray) -> FloatArray:
    """Return the log penalty of a current's full scale [A]: cars reach 100–1000 A."""
    return np.where(full_a < 60.0, 3.0, np.where(full_a < 150.0, 1.0, 0.0))


def _guess(scale: float, width: int) -> float:
    """Return the log prior of a scale [A] for a field of this width, without evidence."""
    full_a = np.array(scale * 2.0 ** (width - 1))
    return CURRENT_SCALES[scale] - float(_narrow(full_a)) - (1.0 if full_a > 2000.0 else 0.0)


def _same_numbers(one: SignalCandidate, two: SignalCandidate) -> bool:
    return (one.arbitration_id, one.start, one.place.width, one.place.is_motorola) == (
        two.arbitration_id, two.start, two.place.width, two.place.is_motorola,
    )  # fmt: skip


def _are_siblings(one: SignalCandidate, two: SignalCandidate) -> bool:
    """Whether two candidates are cells in one message: raw numbers alike, but for cut bits."""
    same = (one.bus, one.arbitration_id) == (two.bus, two.arbitration_id)
    middles = [(each.low + each.high) / 2.0 / each.scale for each in (one, two)]
    if not same or min(one.low, two.low) <= 0.0:
        return False
    octaves = math.log2(middles[0] / middles[1])
    return abs(octaves - round(octaves)) < SIBLING


def _ratio(r: FloatArray, count: FloatArray) -> FloatArray:
    """Return the log likelihood ratio of a correlation against none."""
    return np.asarray(-0.5 * count * np.log(1.0 - np.minimum(r**2, LARGEST_R2)))


def _correlation(one: FloatArray, two: FloatArray) -> FloatArray:
    """Return the correlations within a part; 0 for rows that hardly move in it."""
    parts = []
    for each in (one, two):
        free = each - each.mean(1, keepdims=True)
        std = free.std(1)
        parts.append(np.where(std > 0.02, 1.0 / np.maximum(std, 1e-9), 0.0)[:, None] * free)
    return np.asarray(parts[0] @ parts[1].T / one.shape[1], dtype=np.float64)


def _resistance_prior(ohm: FloatArray) -> FloatArray:
    low, high = RESISTANCE_OHM
    distance = np.log(np.maximum(ohm, 1e-12) / TYPICAL_OHM) / RESISTANCE_SPREAD
    return np.asarray(np.where((ohm < low) | (ohm > high), IMPOSSIBLE, -0.5 * distance**2))
