"""Current and voltage of a pack among the fields of a capture: the pair with ΔU = −R·ΔI.

Every field is averaged on one grid of time and freed of its slow part. For each pair the evidence
is the likelihood ratio of a common variation against none, with as many independent samples as the
pair has independent moves; a copy of one quantity (an exact or proportional one) is no evidence.
To it come log priors of what such fields look like: bits, level, usual scales, resistance.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import can
import numpy as np

from cangauge._typing import FloatArray
from cangauge.discovery.fields import Bits, Field, Ints, Place, Selector, Stream, collect, fields_of
from cangauge.errors import InputError

_LOG = logging.getLogger(__name__)

GRID_S: Final = 0.1
"""Interval of the grid [s]: pack messages come every 10–100 ms."""
MOST_ROWS: Final = 4000
TREND_S: Final = 10.0
"""Width of the moving average that is taken away [s]: shorter than SoC and temperature move."""
MOVE_S: Final = 0.5
"""Time of one move [s]: the load of a car changes no faster."""
LARGEST_R2: Final = 0.998
"""Polarisation and quantization leave some of a voltage's variance without the current."""
FEW_MOVES: Final = 4.0
"""Fewer independent moves than this may be one coincidence, such as the wake-up of all nodes."""
ALIKE: Final = 3.5
"""Largest ratio of the steps of two copies: one has at most a bit or two more."""
MANY_MOVES: Final = 20.0
"""With more independent moves than this, a voltage without any residual is not taken for a copy."""
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
MOST_CURRENTS: Final = 4000
MOST_VOLTAGES: Final = 1500
"""Most fields whose pairs are tried: 50 MB for each of a dozen quantities."""
SHOWN: Final = 3
CLEARLY_NATS: Final = 3.0
"""Distance to the second candidate that makes the first clear: a likelihood ratio of 20."""
ENOUGH_NATS: Final = 3.0
"""Evidence from current steps that is needed to decide without the user: as above."""
SATURATION_NATS: Final = 20.0
"""Evidence from which on further samples count half: loads of a car are correlated."""
SIBLING: Final = 0.02
"""Largest relative difference of two voltages of one frame that are those of two cells."""
RIVAL: Final = 0.6
"""Share of the first candidate's evidence with which another leaves the choice to the user: the
evidence of loads that hang together differs by less than its saturation."""
ENOUGH_STEPS: Final = 50
LARGEST_RATIO: Final = 2.0
"""Fewest changes of a field that is taken without the user, and largest ratio of the resistances by
the two halves of the capture: a coincidence does not repeat."""
_IMPOSSIBLE: Final = -99.0


@dataclass(frozen=True)
class Candidate:
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
        Raw code in the capture that stands for no value.
    selector : Selector or None
        Multiplexer value with which the field is in the frame.
    score, evidence : float
        Log posterior and its part from the physics [nats].
    correlation, resistance_ohm : float
        With its partner; NaN where there is none.
    halves_ohm : tuple of float
        Resistance by the first and by the second half of the capture.
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


@dataclass(frozen=True)
class Findings:
    """Candidates by role, best first, and what the capture cannot show.

    Parameters
    ----------
    current, voltage, soc_reference, temperature : tuple of Candidate
    remarks : tuple of str
    streams, fields : int
        Number of ids and of numbers looked at.
    duration_s : float
    """

    current: tuple[Candidate, ...]
    voltage: tuple[Candidate, ...]
    soc_reference: tuple[Candidate, ...]
    temperature: tuple[Candidate, ...]
    remarks: tuple[str, ...]
    streams: int
    fields: int
    duration_s: float

    def is_clear(self, role: str) -> bool:
        """Whether the first candidate is certain enough to be taken without the user."""
        found: tuple[Candidate, ...] = getattr(self, role)
        if not found or found[0].evidence < ENOUGH_NATS or found[0].steps < ENOUGH_STEPS:
            return False
        one, two = found[0].halves_ohm
        if not max(one, two) <= LARGEST_RATIO * min(one, two):
            return False
        if any(each.evidence > RIVAL * found[0].evidence for each in found[1:]):
            return False  # the inverter's pair and the pack's: physics does not tell them apart
        return len(found) == 1 or found[0].score - found[1].score >= CLEARLY_NATS


