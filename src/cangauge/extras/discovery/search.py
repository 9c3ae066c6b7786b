"""Current, voltage and SoC of a pack among the fields of a capture.

Every field is averaged on one grid of time; current and voltage are the best pair (`pairs`), SoC is
what falls with the charge of that current.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from operator import attrgetter
from typing import Final

import can
import numpy as np

from cangauge._text import duration
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.discovery.candidate import (
    LEAST_HOURS,
    SHOWN,
    Candidate,
    Level,
)
from cangauge.extras.discovery.fields import Field, fields_of
from cangauge.extras.discovery.pairs import IMPOSSIBLE, best_pairs
from cangauge.extras.discovery.proposal import Proposal
from cangauge.extras.discovery.rows import Grid, Row, round_zeros
from cangauge.extras.discovery.streams import collect
from cangauge.logs.sign import correlation

VOLTAGE_SCALES: Final = {
    0.1: 0.0,
    0.5: -0.3,
    0.25: -0.3,
    0.01: -0.3,
    0.125: -1.2,
    0.05: -2.0,
    0.02: -2.0,
    1.0: -1.0,
    2.0: -3.0,
}
"""Usual scales [V] and their log priors [nats], by their frequency in public DBC files."""
SOC_SCALES: Final = {
    0.1: 0.0,
    0.5: -0.5,
    0.01: -0.5,
    1.0: -0.5,
    0.4: -1.5,
    0.05: -1.5,
    0.025: -1.5,
    0.02: -1.5,
    0.0025: -1.5,
    1.0 / 640.0: -1.5,
}
"""Scales of a SoC [%], the last that of SAE J1939, and their log priors [nats].

