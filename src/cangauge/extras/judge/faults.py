"""What may be wrong with a gauge, its log or its pack: one table, and a column of each shape.

A `Column` is a quantity of the linear model: what a unit of it adds to the true SoC, to the
published one and to the voltage. A healthy pack has some of small standard deviation. A fault is
one of large standard deviation and small prior probability, with a column for each shape that it
may have: since when it is there, and what sets the gauge right in between.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.extras.judge.chain import Chain

FREE_PCT: Final = 60.0
"""Standard deviation of the SoC at the start of a stretch [%]: unknown."""
LEVEL_PCT: Final = 15.0
"""Standard deviation of the level of a piece that is wrong [%]: anything."""
SCALE_PCT: Final = 8.0
"""Standard deviation of a wrong scale or capacity [%]: what ageing takes until it is noticed."""
SENSOR_PCT: Final = 1.5
"""Standard deviation of the gain of a voltage sensor that is beyond its class [%]."""
PIECE_PCT: Final = 0.5
"""Standard deviation of the level of a piece that is right [%]."""
OFFSETS_PER_H: Final = (0.04, 0.004)
"""Standard deviations of a current offset over the capacity [1/h]: a coarse and a good sensor."""
LATE_S: Final = (30.0, 60.0, 120.0, 240.0, 480.0)
"""Lags that are tried [s]."""
LEAST_SLOPE: Final = 0.1
"""Least slope of the curve, relative to its mean, for a SoC read from a voltage [-]."""

P_LEVEL: Final = 0.5
"""Prior probability that the level of a piece is wrong: whoever asks has a reason."""
P_FAULT: Final = 0.05
"""Prior probability of each other fault."""
P_SELDOM: Final = 0.02
"""Prior probability that the log or the model is wrong instead: that a voltage sensor is beyond its
class, or that the pack has another capacity than the model and the gauge knows it."""


class Kind(NamedTuple):
    """A row of the table of faults."""

    unit: str
    words: str
    """With {size} and {side}."""
    sides: tuple[str, str]
    """{side} of a positive and of a negative size."""
    next_step: str
    digits: int = 1


FAULTS: Final[Mapping[str, Kind]] = {
    "start_or_reset": Kind(
        "%",
        "wrong start or reset, {size} too {side}",
        ("high", "low"),
        "Charge until full once, so that the gauge resets itself, and judge again.",
    ),
    "current_offset": Kind(
        "A",
        "the gauge counts with a current that reads {size} too {side}",
        ("high", "low"),
        "Read the current with everything off: what it shows is the offset. Calibrate its zero, or"
        " let the gauge reach a full charge more often.",
        2,
    ),
    "count_scale": Kind(
        "%",
        "the published SoC moves {size} too {side} for the charge",
        ("much", "little"),
        "Compare the capacity in the gauge's configuration with the pack's, and the current with a"
        " clamp meter under load.",
    ),
    "pack_capacity": Kind(
        "%",
        "the pack's capacity is {size} {side} than the gauge counts with",
        ("larger", "smaller"),
        "Log one full discharge or charge: it gives the capacity. Then state it in the gauge.",
    ),
    "model_capacity": Kind(
        "%",
        "the pack's capacity is {size} {side} than the model's, and the gauge knows it",
        ("larger", "smaller"),
        "Fit a new model to logs of these days.",
    ),
    "voltage_sensor": Kind(
        "%",
        "the logged voltage reads {size} too {side}",
        ("high", "low"),
        "Put a meter on the pack's terminals at rest and compare with the log.",
    ),
    "voltage_table": Kind(
        "-",
        "the gauge follows the voltage under load, with {size} of its drop",
        ("", ""),
        "Read the gauge at rest only, or use one that counts charge.",
    ),
    "late": Kind(
        "s",
        "the gauge is {size} late",
        ("", ""),
        "Compare the time stamps of SoC and current: the gauge, or what carries it, buffers.",
        0,
    ),
    "weak_cell": Kind(
        "%",
        "cell {cell} lacks {size} of its capacity",
        ("", ""),
        "Log one full charge and discharge with cell voltages, and balance the pack.",
    ),
    "stands_still": Kind(
        "%",
        "",
        ("", ""),
        "See whether the gauge itself stands still, or only what is logged of it, and judge again"
        " by a log in which its SoC moves.",
    ),
}


class Priors(NamedTuple):
    """How well capacity, zero and voltage of the pack are known, as standard deviations [%]."""

    capacity_pct: float
    zero_pct: float
    """Of the gauge's own zero beside the model's."""
    voltage_pct: float
    """Of the scale of the voltage beside the model's."""


