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

from cangauge._typing import BoolArray, FloatArray
from cangauge.extras.judge.chain import Chain

FREE_PCT: Final = 60.0
"""Standard deviation of the SoC at the start of a stretch [%]: unknown."""
PIECE_PCT: Final = 0.5
"""Standard deviation of the level of a piece that is right [%]."""
LAST: Final = 8
"""Logs of which each may be the first with a fault of a sensor: twelve columns for each."""
P_FAULT: Final = 0.05
"""Prior probability of most faults."""


class Kind(NamedTuple):
    """A row of the table of faults."""

    place: str
    """A set of faults has one of each place."""
    unit: str
    stds: tuple[float, ...]
    """Prior standard deviations that are tried [unit], those of an offset over the capacity [1/h]:
    a coarse and a good sensor. A level may be anything, a capacity or scale what ageing takes until
    it is noticed."""
    words: str
    """With {size} and {side}."""
    sides: tuple[str, str]
    """{side} of a positive and of a negative size; "" twice where the size is positive."""
    next_step: str
    digits: int = 1
    probability: float = P_FAULT
    """Prior. Of a level high: whoever asks has a reason. Of the log or the model low."""
    is_of_count: bool = True
    """Whether only a gauge that counts charge can have it."""


FAULTS: Final[Mapping[str, Kind]] = {
    "start_or_reset": Kind(
        "level",
        "%",
        (15.0,),
        "wrong start or reset, {size} too {side}",
        ("high", "low"),
        "Charge until full once, so that the gauge resets itself, and judge again.",
        probability=0.5,
    ),
    "current_offset": Kind(
        "offset",
        "A",
        (0.04, 0.004),
        "the gauge counts with a current that reads {size} too {side}",
        ("high", "low"),
        "Read the current with everything off: what it shows is the offset. Calibrate its zero, or"
        " let the gauge reach a full charge more often.",
        2,
    ),
    "count_scale": Kind(
        "scale",
        "%",
        (8.0,),
        "the published SoC moves {size} too {side} for the charge",
        ("much", "little"),
        "Compare the capacity in the gauge's configuration with the pack's, and the current with a"
        " clamp meter under load.",
    ),
    "pack_capacity": Kind(
        "scale",
        "%",
        (8.0,),
        "the pack's capacity is {size} {side} than the gauge counts with",
        ("larger", "smaller"),
        "Log one full discharge or charge: it gives the capacity. Then state it in the gauge.",
    ),
    "model_capacity": Kind(
        "scale",
        "%",
        (8.0,),
        "the pack's capacity is {size} {side} than the model's, and the gauge knows it",
        ("larger", "smaller"),
        "Fit a new model to logs of these days.",
        probability=0.02,
    ),
    "voltage_sensor": Kind(
        "voltage",
        "%",
        (1.5,),
        "the logged voltage reads {size} too {side}",
        ("high", "low"),
        "Put a meter on the pack's terminals at rest and compare with the log.",
        probability=0.02,
        is_of_count=False,
    ),
    "voltage_table": Kind(
        "table",
        "-",
        (1.0,),
        "the gauge follows the voltage under load, with {size} of its drop",
        ("", ""),
        "Read the gauge at rest only, or use one that counts charge.",
        is_of_count=False,
    ),
    "late": Kind(
        "late",
        "s",
        (30.0, 60.0, 120.0, 240.0, 480.0),
        "the gauge is {size} late",
        ("", ""),
        "Compare the time stamps of SoC and current: the gauge, or what carries it, buffers.",
        0,
    ),
    "weak_cell": Kind(
        "cell",
        "%",
        (15.0,),
        "cell {cell} lacks {size} of its capacity",
        ("", ""),
        "Log one full charge and discharge with cell voltages, and balance the pack.",
    ),
    "stands_still": Kind(
        "stand",
        "%",
        (),
        "",
        ("", ""),
        "See whether the gauge itself stands still, or only what is logged of it, and judge again"
        " by a log in which its SoC moves.",
    ),
}