They are a judgement in three classes: too few public DBC files have a SoC to count. With equal
priors, the first SoC of three of eleven makes of `benchmarks/init_makes.py` gets a wrong scale.
"""
BETWEEN_S: Final = 10.0
"""Pause that is put between captures [s]: as long as trends that the search takes away."""
ENOUGH_NATS: Final = 3.0
"""Evidence that is needed to decide without the user: a likelihood ratio of 20."""


def search(
    messages: Iterable[can.Message], nominal_v: float | None = None, at_most: int = 1_000_000
) -> Proposal:
    """Return the candidates for current, voltage and SoC in the frames of a capture.

    Parameters
    ----------
    messages : iterable of can.Message
    nominal_v : float, optional
        Voltage of the pack, nominal or as a meter shows it [V]: decides the voltage's scale.
    at_most : int
        Frames that are looked at, all ids over one time: by default 5–15 minutes of a car, hours of
        a module.

    Raises
    ------
    InputError
        If no id has enough frames.
    """
    frames = iter(messages)
    streams = collect(islice(frames, at_most))
    if not streams:
        raise InputError(
            "no id has enough frames to search", cure="record at least a minute, while driving"
        )
    fields, grid = fields_of(streams), Grid(streams)
    current, voltage, row = _pair(fields, grid, nominal_v)
    soc = [] if row is None else _socs(fields, grid, current[0], voltage[0], row)
    remarks = []
    if not current:
        remarks.append("no field of this capture can be the current or the voltage of a pack")
    elif current[0].evidence < ENOUGH_NATS:
        remarks.append(
            "no current steps in this capture that a voltage follows: the candidates are"
            " chosen by their smoothness alone; record while driving"
        )
    if not soc:
        remarks.append(
            "no SoC field found: none follows the charge more closely than the time; record a"
            " longer drive, of several % SoC"
        )
    if next(frames, None) is not None:
        remarks.append(f"ranges and steps are those of the first {duration(grid.duration_s)}")
    seen = f"{grid.duration_s:.0f} s of frames: {len(fields)} numbers of {len(streams)} ids"
    found = {"current": current, "voltage": voltage, "soc_reference": soc[:SHOWN]}
    clear = [role for role in ("current", "voltage") if found[role] and _is_clear(found[role])]
    if soc and not any(each.bits & soc[0].bits for each in soc[1:]):
        clear.append("soc_reference")
    return Proposal(
        method="physics",
        candidates=found,
        clear=clear,
        head=(
            f"Found by physics in {seen}.",
            *remarks,
            "The bits do not determine the factors: compare voltage and current with a",
            "meter or the car's display, and correct factor and offset in the DBC.",
        ),
        remarks=tuple(remarks),
        has_steps=any(map(_is_proven, current)),
    )


def _is_proven(candidate: Candidate) -> bool:
    """Return whether the voltage follows five steps of the current, each a tenth of its range."""
    return candidate.evidence >= ENOUGH_NATS and candidate.moves >= 5


def _is_clear(found: list[Candidate]) -> bool:
    """Return whether the first candidate is certain enough to be taken without the user."""
    first, *others = found
    if not (_is_proven(first) and first.is_repeated):
        return False
    # The inverter's pair and the pack's obey the same physics. The evidence of loads that hang
    # together differs by less than its saturation.
    if any(each.evidence > 0.6 * first.evidence for each in others):
        return False
    return not others or first.score - others[0].score >= ENOUGH_NATS


def _pair(
    fields: Sequence[Field], grid: Grid, nominal_v: float | None
) -> tuple[list[Candidate], list[Candidate], Row | None]:
    """Return the candidates for current and voltage, and the field of the first current."""
    currents = [row for field in fields if (row := _as_current(field))]
    voltages = [row for field in fields if (row := _as_voltage(field, nominal_v))]
    if not currents or not voltages:
        return [], [], None
    # All pairs are held in memory, 50 MB for each of a dozen quantities: of the largest buses, the
    # likelier fields.
    currents = sorted(currents, key=attrgetter("prior"), reverse=True)[:4000]
    voltages = sorted(voltages, key=attrgetter("prior"), reverse=True)[:1500]
    return best_pairs(voltages, currents, grid)


def _socs(
    fields: Sequence[Field],
    grid: Grid,
    current: Candidate,
    voltage: Candidate,
    row: Row,
) -> list[Candidate]:
    """Return what falls with the charge of a current, best first.

    Of readings that share bits, those are kept between which the data do not decide.
    """
    amps = current.sign * (current.scale * row.means_on(grid) + current.offset)
    span = grid.longest(0.5 * BETWEEN_S)
    drawn_ah = (np.cumsum(amps) * grid.step_s / 3600.0)[span]
    least_ah = LEAST_HOURS * float(np.abs(amps).max())
    found = []
    for field in fields:
        values = grid.means(field.stream, field.raw, field.missing)[span]
        found += _as_soc(field, values, drawn_ah, least_ah)
    taken = current.bits | voltage.bits
    kept: list[Candidate] = []
    for each in sorted(found, key=attrgetter("score"), reverse=True):
        better = [other.score for other in kept if other.bits & each.bits]
        if not each.bits & taken and each.score > max(better, default=-math.inf) - ENOUGH_NATS:
            kept.append(each)
    return kept


def _falls_with(drawn_ah: FloatArray, values: FloatArray, step: float) -> float:
    """Return the log likelihood ratio of a line over the charge against one over time.

    It is 0 for what rises. Both lines leave at least the rounding of the field. The levels that the
    charge tells apart count as independent.
    """
    by_charge = correlation(values, drawn_ah)
    if by_charge >= 0.0:
        return 0.0
    by_time = correlation(values, np.arange(len(values), dtype=np.float64))
    of_charge, of_time = (
        max((1.0 - r * r) * float(values.var()), step**2 / 12.0) for r in (by_charge, by_time)
    )
    levels = float(np.ptp(values)) / math.sqrt(12.0 * of_charge)
    return 0.5 * levels * math.log(of_time / of_charge)


def _as_current(field: Field) -> Row | None:
    """Return a field as a current; None where it has too few values."""
    place, full = field.best, 1 << field.best.width
    prior = place.nature + field.prior
    if not place.is_signed:
        if len(np.unique(field.values)) < 3:
            return None
        low = float(field.values.min() + place.constant)
        high = float(field.values.max() + place.constant)
        if low >= 0.9 * full:  # nearly all ones: a small negative number
            place = replace(place, is_signed=True, constant=place.constant - full)
        elif not any(round_zeros(low, high, place.width)):
            # A pack's current has two signs: an unsigned field holds zero as a round number.
            prior -= 5.0
    return Row(field, place, field.missing, prior)


def _as_voltage(field: Field, nominal_v: float | None) -> Row | None:
    """Return the likeliest reading and scale of a field as a pack's voltage."""
    if field.best.is_signed:
        return None
    zero = (field.raw == 0) & ~field.missing
    readings: list[Row] = []
    for place in field.places:
        # Zero: before the contactors close.
        missing = field.missing | zero if place.constant == 0 else field.missing
        good = field.raw[~missing]
        if len(good) < 0.3 * len(field.raw):
            continue
        low, level, high = np.percentile(good, [2.0, 50.0, 98.0]) + place.constant
        if low <= 0.0 or high - low > 0.5 * level:
            continue
        # What rests at half its range is a torque, a yaw rate or the like with an offset; a voltage
        # is there by chance once in twenty or thirty.
        width = place.width
        at_half = abs(level / (1 << (width - 1)) - 1.0) < 0.03
        prior = place.nature + field.prior - 3.0 * at_half
        for scale in VOLTAGE_SCALES:
            volts = level * scale
            text = f"{volts:.3g} V at {scale:g} V a step of {width} bits"
            text += f" (about {round(volts / 3.7)} cells)"
            likely = prior + _scale_prior(scale, volts, width, nominal_v)
            readings.append(Row(field, place, missing, likely, (Level(scale, volts, text),)))
    return _likeliest(readings, by_scale=nominal_v is None)