@dataclass
class _Row:
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


def search(messages: Iterable[can.Message]) -> Findings:
    """Find current, voltage, SoC and temperature in the frames of a capture.

    Raises
    ------
    InputError
        If no id has enough frames.
    """
    streams = collect(messages)
    if not streams:
        raise InputError(
            "no id has enough frames to search", cure="record at least a minute, while driving"
        )
    fields: list[Field] = []
    for index, stream in enumerate(streams):
        _LOG.debug("id %d of %d: %s", index + 1, len(streams), stream.name)
        fields += fields_of(index, stream)
    return _Search(streams, fields).findings()


class _Search:
    def __init__(self, streams: Sequence[Stream], fields: Sequence[Field]) -> None:
        self._streams = streams
        self._fields = fields
        start_s = min(float(each.time_s[0]) for each in streams)
        end_s = max(float(each.time_s[-1]) for each in streams)
        self._duration_s = end_s - start_s
        self._step_s = max(GRID_S, self._duration_s / MOST_ROWS)
        rows = max(int(self._duration_s / self._step_s), 4)
        self._edges = start_s + self._step_s * np.arange(rows + 1)
        self._slots = [
            np.clip(np.searchsorted(self._edges, each.time_s, "right") - 1, 0, rows - 1)
            for each in streams
        ]
        self._statistics = [_Statistics.of(each) for each in fields]

    def findings(self) -> Findings:
        currents = [row for each in range(len(self._fields)) if (row := self._as_current(each))]
        voltages = [row for each in range(len(self._fields)) if (row := self._as_voltage(each))]
        voltages += self._constant_voltages(currents)
        # All pairs are held in memory: of the largest buses, the likelier fields.
        currents = sorted(currents, key=lambda row: -row.prior)[:MOST_CURRENTS]
        voltages = sorted(voltages, key=lambda row: -row.prior)[:MOST_VOLTAGES]
        remarks: list[str] = []
        if not currents or not voltages:
            remarks.append("no field of this capture can be the current or the voltage of a pack")
            return self._result((), (), (), (), remarks)
        pairs = _Pairs(
            [self._grid(row) for row in currents],
            [self._grid(row) for row in voltages],
            currents,
            voltages,
            self._streams,
            self._step_s,
        )
        current, voltage, row = pairs.best(self._candidate)
        if not current or current[0].evidence < ENOUGH_NATS:
            remarks.append(
                "no current steps in this capture that a voltage follows: the candidates rest on"
                " the look of their bits alone; record while driving"
            )
        taken = [(each, each.place.bits(each.length)) for each in (*current[:1], *voltage[:1])]
        soc: tuple[Candidate, ...] = ()
        if row is not None:
            soc = self._charges(current[0], row)
        if not soc:
            remarks.append("no field falls with the charge: record a longer drive to find the SoC")
        temperature = self._temperatures(taken)
        if not temperature:
            remarks.append("no slow field looks like a temperature")
        return self._result(current, voltage, soc, temperature, remarks)

    def _result(
        self,
        current: tuple[Candidate, ...],
        voltage: tuple[Candidate, ...],
        soc: tuple[Candidate, ...],
        temperature: tuple[Candidate, ...],
        remarks: list[str],
    ) -> Findings:
        return Findings(
            current, voltage, soc, temperature, tuple(remarks), len(self._streams),
            len(self._fields), self._duration_s,
        )  # fmt: skip

    def _rate_prior(self, stream: Stream) -> float:
        """Return the log prior of a period: pack messages are fast."""
        period_s = stream.period_s
        if period_s <= 0.11:
            return 0.8 if period_s <= 0.025 else 0.4
        return 0.0 if period_s < 0.3 else -1.0

    def _as_current(self, index: int) -> _Row | None:
        field, seen = self._fields[index], self._statistics[index]
        best = max(field.extensions, key=lambda each: each[1])
        full = 1 << best[0].width
        if not field.place.is_signed and seen.low + best[2] >= 0.9 * full:
            # Nearly all ones: a small negative number.
            best = (replace(best[0], is_signed=True), best[1], best[2] - full)
        prior = best[1] + self._rate_prior(self._streams[field.stream]) + seen.prior
        if field.place.is_signed and seen.low < 0.0 <= seen.high:
            # A measured current at rest hovers around zero, …
            widest = max(-seen.low, seen.high)
            prior += 1.0 if widest < 1 << (best[0].width - 2) else 0.0
        elif not best[0].is_signed:
            # … which an unsigned field holds as a round number.
            low, high = seen.low + best[2], seen.high + best[2]
            zeros = _round_zeros(low, high, best[0].width)
            rest = min((abs(each - seen.resting - best[2]) for each in zeros), default=math.inf)
            if any(each and math.log2(each).is_integer() for each in zeros):
                prior += 1.0
            prior -= 5.0 if not zeros else 1.0 if rest > 0.15 * (high - low) else 0.0
        if seen.count < 3 and not field.place.is_signed:
            return None
        return _Row(field, best[0], prior, 1.0, seen.median, best[2], field.missing)

    def _as_voltage(self, index: int) -> _Row | None:
        field, seen = self._fields[index], self._statistics[index]
        if field.place.is_signed:
            return None
        rate = self._rate_prior(self._streams[field.stream])
        best: _Row | None = None
        zero = (field.raw == 0) & ~field.missing
        for place, nature, constant in field.extensions:
            missing = field.missing
            if constant == 0 and zero.any():
                missing = missing | zero  # before the contactors close
            good = field.raw[~missing]
            if len(good) < 0.3 * len(field.raw):
                continue
            low, level, high = np.percentile(good, [2.0, 50.0, 98.0]) + constant
            if low <= 0.0 or (high - low) / level > 0.5:
                continue
            if level > 0.95 * (1 << place.width):
                continue  # nearly all ones: a small negative number
            for scale, usual in VOLTAGE_SCALES.items():
                likely = _level_prior(level * scale)
                prior = nature + rate + seen.prior + usual + likely
                prior += _full_scale_prior(scale, place.width)
                if likely > _IMPOSSIBLE and (best is None or prior > best.prior):
                    best = _Row(field, place, prior, scale, level, constant, missing)
        return best

    def _constant_voltages(self, currents: Sequence[_Row]) -> list[_Row]:
        """Return constant fields beside a likely current: a pack at rest keeps its voltage."""
        likely = sorted(currents, key=lambda row: -row.prior)[:20]
        rows = []
        for index in dict.fromkeys(row.field.stream for row in likely):
            stream = self._streams[index]
            if stream.period_s > 0.11:
                continue
            rows += _constants(index, stream, self._rate_prior(stream))
        return rows

    def _grid(self, row: _Row) -> FloatArray:
        """Return the mean of a field by slot of the grid; empty slots keep the last value."""
        rows, good = len(self._edges) - 1, ~row.missing
        slots = self._slots[row.field.stream][good]
        counts = np.bincount(slots, minlength=rows)
        sums = np.bincount(slots, weights=row.field.raw[good], minlength=rows)
        filled = counts > 0
        last = np.maximum.accumulate(np.where(filled, np.arange(rows), -1))
        last[last < 0] = int(np.flatnonzero(filled)[0])
        means = np.zeros(rows)
        means[filled] = sums[filled] / counts[filled]
        return np.asarray(means[last])

    def _candidate(self, row: _Row, scale: float, offset: float, **more: Any) -> Candidate:
        stream = self._streams[row.field.stream]
        good = row.field.raw[~row.missing] + row.constant
        ends = scale * np.array([good.min(), good.max()], dtype=np.float64) + offset
        gone = row.field.missing & (row.field.raw != 0)
        code: int | None = None
        if gone.any():
            width = row.place.width
            code = (1 << width) - 1
            if row.place.is_signed:
                code = int(np.bincount(row.field.raw[gone] & code).argmax())
                code -= (1 << width) if code >> (width - 1) else 0
        return Candidate(
            bus=stream.bus,
            arbitration_id=stream.arbitration_id,
            is_extended=stream.is_extended,
            length=stream.length,
            place=row.place,
            scale=scale,
            offset=offset,
            low=float(ends.min()),
            high=float(ends.max()),
            steps=int(np.count_nonzero(np.diff(row.field.raw[~row.missing]))),
            period_s=stream.period_s,
            not_available=code,
            selector=stream.selector,
            **more,
        )

    def _charges(self, current: Candidate, row: _Row) -> tuple[Candidate, ...]:
        """Return fields that fall as the current is drawn."""
        amps = current.scale * (self._grid(row) + row.constant) + current.offset
        amps *= current.sign
        drawn_ah = np.cumsum(amps) * self._step_s / 3600.0
        found = []
        for index, each in enumerate(self._fields):
            seen = self._statistics[index]
            if each.place.is_signed or seen.count < 4:
                continue
            made = self._as_charge(each, drawn_ah)
            if made is not None:
                found.append(made)
        return _apart(found)[:SHOWN]

    def _as_charge(self, field: Field, drawn_ah: FloatArray) -> Candidate | None:
        best = None
        for place, nature, constant in field.extensions:
            row = _Row(field, place, 0.0, 1.0, 0.0, constant, field.missing)
            values = self._grid(row) + constant
            spread, moved = float(np.std(values)), float(np.std(drawn_ah))
            if spread == 0.0 or moved == 0.0:
                continue
            r = float(np.mean((values - values.mean()) * (drawn_ah - drawn_ah.mean())))
            r /= spread * moved
            if r > -0.95:
                continue
            per_ah = spread / moved
            for scale in (0.1, 0.5, 0.01, 1.0, 0.05, 0.025, 0.02, 0.4):
                level = values * scale
                capacity_ah = 100.0 / (per_ah * scale)
                if not (level.min() > 0.0 and level.max() <= 101.0 and 2.0 < capacity_ah < 600.0):
                    continue
                full = (1 << place.width) * scale
                prior = nature - 0.5 * (math.log(capacity_ah / 90.0) / 0.8) ** 2
                prior -= 0.0 if full <= 300.0 or scale <= 0.02 else 0.5
                events = float(self._statistics_of(field).count)
                evidence = -0.5 * events * math.log(1.0 - min(r * r, LARGEST_R2))
                if best is None or prior + evidence > best.score:
                    best = self._candidate(
                        row, scale, 0.0, sign=1, score=prior + evidence, evidence=evidence,
                        correlation=r, partner=f"{capacity_ah:.0f} Ah per 100 %",
                    )  # fmt: skip
        return best

    def _statistics_of(self, field: Field) -> _Statistics:
        return _Statistics.of(field)

    def _temperatures(
        self, taken: Sequence[tuple[Candidate, frozenset[int]]]
    ) -> tuple[Candidate, ...]:
        """Return slow fields in a plausible range, those of the pack's bus first."""
        buses = {each.bus for each, _ in taken}
        found = []
        for index, field in enumerate(self._fields):
            seen, stream = self._statistics[index], self._streams[field.stream]
            if seen.count > 12 or seen.largest_step > 4.0 or seen.steps > 0.1 * len(field.raw) + 4:
                continue
            for place, nature, constant in field.extensions:
                for scale, offset, usual in (
                    (1.0, -40.0, 0.0), (0.5, -40.0, -0.3), (1.0, 0.0, -0.7), (1.0, -50.0, -0.7),
                    (0.1, 0.0, -0.7), (0.1, -40.0, -1.5),
                ):  # fmt: skip
                    ends = scale * (np.array([seen.low, seen.high]) + constant) + offset
                    if ends.min() < -20.0 or ends.max() > 50.0 or (scale < 1.0 and place.width < 8):
                        continue
                    if place.is_signed and offset != 0.0:
                        continue
                    drift = ends.max() - ends.min()
                    prior = nature + usual + (0.5 if stream.bus in buses else 0.0) - 0.2 * drift
                    prior -= 0.5 * ((ends.mean() - 20.0) / 15.0) ** 2
                    prior -= 1.0 if place.width > 8 and scale == 1.0 else 0.0
                    row = _Row(field, place, 0.0, 1.0, 0.0, constant, field.missing)
                    candidate = self._candidate(
                        row, scale, offset, sign=1, score=prior, evidence=0.0
                    )
                    bits = place.bits(stream.length)
                    if not any(_overlap(candidate, bits, other, b) for other, b in taken):
                        found.append(candidate)
        return _apart(found)[:SHOWN]


