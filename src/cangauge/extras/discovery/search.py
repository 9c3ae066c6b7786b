"""Current, voltage, SoC and temperature of a pack among the fields of a capture.

Every field is averaged on one grid of time; current and voltage are the best pair (`pairs`), SoC is
what falls with the charge of that current.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any, Final

import can
import numpy as np

from cangauge._text import duration
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.discovery.fields import Field, Stream, byte_order, collect, fields_of
from cangauge.extras.discovery.pairs import (
    CLEARLY_NATS,
    IMPOSSIBLE,
    LARGEST_R2,
    MOST_ROWS,
    SHOWN,
    SOC_SCALES,
    VOLTAGE_SCALES,
    Candidates,
    Pairs,
    Row,
    SignalCandidate,
    is_capacity,
    most_common,
    overlap,
    round_zeros,
)

_LOG = logging.getLogger(__name__)

BETWEEN_S: Final = 10.0
"""Pause that is put between captures [s]: as long as trends that the search takes away."""
GRID_S: Final = 0.1
"""Interval of the grid [s]: pack messages come every 10–100 ms."""
MOST_CURRENTS: Final = 4000
MOST_VOLTAGES: Final = 1500
"""Most fields whose pairs are tried: 50 MB for each of a dozen quantities."""
ENOUGH_NATS: Final = 3.0
"""Evidence from current steps that is needed to decide without the user: as above."""
RIVAL: Final = 0.6
"""Share of the first candidate's evidence with which another leaves the choice to the user: the
evidence of loads that hang together differs by less than its saturation."""
NOMINAL_SPREAD: Final = 0.06
"""Log spread of a pack's voltage about the nominal one: between 10 and 90 % SoC cells have 3.4 to
4.1 V at 3.7 V nominal."""
AT_HALF: Final = 0.03
AT_HALF_NATS: Final = 3.0
"""A number that rests at half its range, to this share, is a torque, a yaw rate or the like with
an offset; a voltage is there by chance once in twenty or thirty."""
ENOUGH_STEPS: Final = 50
"""Fewest changes of a field that is taken without the user."""
MOST_FRAMES: Final = 1_000_000
"""Frames that are looked at, all ids over one time: 5–15 minutes of a car, hours of a module."""


_Taken = tuple[SignalCandidate, frozenset[int]]
"""A field and its bits."""


@dataclass(frozen=True)
class Findings:
    """Candidates by role, best first, and what the capture cannot show.

    Parameters
    ----------
    current, voltage, soc_reference, temperature : tuple of SignalCandidate
    remarks : tuple of str
    streams, fields : int
        Number of ids and of numbers looked at.
    duration_s : float
    """

    current: Candidates
    voltage: Candidates
    soc_reference: Candidates
    temperature: Candidates
    remarks: tuple[str, ...]
    streams: int
    fields: int
    duration_s: float

    @property
    def comments(self) -> tuple[str, ...]:
        """What was looked at and not found, for the head of a map."""
        found = f"Found by physics in {self.duration_s:.0f} s of frames: {self.fields} numbers of"
        hints = [f"{c.name} ({c.low:.3g} … {c.high:.3g} °C)" for c in self.temperature]
        slow = [f"Slow and plausible as a temperature: {', '.join(hints)}."] if hints else []
        return (f"{found} {self.streams} ids.", *self.remarks, *slow)

    def is_clear(self, role: str) -> bool:
        """Whether the first candidate is certain enough to be taken without the user."""
        found: Candidates = getattr(self, role)
        if not found or found[0].evidence < ENOUGH_NATS or found[0].steps < ENOUGH_STEPS:
            return False
        if not found[0].is_repeated:
            return False
        if any(each.evidence > RIVAL * found[0].evidence for each in found[1:]):
            return False  # the inverter's pair and the pack's: both obey the same physics
        return len(found) == 1 or found[0].score - found[1].score >= CLEARLY_NATS


def search(messages: Iterable[can.Message], nominal_v: float | None = None) -> Findings:
    """Find current, voltage, SoC and temperature in the frames of a capture.

    Parameters
    ----------
    messages : iterable of can.Message
    nominal_v : float, optional
        Voltage of the pack, nominal or as a meter shows it [V]: decides the voltage's scale.

    Raises
    ------
    InputError
        If no id has enough frames.
    """
    frames = iter(messages)
    streams = collect(islice(frames, MOST_FRAMES))
    if not streams:
        raise InputError(
            "no id has enough frames to search", cure="record at least a minute, while driving"
        )
    fields: list[Field] = []
    order = byte_order(streams)
    for index, stream in enumerate(streams):
        _LOG.debug("id %d of %d: %s", index + 1, len(streams), stream.name)
        fields += fields_of(index, stream, order)
    found = _Search(streams, fields, nominal_v).findings()
    if next(frames, None) is None:
        return found
    part = f"ranges and steps are those of the first {duration(found.duration_s)}"
    return replace(found, remarks=(*found.remarks, part))


class _Search:
    def __init__(
        self, streams: Sequence[Stream], fields: Sequence[Field], nominal_v: float | None
    ) -> None:
        self._streams = streams
        self._nominal_v = nominal_v
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
        # All pairs are held in memory: of the largest buses, the likelier fields.
        currents = sorted(currents, key=lambda row: -row.prior)[:MOST_CURRENTS]
        voltages = sorted(voltages, key=lambda row: -row.prior)[:MOST_VOLTAGES]
        remarks: list[str] = []
        result = partial(
            Findings, streams=len(self._streams), fields=len(self._fields),
            duration_s=self._duration_s,
        )  # fmt: skip
        if not currents or not voltages:
            remark = "no field of this capture can be the current or the voltage of a pack"
            return result((), (), (), (), (remark,))
        pairs = Pairs(
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
                "no current steps in this capture that a voltage follows: the candidates are"
                " chosen by their smoothness alone; record while driving"
            )
        taken = [(each, each.place.bits(each.length)) for each in (*current[:1], *voltage[:1])]
        soc = () if row is None else self._charges(current[0], row, taken)
        if not soc:
            remarks.append("no field falls with the charge: record a longer drive to find the SoC")
        temperature = self._temperatures(taken)
        if not temperature:
            remarks.append("no slow field looks like a temperature")
        return result(current, voltage, soc, temperature, tuple(remarks))

    def _rate_prior(self, stream: Stream) -> float:
        """Return the log prior of a period: pack messages are fast, and not in turns."""
        period_s = stream.period_s
        if stream.selector is not None:
            return -2.0
        if period_s <= 0.11:
            return 0.8 if period_s <= 0.025 else 0.4
        return 0.0 if period_s < 0.3 else -1.0

    def _as_current(self, index: int) -> Row | None:
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
            zeros = round_zeros(low, high, best[0].width)
            rest = min((abs(each - seen.resting - best[2]) for each in zeros), default=math.inf)
            if any(each and math.log2(each).is_integer() for each in zeros):
                prior += 1.0
            # A pack's current has two signs: a number from zero upwards is none.
            prior -= 5.0 if not any(zeros) else 1.0 if rest > 0.15 * (high - low) else 0.0
        if seen.count < 3 and not field.place.is_signed:
            return None
        return Row(field, best[0], prior, 1.0, seen.median, best[2], field.missing)

    def _as_voltage(self, index: int) -> Row | None:
        field, seen = self._fields[index], self._statistics[index]
        if field.place.is_signed:
            return None
        rate = self._rate_prior(self._streams[field.stream])
        best: Row | None = None
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
            at_half = abs(level / (1 << (place.width - 1)) - 1.0) < AT_HALF
            for scale, usual in VOLTAGE_SCALES.items():
                likely = _level_prior(level * scale, self._nominal_v)
                prior = nature + rate + seen.prior + usual + likely
                prior -= AT_HALF_NATS if at_half else 0.0
                prior += _full_scale_prior(scale, place.width)
                if likely > IMPOSSIBLE and (best is None or prior > best.prior):
                    best = Row(field, place, prior, scale, level, constant, missing)
        return best

    def _grid(self, row: Row) -> FloatArray:
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

    def _candidate(self, row: Row, scale: float, offset: float, **more: Any) -> SignalCandidate:
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
        return SignalCandidate(
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

    def _charges(self, current: SignalCandidate, row: Row, taken: Sequence[_Taken]) -> Candidates:
        """Return fields that fall as the current is drawn, of other bits than those `taken`."""
        amps = current.scale * (self._grid(row) + row.constant) + current.offset
        amps *= current.sign
        drawn_ah = np.cumsum(amps) * self._step_s / 3600.0
        span = self._longest()
        found = []
        for index, each in enumerate(self._fields):
            seen = self._statistics[index]
            if each.place.is_signed or seen.count < 4:
                continue
            made = self._as_charge(index, drawn_ah[span], span)
            if made is not None and not _is_taken(made, taken):
                found.append(made)
        return _apart(found)[:SHOWN]

    def _longest(self) -> slice:
        """Return the rows of the longest capture: between captures the SoC jumps."""
        filled = np.unique(np.concatenate(self._slots))
        ends = np.flatnonzero(np.diff(filled) * self._step_s > 0.5 * BETWEEN_S)
        firsts, lasts = np.append(0, ends + 1), np.append(ends, len(filled) - 1)
        longest = int((filled[lasts] - filled[firsts]).argmax())
        return slice(int(filled[firsts[longest]]), int(filled[lasts[longest]]) + 1)

    def _as_charge(self, index: int, drawn_ah: FloatArray, span: slice) -> SignalCandidate | None:
        best, field = None, self._fields[index]
        for place, nature, constant in field.extensions:
            row = Row(field, place, 0.0, 1.0, 0.0, constant, field.missing)
            values = self._grid(row)[span] + constant
            spread, moved = float(np.std(values)), float(np.std(drawn_ah))
            if spread == 0.0 or moved == 0.0:
                continue
            r = float(np.mean((values - values.mean()) * (drawn_ah - drawn_ah.mean())))
            r /= spread * moved
            if r > -0.95:
                continue
            per_ah = spread / moved
            for scale in SOC_SCALES:
                level = values * scale
                capacity_ah = 100.0 / (per_ah * scale)
                if not (level.min() > 0.0 and level.max() <= 101.0 and is_capacity(capacity_ah)):
                    continue
                full = (1 << place.width) * scale
                prior = nature - 0.5 * (math.log(capacity_ah / 90.0) / 0.8) ** 2
                prior -= 0.0 if full <= 300.0 or scale <= 0.02 else 0.5
                events = float(self._statistics[index].count)
                evidence = -0.5 * events * math.log(1.0 - min(r * r, LARGEST_R2))
                if best is None or prior + evidence > best.score:
                    best = self._candidate(
                        row, scale, 0.0, sign=1, score=prior + evidence, evidence=evidence,
                        correlation=r, partner=f"{capacity_ah:.0f} Ah per 100 %",
                        capacity_ah=capacity_ah,
                    )  # fmt: skip
        return best

    def _temperatures(self, taken: Sequence[_Taken]) -> Candidates:
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
                    row = Row(field, place, 0.0, 1.0, 0.0, constant, field.missing)
                    candidate = self._candidate(
                        row, scale, offset, sign=1, score=prior, evidence=0.0
                    )
                    if not _is_taken(candidate, taken):
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
            float(np.median(good)), low, high, count, steps, largest, most_common(good), prior
        )


def _level_prior(volts: float, nominal_v: float | None = None) -> float:
    """Return the log prior of a pack's voltage [nats]: most cars have 250–450 V."""
    if nominal_v is not None:
        return -0.5 * (math.log(volts / nominal_v) / NOMINAL_SPREAD) ** 2
    if 250.0 <= volts <= 450.0:
        return 0.0
    if 450.0 < volts <= 900.0:
        return -1.2
    if 100.0 <= volts < 250.0:
        return -1.5
    return -2.2 if 30.0 <= volts < 100.0 else IMPOSSIBLE


def _full_scale_prior(scale: float, width: int) -> float:
    """Return the log prior of a voltage's full scale [nats]: not far beyond a pack's voltage."""
    full = scale * (1 << width)
    if 380.0 <= full <= 1400.0:
        return 0.0
    if full > 1400.0:
        return -0.3 if scale <= 0.1 else -2.0
    return -1.0


def _apart(found: list[SignalCandidate]) -> Candidates:
    """Return candidates, best first, without those that share bits with a better one."""
    kept: list[_Taken] = []
    for each in sorted(found, key=lambda one: -one.score):
        if not _is_taken(each, kept):
            kept.append((each, each.place.bits(each.length)))
    return tuple(each for each, _ in kept)


def _is_taken(one: SignalCandidate, taken: Sequence[_Taken]) -> bool:
    bits = one.place.bits(one.length)
    return any(overlap(one, bits, other, others) for other, others in taken)