@dataclass(frozen=True, eq=False)
class Column:
    """A column of the model.

    Parameters
    ----------
    name : str
    std : float
        Prior standard deviation.
    soc, shown, volts : array of shape (blocks,), or 0
        What a unit adds to the true SoC and to the published one [%], each relative to a stretch
        that starts with s, and to the voltage beside the change of SoC [V].
    place : tuple
        A set of faults has one shape of each place. Of a level: with the number of its piece.
    since : int
        Stretch with which it begins.
    is_positive : bool
        Whether its size has one sign.
    per_unit : float
        Size that is reported for a unit.
    log_prior : float
        Log of the prior probability relative to none; 0 for what is always there.
    """

    name: str
    std: float
    soc: FloatArray | BoolArray | float = 0.0
    shown: FloatArray | BoolArray | float = 0.0
    volts: FloatArray | float = 0.0
    place: tuple[str | int, ...] = ()
    since: int = 0
    is_positive: bool = False
    per_unit: float = 1.0
    log_prior: float = 0.0


def healthy(chain: Chain, priors: Priors, soc_pct: FloatArray) -> list[Column]:
    """Return what a healthy pack and gauge show; first the start of each stretch, then the zero."""
    blocks = chain.blocks
    starts = [blocks.stretch == k for k in range(len(chain.stretches))]
    offset_pct, offset_v = chain.sensor("current_offset")
    capacity_ah = chain.model.capacity_ah
    return [
        *(Column("start", FREE_PCT, soc=start, shown=start) for start in starts),
        Column("zero", priors.zero_pct, shown=1.0),
        *(Column("curve", 1.0, volts=each) for each in chain.function_columns(soc_pct).T),
        # A model is off in the same way on days that are alike: as much as from log to log.
        Column("level", 1.0, volts=chain.level_v),
        Column("voltage", priors.voltage_pct, volts=chain.sensor("voltage_gain")[1]),
        Column("offset", capacity_ah / 400.0, soc=offset_pct, volts=offset_v),
        Column("capacity", priors.capacity_pct, soc=chain.sensor("capacity")[0]),
        *(Column("piece", PIECE_PCT, shown=chain.piece == n) for n in _pieces(chain)),
    ]


def faults(chain: Chain, soc_pct: FloatArray) -> list[Column]:
    """Return everything that may be wrong, in all its shapes, with their prior probabilities."""
    found = list[Column]()
    for shapes, probability in _families(chain, soc_pct):
        odds = np.log(probability / (1.0 - probability))
        # Half of it began before the first log.
        early = sum(shape.since == 0 for shape in shapes)
        late = len(shapes) - early
        for shape in shapes:
            count = (late if shape.since else early) * (2.0 if early and late else 1.0)
            found.append(replace(shape, log_prior=float(odds - np.log(count))))
    return found


def _families(chain: Chain, soc_pct: FloatArray) -> Iterator[tuple[list[Column], float]]:
    """Yield the shapes of each fault, and its prior probability."""
    blocks, onsets = chain.blocks, _onsets(chain)
    for piece in _pieces(chain):
        yield list(_levels(chain, piece)), P_LEVEL
    yield list(_levels_in_pauses(chain)), P_FAULT
    yield [each for k in onsets for each in _offsets(chain, k)], P_FAULT
    scales = list(_scales(chain, soc_pct))
    for name in ("count_scale", "pack_capacity"):
        yield [each for each in scales if each.name == name], P_FAULT
    capacity = chain.sensor("capacity")[0]
    aged = Column("model_capacity", SCALE_PCT, capacity, capacity, place=("scale",))
    yield [aged], P_SELDOM
    volts = chain.sensor("voltage_gain")[1]
    sensor = Column("voltage_sensor", SENSOR_PCT, place=("voltage_sensor",))
    yield (
        [replace(sensor, volts=volts * (blocks.stretch >= k), since=k) for k in onsets],
        P_SELDOM,
    )
    least = LEAST_SLOPE * float(np.ptp(chain.extended.model.pseudo_ocv([5.0, 95.0]))) / 90.0
    read_pct = blocks.load_v / np.maximum(chain.slope(soc_pct), least)
    table = Column("voltage_table", 1.0, shown=read_pct, place=("table",), is_positive=True)
    yield [table], P_FAULT
    late = Column("late", 1.0, place=("late",), is_positive=True)
    before_pct = [
        (seconds, chain.at_blocks(chain.samples.drawn_pct, seconds)) for seconds in LATE_S
    ]
    yield (
        [
            replace(late, shown=blocks.drawn_pct - before, per_unit=seconds)
            for seconds, before in before_pct
        ],
        P_FAULT,
    )