@dataclass(frozen=True)
class _Statistics:
    """Values of a field, with the log prior of a measurement."""

    median: float
    low: float
    high: float
    count: int
    steps: int
    largest_step: float
    resting: float
    prior: float

    @classmethod
    def of(cls, field: Field) -> _Statistics:
        good = field.raw[~field.missing]
        values = np.unique(good)
        change = np.diff(good)
        steps = int(np.count_nonzero(change))
        count, low, high = len(values), float(values[0]), float(values[-1])
        filled = count / min(high - low + 1.0, len(good) / 4.0 + 1.0)
        both_ways = min(int((change > 0).sum()), int((change < 0).sum())) > 2
        # A measurement moves up and down through neighbouring values; states jump between few.
        prior = 1.5 if steps >= 8 and count >= 3 and filled > 0.5 and both_ways else 0.0
        prior -= 2.0 if count < 3 else 1.5 if filled < 0.2 else 0.0
        largest = float(np.abs(change).max(initial=0))
        return cls(
            float(np.median(good)), low, high, count, steps, largest, _most_common(good), prior
        )


def _level_prior(volts: float) -> float:
    """Return the log prior of a pack's voltage [nats]: most cars have 250–450 V."""
    if 250.0 <= volts <= 450.0:
        return 0.0
    if 450.0 < volts <= 900.0:
        return -1.2
    if 100.0 <= volts < 250.0:
        return -1.5
    return -2.2 if 30.0 <= volts < 100.0 else _IMPOSSIBLE


