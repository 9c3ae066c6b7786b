"""What may be wrong with a gauge, its log or its pack: one table, and a column of each shape.

A `Column` is a quantity of the linear model: what a unit of it adds to the true SoC, to the
published one and to the voltage. A healthy pack has some of small standard deviation. A fault is
one of large standard deviation and small prior probability, with a column for each shape that it
may have: since when it is there, and what sets the gauge right in between.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from cangauge._typing import BoolArray, FloatArray, IntArray
from cangauge.extras.judge.chain import Chain

LAST: Final = 8
"""Logs of which each may be the first with a fault of a sensor: twelve columns for each."""
P_FAULT: Final = 0.05
"""Prior probability of most faults."""


class Kind(NamedTuple):
    """A row of the table of faults, which says what each field is."""

    place: str
    unit: str
    next_step: str
    stds: Sequence[float] = ()
    words: str = ""
    sides: Sequence[str] = ("", "")
    digits: int = 1
    probability: float = P_FAULT
    is_of_count: bool = True


_TABLE: Final = tomllib.loads(Path(__file__).with_name("faults.toml").read_text(encoding="utf-8"))
OTHERWISE: Final[Mapping[str, str]] = _TABLE.pop("otherwise")
"""What to do next where no fault says it."""
FAULTS: Final = {name: Kind(**row) for name, row in _TABLE.items()}


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
    right_at : array of shape (blocks,), or float, optional
        Of an error of scale: the block, or the SoC [%], at which the gauge is right. A unit adds
        1 % of the distance from there to `shown`.
    """

    std: float
    soc: FloatArray | BoolArray | float = 0.0
    shown: FloatArray | BoolArray | float = 0.0
    volts: FloatArray | float = 0.0
    fault: str = ""
    since: int = 0
    piece: int = -1
    log_prior: float = 0.0
    right_at: IntArray | float | None = None

    @property
    def name(self) -> tuple[str, int, int]:
        """What is said of it: shapes of one name are summed."""
        return self.fault, self.piece, self.since if self.piece >= 0 else 0

    @property
    def place(self) -> tuple[str, int, int]:
        """A set of faults has one column of each place."""
        return FAULTS[self.fault].place, *self.name[1:]


def healthy(chain: Chain, known: Mapping[str, float]) -> list[Column]:
    """Return what a healthy pack and gauge show; first the principal functions, then the zero.

    `known` holds the standard deviations of zero, voltage and capacity [%]. What the functions add
    to the voltage depends on the SoC.
    """
    offset_pct, offset_v = chain.sensor("current_offset")
    stretches = [chain.blocks.stretch == k for k in range(len(chain.stretches))]
    return [
        *(Column(1.0) for _ in range(chain.functions.number)),
        Column(known["zero"], shown=1.0),
        *(Column(60.0, each, each) for each in stretches),  # the SoC at its start is unknown
        # A model is off in the same way on days that are alike: as much as from log to log.
        Column(1.0, volts=chain.level_v),
        Column(known["voltage"], volts=chain.sensor("voltage_gain")[1]),
        Column(chain.model.capacity_ah / 400.0, offset_pct, volts=offset_v),
        Column(known["capacity"], chain.sensor("capacity")[0]),
        *(Column(0.5, shown=chain.piece == n) for n in _pieces(chain)),  # a level that is right
    ]


def faults(chain: Chain) -> list[Column]:
    """Return everything that may be wrong, in all its shapes, with their prior probabilities."""
    pieces = _pieces(chain)
    families = [(list(_levels(chain, n)), FAULTS["start_or_reset"].probability) for n in pieces]
    families.append(([each for n in pieces for each in _levels_in_pauses(chain, n)], P_FAULT))
    others = [*_offsets(chain), *_counts(chain), *_of_voltage(chain)]
    for name in dict.fromkeys(each.fault for each in others):
        of_name = [each for each in others if each.fault == name]
        families.append((of_name, FAULTS[name].probability))
    found = []
    for shapes, probability in families:
        odds = np.log(probability / (1.0 - probability))
        # Half of it began before the first log.
        early = sum(shape.since == 0 for shape in shapes)
        late = len(shapes) - early
        for shape in shapes:
            count = (late if shape.since else early) * (2.0 if early and late else 1.0)
            found.append(replace(shape, log_prior=float(odds - np.log(count))))
    return found