def _likeliest(readings: Sequence[Row], *, by_scale: bool) -> Row | None:
    """Return the likeliest reading, with the levels of the others that fit as well.

    Bits and physics are the same by every scale; where that is decided, other bits of the field may
    fit as well.
    """
    best = max(readings, key=attrgetter("prior"), default=None)
    if best is None or best.prior < IMPOSSIBLE / 2.0:
        return None
    least = IMPOSSIBLE / 2.0 if by_scale else best.prior - 5.0
    (own,) = best.levels
    others = [
        each.levels[0]
        for each in readings
        if each.prior > least
        and abs(each.levels[0].value / own.value - 1.0) > 0.01
        and (each.place is best.place or not by_scale)
    ]
    best.levels = (own, *sorted(others))
    return best


def _as_soc(
    field: Field, values: FloatArray, drawn_ah: FloatArray, least_ah: float
) -> list[Candidate]:
    """Return a field's readings as a SoC, of each level the likeliest; none without evidence."""
    evidence, r = _falls_with(drawn_ah, values, field.step), correlation(values, drawn_ah)
    if evidence < ENOUGH_NATS:
        return []
    raw_ah = float(drawn_ah.std() / (-r * values.std()))
    readings: dict[int, list[Row]] = defaultdict(list)
    for place in field.places:
        for scale, usual in SOC_SCALES.items():
            low, high = (scale * (end + place.constant) for end in (values.min(), values.max()))
            holds_soc = low > 0.0 and high <= 101.0 and scale * (1 << place.width) > 100.0
            capacity_ah = 100.0 * raw_ah / scale
            if holds_soc and capacity_ah > least_ah:
                # Most packs have 30–300 Ah; the scale of the current is as uncertain.
                likely = -0.5 * (math.log(capacity_ah / 90.0) / 1.3) ** 2
                score = evidence + place.nature + usual + likely
                text = f"{low:.3g} … {high:.3g} % at {scale:g} % a step ({capacity_ah:.0f} Ah)"
                meant = Level(scale, high, text)
                readings[place.constant].append(Row(field, place, field.missing, score, (meant,)))
    rows = [row for of in readings.values() if (row := _likeliest(of, by_scale=True))]
    return [
        row.candidate(
            "soc_reference",
            row.levels[0].scale,
            0.0,
            score=row.prior,
            evidence=evidence,
            correlation=r,
            partner=f"{100.0 * raw_ah / row.levels[0].scale:.0f} Ah per 100 %",
        )
        for row in rows
    ]


def _scale_prior(scale: float, volts: float, width: int, nominal_v: float | None) -> float:
    """Return the log prior of a voltage's scale [nats], by a stated voltage if there is one.

    Most cars have 250–450 V, and a full scale not far beyond.
    """
    usual = VOLTAGE_SCALES[scale]
    if nominal_v is not None:
        # A pack's middle voltage lies within some per cent of the stated one.
        return usual + max(-0.5 * (math.log(volts / nominal_v) / 0.03) ** 2, IMPOSSIBLE)
    level = {30: IMPOSSIBLE, 100: -2.2, 250: -1.5, 450: 0.0, 900: -1.2, math.inf: IMPOSSIBLE}
    full = {380: -1.0, 1400: 0.0, math.inf: -0.3 if scale <= 0.1 else -2.0}
    return usual + _step(volts, level) + _step(scale * (1 << width), full)


def _step(value: float, priors: Mapping[float, float]) -> float:
    """Return the prior of the first bound that a value does not exceed."""
    return next(prior for bound, prior in priors.items() if value <= bound)