def _full_scale_prior(scale: float, width: int) -> float:
    """Return the log prior of a voltage's full scale [nats]: not far beyond a pack's voltage."""
    full = scale * (1 << width)
    if 380.0 <= full <= 1400.0:
        return 0.0
    if full > 1400.0:
        return -0.3 if scale <= 0.1 else -2.0
    return -1.0


def _constants(  # noqa: C901 - one walk over the places
    index: int, stream: Stream, rate: float
) -> list[_Row]:
    """Return constant fields at the voltage of a car's pack."""
    rows = []
    bits = np.unpackbits(stream.payload, axis=1)
    # Wake-up codes: judged by the second half of the frames.
    later = bits[len(bits) // 2 :]
    still = (later == later[0]).all(0)
    length = stream.length
    for is_motorola in (True, False):
        for first in range(0, 8 * length, 4):
            for width in (10, 12, 16) if is_motorola else (12, 16):
                last = first + width - 1
                if last >= 8 * length or (not is_motorola and last % 8 != 7):
                    continue
                if is_motorola and first % 8 and width != 12:
                    continue
                place = Place(is_motorola, first, last, is_signed=False)
                where = np.arange(first, last + 1)
                if not is_motorola:
                    where = 8 * (length - 1 - where // 8) + where % 8
                if not still[where].all():
                    continue
                weights = 1 << np.arange(width - 1, -1, -1)
                raw = (bits[:, where] @ weights).astype(np.int32)
                level = float(raw[-1])
                if level > 0.95 * (1 << width):
                    continue
                missing = np.asarray(raw != raw[-1])
                for scale, usual in VOLTAGE_SCALES.items():
                    likely = _level_prior(level * scale)
                    if likely < 0.0:
                        continue
                    prior = rate + usual + _full_scale_prior(scale, width) - 0.5
                    prior += {16: 0.6, 12: 0.4, 10: 0.2}[width]
                    rows.append(
                        _Row(Field(index, place, raw, missing, 0.0), place, prior, scale, level, 0,
                             missing)
                    )  # fmt: skip
    return rows


def _overlap(one: Candidate, bits: frozenset[int], two: Candidate, others: frozenset[int]) -> bool:
    same = (one.bus, one.arbitration_id, one.is_extended) == (
        two.bus, two.arbitration_id, two.is_extended,
    )  # fmt: skip
    return same and bool(bits & others)


def _apart(found: list[Candidate]) -> tuple[Candidate, ...]:
    """Return candidates, best first, without those that share bits with a better one."""
    kept: list[tuple[Candidate, frozenset[int]]] = []
    for each in sorted(found, key=lambda one: -one.score):
        bits = each.place.bits(each.length)
        if not any(_overlap(each, bits, other, taken) for other, taken in kept):
            kept.append((each, bits))
    return tuple(each for each, _ in kept)


@dataclass(frozen=True)
class _Moves:
    """Fields freed of their slow part, in units of their standard deviation."""

    values: FloatArray
    std: FloatArray
    independent: FloatArray
    """Number of independent moves."""

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
        return cls(values, std, np.minimum(np.where(steps < 3.0, steps, both), 200.0))


def _grouped(rows: FloatArray, group: int) -> FloatArray:
    count = rows.shape[1] // group
    return np.asarray(rows[:, : count * group].reshape(len(rows), count, group).mean(2))


def _participation(rows: FloatArray) -> FloatArray:
    """Return the number of entries that carry the squares of each row."""
    return np.asarray((rows**2).sum(1) ** 2 / np.maximum((rows**4).sum(1), 1e-12))


class _Pairs:
    """All pairs of a voltage (rows) and a current (columns), with their log posterior."""

    def __init__(  # noqa: PLR0917 - made in one place
        self,
        current_grid: list[FloatArray],
        voltage_grid: list[FloatArray],
        currents: Sequence[_Row],
        voltages: Sequence[_Row],
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
        # A measured quantity dithers: several changes make one independent move.
        moves = [np.array([row.steps / 4.0 for row in rows]) for rows in (voltages, currents)]
        count = np.minimum(
            np.minimum(u.independent, moves[0])[:, None],
            np.minimum(i.independent, moves[1])[None, :],
        )
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
        likely = np.full(self.r.shape, _IMPOSSIBLE)
        self.current_scale = np.ones(self.r.shape)
        widths = np.array([row.place.width for row in currents])[None, :]
        for amps, usual in CURRENT_SCALES.items():
            prior = _resistance_prior(self.slope * scale / amps) + usual
            prior = prior - _narrow(amps * 2.0 ** (widths - 1))
            self.current_scale = np.where(prior > likely, amps, self.current_scale)
            likely = np.maximum(prior, likely)
        evidence = np.where(likely <= _IMPOSSIBLE + 5.0, 0.0, evidence)
        # Without evidence the slope is chance, and says nothing of scale and resistance.
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
            + np.array([row.prior for row in voltages])[:, None]
            + np.array([row.prior for row in currents])[None, :]
            + likely
            + np.where(same, 2.5, 0.0)
            + np.where(is_copy, _IMPOSSIBLE, 0.0)
            - 1.5 * self._has_sibling(voltages)[:, None]
        )

    def _has_sibling(self, voltages: Sequence[_Row]) -> Bits:
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
            alike & (self.r**2 > COPY_R2) & (lost < 0.1 * (1.0 + slope**2)) & (count < MANY_MOVES)
        )

    def best(self, make: Any) -> tuple[tuple[Candidate, ...], tuple[Candidate, ...], _Row | None]:
        """Return the best candidates for current and voltage, and the row of the first current."""
        chosen: _Row | None = None
        roles: tuple[list[_Row], list[_Row]] = ([], [])
        currents: list[Candidate] = []
        voltages: list[Candidate] = []
        flat = np.argsort(-self.score, axis=None)[: 200 * 200]
        for place in flat:
            a, b = divmod(int(place), self.score.shape[1])
            u, i = self._voltages[a], self._currents[b]
            if self.score[a, b] < _IMPOSSIBLE / 2.0:
                break
            if self._share_bits(u, i):
                continue
            # A field of a better pair keeps its role.
            if any(self._share_bits(u, other) for other in roles[0]):
                continue
            if any(self._share_bits(i, other) for other in roles[1]):
                continue
            roles[0].append(i)
            roles[1].append(u)
            chosen = chosen or i
            self._add(currents, voltages, a, b, make)
            if len(currents) >= SHOWN and len(voltages) >= SHOWN:
                break
        return tuple(currents[:SHOWN]), tuple(voltages[:SHOWN]), chosen

    def _share_bits(self, one: _Row, two: _Row) -> bool:
        """Whether two fields share bits; a gateway repeats frames on other buses."""
        a, b = self._streams[one.field.stream], self._streams[two.field.stream]
        if (a.arbitration_id, a.is_extended) != (b.arbitration_id, b.is_extended):
            return False
        return bool(one.place.bits(a.length) & two.place.bits(b.length))

    def _add(
        self, currents: list[Candidate], voltages: list[Candidate], a: int, b: int, make: Any
    ) -> None:
        u, i = self._voltages[a], self._currents[b]
        score, evidence = float(self.score[a, b]), float(self.evidence[a, b])
        amps = float(self.current_scale[a, b])
        ohm = float(self.slope[a, b]) * u.scale / amps
        halves = self._halves(a, b)
        sign = 1 if self.r[a, b] < 0.0 else -1
        half_ohm = (halves[0] * u.scale / amps, halves[1] * u.scale / amps)
        facts = {
            "score": score,
            "evidence": evidence,
            "correlation": float(self.r[a, b]),
            "resistance_ohm": ohm,
            "halves_ohm": half_ohm,
        }
        zero = self._zero(i)
        current = make(i, amps, -amps * zero, sign=sign, **facts)
        voltage = make(u, u.scale, 0.0, sign=1, **facts)
        for found, each, partner in (
            (currents, current, voltage),
            (voltages, voltage, current),
        ):
            bits = each.place.bits(each.length)
            if not any(
                _overlap(each, bits, one, one.place.bits(one.length)) or _same_numbers(each, one)
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
    def _zero(row: _Row) -> float:
        """Return the raw number of no current: 0 if signed, else a round one that was passed."""
        if row.place.is_signed:
            return 0.0
        good = row.field.raw[~row.missing] + row.constant
        resting = _most_common(good)
        zeros = _round_zeros(float(good.min()), float(good.max()), row.place.width) or [0.0]
        return min(zeros, key=lambda each: abs(each - resting))


def _most_common(values: Ints) -> float:
    """Return the most common value, to a fiftieth of the range."""
    counts, edges = np.histogram(values, bins=50)
    most = int(counts.argmax())
    return float(edges[most] + edges[most + 1]) / 2.0


def _round_zeros(low: float, high: float, width: int) -> list[float]:
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
    """Return the log prior of a scale [A] for a field of so many bits, without any evidence."""
    full_a = np.array(scale * 2.0 ** (width - 1))
    return CURRENT_SCALES[scale] - float(_narrow(full_a)) - (1.0 if full_a > 2000.0 else 0.0)


def _same_numbers(one: Candidate, two: Candidate) -> bool:
    return (one.arbitration_id, one.start, one.place.width, one.place.is_motorola) == (
        two.arbitration_id, two.start, two.place.width, two.place.is_motorola,
    )  # fmt: skip


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
    return np.asarray(np.where((ohm < low) | (ohm > high), _IMPOSSIBLE, -0.5 * distance**2))