@dataclass(frozen=True, eq=False)
class Column:
    """A column of the model.

    Parameters
    ----------
    std : float
        Prior standard deviation.
    soc, shown, volts : array of shape (blocks,), or 0
        What a unit adds to the true SoC and to the published one [%], each relative to a stretch
        that starts with s, and to the voltage beside the change of SoC [V].
    fault : str
        A key of `FAULTS`; "" for what is always there.
    since : int
        Stretch with which it begins.
    piece : int
        Of a level; −1 otherwise.
    log_prior : float
        Log of the prior probability relative to none.
    """

    std: float
    soc: FloatArray | BoolArray | float = 0.0
    shown: FloatArray | BoolArray | float = 0.0
    volts: FloatArray | float = 0.0
    fault: str = ""
    since: int = 0
    piece: int = -1
    log_prior: float = 0.0

    @property
    def place(self) -> tuple[str, int, int]:
        """A set of faults has one column of each place."""
        is_level = self.piece >= 0
        return FAULTS[self.fault].place, self.piece, self.since if is_level else 0

    @property
    def name(self) -> tuple[str, int, int]:
        """What is said of it: shapes of one name are summed."""
        return (self.fault, *self.place[1:])


def healthy(chain: Chain, known: Mapping[str, float], soc_pct: FloatArray) -> list[Column]:
    """Return what a healthy pack and gauge show; first the principal functions, then the zero.

    `known` holds the standard deviations of zero, voltage and capacity [%].
    """
    stretch = chain.blocks.stretch
    offset_pct, offset_v = chain.sensor("current_offset")
    return [
        *(Column(1.0, volts=each) for each in chain.function_columns(soc_pct).T),
        Column(known["zero"], shown=1.0),
        *(Column(FREE_PCT, stretch == k, stretch == k) for k in range(len(chain.stretches))),
        # A model is off in the same way on days that are alike: as much as from log to log.
        Column(1.0, volts=chain.level_v),
        Column(known["voltage"], volts=chain.sensor("voltage_gain")[1]),
        Column(chain.model.capacity_ah / 400.0, offset_pct, volts=offset_v),
        Column(known["capacity"], chain.sensor("capacity")[0]),
        *(Column(PIECE_PCT, shown=chain.piece == n) for n in _pieces(chain)),
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
    levels = {n: list(_levels(chain, n)) for n in _pieces(chain)}
    for shapes in levels.values():
        yield shapes, FAULTS["start_or_reset"].probability
    yield [each for n in levels for each in _levels_in_pauses(chain, n)], P_FAULT
    onsets = _onsets(chain)
    others = [*_counting(chain, onsets, soc_pct), *_of_voltage(chain, onsets, soc_pct)]
    for name in dict.fromkeys(each.fault for each in others):
        yield [each for each in others if each.fault == name], FAULTS[name].probability


def _pieces(chain: Chain) -> list[int]:
    """Return the numbers of the pieces."""
    return [int(number) for number in np.unique(chain.piece) if number >= 0]


def _onsets(chain: Chain) -> list[int]:
    """Return the stretches with which a fault of a sensor may begin: of the last eight, each.

    Further back, and within an unbroken record, where nothing marks the moment, it is found to a
    factor of two: the last two stretches, the last four, eight, sixteen, ….
    """
    found, number = [0], len(chain.stretches)
    for k, each in enumerate(chain.stretches[1:], start=1):
        back = number - k
        if back & (back - 1) == 0 or (back < LAST and not each.continues):
            found.append(k)
    return found


def _level(shown: BoolArray, piece: int, since: int) -> Column:
    (std,) = FAULTS["start_or_reset"].stds
    return Column(std, shown=shown, fault="start_or_reset", since=since, piece=piece)


def _levels(chain: Chain, piece: int) -> Iterator[Column]:
    """Yield a wrong level of one piece, of all from it on, and of all up to it."""
    numbers, last = chain.piece, int(chain.piece.max())
    since = int(chain.blocks.stretch[np.argmax(numbers == piece)])
    spans = {(piece, piece), (piece, last), (0 if piece < last else piece, piece)}
    for low, high in sorted(spans):
        yield _level((numbers >= low) & (numbers <= high), piece, since)


def _levels_in_pauses(chain: Chain, piece: int) -> Iterator[Column]:
    """Yield a level that is wrong from a pause within a piece on, or until it."""
    stretch, inside = chain.blocks.stretch, chain.piece == piece
    first, *later = np.unique(stretch[inside]).tolist()
    for pause in later:
        if not chain.stretches[pause].continues:
            yield _level(inside & (stretch >= pause), piece, pause)
            yield _level(inside & (stretch < pause), piece, first)


def _counting(chain: Chain, onsets: Sequence[int], soc_pct: FloatArray) -> Iterator[Column]:
    """Yield offsets of the current, wrong scales and capacities, and lags.

    An offset is in the gauge's count alone, or in the log's sensor as well. The error grows while
    the gauge logs, also while it does not, or within each log alone. A wrong scale is of the count
    alone, or the pack has another capacity. The gauge is right when a piece begins, when it is
    full, or when it is empty; or its error is of each log alone.
    """
    blocks, model = chain.blocks, chain.model
    in_stretch = blocks.stretch * (chain.piece.max() + 2) + chain.piece
    begins = []
    for numbers in (chain.piece, in_stretch):
        _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
        begins.append(first[inverse])
    begin, begin_in_stretch = begins
    lasts = [chain.samples.hours[each.samples.stop - 1] for each in chain.stretches]
    logged = blocks.hours + np.concatenate([[0.0], np.cumsum(lasts)])[blocks.stretch]
    stamped = (blocks.time_s - blocks.time_s[0]) / 3600.0
    soc, volts = chain.sensor("current_offset")
    for since in onsets:
        is_after = blocks.stretch >= since
        first = chain.stretches[since].blocks.start
        clocks = [np.maximum(clock, clock[first]) for clock in (logged, stamped, logged)]
        for std in FAULTS["current_offset"].stds:
            for clock, at in zip(clocks, (begin, begin, begin_in_stretch), strict=True):
                error = 100.0 / model.capacity_ah * (clock[at] - clock)
                one = Column(std * model.capacity_ah, shown=error, fault="current_offset")
                one = replace(one, since=since)
                yield one
                yield replace(
                    one, soc=soc * is_after, shown=error + soc * is_after, volts=volts * is_after
                )
    soc, volts = chain.sensor("capacity")
    (std,) = FAULTS["count_scale"].stds
    for right_pct in (soc_pct[begin], 100.0, 0.0, soc_pct[begin_in_stretch]):
        error = (soc_pct - right_pct) / 100.0
        yield Column(std, shown=error, fault="count_scale")
        yield Column(std, soc, error + soc, volts, fault="pack_capacity")
    yield Column(std, soc, soc, fault="model_capacity")
    for late_s in FAULTS["late"].stds:
        behind_pct = blocks.drawn_pct - chain.drawn_before(late_s)
        yield Column(late_s, shown=behind_pct / late_s, fault="late")


def _of_voltage(chain: Chain, onsets: Sequence[int], soc_pct: FloatArray) -> Iterator[Column]:
    """Yield a wrong voltage of the log, and a gauge that reads a table of voltages under load."""
    (std,), volts = FAULTS["voltage_sensor"].stds, chain.sensor("voltage_gain")[1]
    for since in onsets:
        is_after = chain.blocks.stretch >= since
        yield Column(std, volts=volts * is_after, fault="voltage_sensor", since=since)
    (std,) = FAULTS["voltage_table"].stds
    # Where the curve is flat, a tenth of its mean slope.
    least = 0.1 * float(np.ptp(chain.extended.model.pseudo_ocv([5.0, 95.0]))) / 90.0
    read_pct = chain.blocks.load_v / np.maximum(chain.slope(soc_pct), least)
    yield Column(std, shown=read_pct, fault="voltage_table")