def _pieces(chain: Chain) -> list[int]:
    """Return the numbers of the pieces."""
    return [int(number) for number in np.unique(chain.piece) if number >= 0]


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


def _level(shown: BoolArray, piece: int, since: int) -> Column:
    (std,) = FAULTS["start_or_reset"].stds
    return Column(std, shown=shown, fault="start_or_reset", since=since, piece=piece)


def _onsets(chain: Chain) -> Iterator[tuple[int, BoolArray]]:
    """Yield the stretches with which a fault of a sensor may begin, and the blocks from then on.

    Of the last eight logs that is each. Further back, and within an unbroken record, where nothing
    marks the moment, it is found to a factor of two: the last two stretches, the last four, eight,
    sixteen, ….
    """
    for back in range(len(chain.stretches), 0, -1):
        k = len(chain.stretches) - back
        is_log = back < LAST and not chain.stretches[k].continues
        if k == 0 or is_log or back & (back - 1) == 0:
            yield k, chain.blocks.stretch >= k


def _begins(numbers: IntArray) -> IntArray:
    """Return the first block with the number of each block."""
    _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    return np.asarray(first[inverse])


def _in_stretches(chain: Chain) -> IntArray:
    """Return a number for each piece in each stretch."""
    return np.asarray(chain.blocks.stretch * (chain.piece.max() + 2) + chain.piece)


def _offsets(chain: Chain) -> Iterator[Column]:
    """Yield offsets of the current: in the gauge's count alone, or in the log's sensor as well.

    The error grows while the gauge logs, also while it does not, or within each log alone: a gauge
    that is right when it starts.
    """
    blocks, capacity_ah = chain.blocks, chain.model.capacity_ah
    lasts = [chain.samples.hours[each.samples.stop - 1] for each in chain.stretches]
    logged = blocks.hours + np.concatenate([[0.0], np.cumsum(lasts)])[blocks.stretch]
    stamped = (blocks.time_s - blocks.time_s[0]) / 3600.0
    begin, soc, volts = _begins(chain.piece), *chain.sensor("current_offset")
    shapes = [(logged, begin), (stamped, begin), (logged, _begins(_in_stretches(chain)))]
    for since, is_after in _onsets(chain):
        for std in FAULTS["current_offset"].stds:
            for hours, right_at in shapes:
                clock = np.maximum(hours, hours[np.argmax(is_after)])
                error = 100.0 / capacity_ah * (clock[right_at] - clock)
                of_count = Column(std * capacity_ah, 0.0, error, 0.0, "current_offset", since)
                yield of_count
                yield replace(
                    of_count,
                    soc=soc * is_after,
                    shown=error + soc * is_after,
                    volts=volts * is_after,
                )


def _counts(chain: Chain) -> Iterator[Column]:
    """Yield wrong scales of the count, other capacities of the pack, and lags.

    The gauge is right when a piece begins, when it is full, or when it is empty; or its error is of
    each log alone.
    """
    (std,), (soc, volts) = FAULTS["count_scale"].stds, chain.sensor("capacity")
    for right_at in (_begins(chain.piece), 100.0, 0.0, _begins(_in_stretches(chain))):
        yield Column(std, fault="count_scale", right_at=right_at)
        yield Column(std, soc, soc, volts, "pack_capacity", right_at=right_at)
    yield Column(std, soc, soc, fault="model_capacity")
    for late_s in FAULTS["late"].stds:
        behind_pct = chain.blocks.drawn_pct - chain.drawn_before(late_s)
        yield Column(late_s, shown=behind_pct / late_s, fault="late")


def _of_voltage(chain: Chain) -> Iterator[Column]:
    """Yield a wrong voltage of the log, and a gauge that reads a table of voltages under load.

    Such a gauge is at the SoC at which the voltage fits.
    """
    (std,), (_, volts) = FAULTS["voltage_sensor"].stds, chain.sensor("voltage_gain")
    for since, is_after in _onsets(chain):
        yield Column(std, volts=volts * is_after, fault="voltage_sensor", since=since)
    (std,) = FAULTS["voltage_table"].stds
    # Where the curve is flat, a tenth of its mean slope.
    least = 0.1 * float(np.ptp(chain.extended.model.pseudo_ocv([5.0, 95.0]))) / 90.0
    read_pct = chain.blocks.load_v / np.maximum(chain.slope(chain.fitting_pct), least)
    yield Column(std, shown=read_pct, fault="voltage_table")