def _onsets(chain: Chain) -> list[int]:
    """Return the stretches with which a fault of a sensor may begin.

    After a pause it may be each. Within an unbroken record nothing marks the moment, so that it is
    found to a factor of two: the last stretch, the last two, four, eight, ….
    """
    number = len(chain.stretches)
    back = {2**k for k in range(number.bit_length())}
    return [k for k, each in enumerate(chain.stretches) if not each.continues or number - k in back]


def _pieces(chain: Chain) -> list[int]:
    """Return the numbers of the pieces."""
    return [int(number) for number in np.unique(chain.piece) if number >= 0]


def _levels(chain: Chain, piece: int) -> Iterator[Column]:
    """Yield a wrong level of one piece, of all from it on, and of all up to it."""
    numbers, last = chain.piece, int(chain.piece.max())
    since = int(chain.blocks.stretch[np.argmax(numbers == piece)])
    spans = {(piece, piece), (piece, last)}
    if piece < last:
        spans.add((0, piece))
    for low, high in sorted(spans):
        yield Column(
            "start_or_reset",
            LEVEL_PCT,
            shown=(numbers >= low) & (numbers <= high),
            place=("level", piece, since),
            since=since,
        )


def _levels_in_pauses(chain: Chain) -> Iterator[Column]:
    """Yield a level that is wrong from a pause within a piece on, or until it."""
    blocks = chain.blocks
    for piece in _pieces(chain):
        inside = chain.piece == piece
        first, *later = np.unique(blocks.stretch[inside]).tolist()
        for pause in later:
            if chain.stretches[pause].continues:
                continue
            is_after = blocks.stretch >= pause
            for since, shown in ((pause, inside & is_after), (first, inside & ~is_after)):
                yield Column(
                    "start_or_reset",
                    LEVEL_PCT,
                    shown=shown,
                    place=("level", piece, since),
                    since=since,
                )


def _begins(chain: Chain) -> tuple[IntArray, IntArray]:
    """Return the block at which the piece of each block begins: in all, and in its stretch."""
    blocks = chain.blocks
    in_stretch = blocks.stretch * (chain.piece.max() + 2) + chain.piece
    found = []
    for numbers in (chain.piece, in_stretch):
        _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
        found.append(first[inverse])
    return found[0], found[1]


def _offsets(chain: Chain, since: int) -> Iterator[Column]:
    """Yield offsets of the current in the gauge's count alone, or in the log's sensor as well.

    The gauge's error grows while it logs, also while it does not, or within each log alone.
    """
    blocks, (begin, begin_in_stretch) = chain.blocks, _begins(chain)
    lasts = [chain.samples.hours[each.samples.stop - 1] for each in chain.stretches]
    logged = blocks.hours + np.concatenate([[0.0], np.cumsum(lasts)])[blocks.stretch]
    stamped = (blocks.time_s - blocks.time_s[0]) / 3600.0
    first = chain.stretches[since].blocks.start
    logged, stamped = (np.maximum(clock, clock[first]) for clock in (logged, stamped))
    per_ah = 100.0 / chain.model.capacity_ah
    errors = [
        per_ah * (clock[at] - clock)
        for clock, at in ((logged, begin), (stamped, begin), (logged, begin_in_stretch))
    ]
    names = ("current_offset", "current_offset")
    for std in OFFSETS_PER_H:
        one = Column("", std * chain.model.capacity_ah, place=("current_offset",), since=since)
        yield from _counting(chain, one, "current_offset", names, errors)


def _scales(chain: Chain, soc_pct: FloatArray) -> Iterator[Column]:
    """Yield wrong scales: of the gauge's count, or of the pack's capacity.

    The gauge is right when a piece begins, when it is full, or when it is empty; or its error is
    of each log alone.
    """
    begin, begin_in_stretch = _begins(chain)
    rights_pct = (soc_pct[begin], 100.0, 0.0, soc_pct[begin_in_stretch])
    errors = [np.asarray(soc_pct - right) / 100.0 for right in rights_pct]
    names = ("count_scale", "pack_capacity")
    yield from _counting(chain, Column("", SCALE_PCT, place=("scale",)), "capacity", names, errors)


def _counting(
    chain: Chain,
    one: Column,
    effect: str,
    names: tuple[str, str],
    errors: Sequence[FloatArray],
) -> Iterator[Column]:
    """Yield an effect on the gauge's count alone, and one on sensor or pack as well."""
    soc, volts = chain.sensor(effect)
    is_after = chain.blocks.stretch >= one.since
    for error in errors:
        yield replace(one, name=names[0], shown=error)
        yield replace(
            one,
            name=names[1],
            soc=soc * is_after,
            shown=error + soc * is_after,
            volts=volts * is_after,
        )
