"""Layouts of CAN frames, and their encoding from signals on a time grid."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import can
import numpy as np

STEP_S = 0.01
"""Interval of the time grid [s]."""


@dataclass(frozen=True)
class Bits:
    """A signal of a frame, numbered as in a DBC."""

    start: int
    width: int
    motorola: bool
    scale: float
    offset: float = 0.0
    signed: bool = False

    def places(self) -> np.ndarray:
        """Return its bits, most significant first, in reading order from byte 0."""
        if self.motorola:
            first = 8 * (self.start // 8) + 7 - self.start % 8
            return np.arange(first, first + self.width)
        bits = np.arange(self.start + self.width - 1, self.start - 1, -1)
        return 8 * (bits // 8) + 7 - bits % 8

    def raw(self, payload: np.ndarray) -> np.ndarray:
        """Return its raw numbers in payloads (n, length), as signed integers where signed."""
        bits = np.unpackbits(payload, axis=1)[:, self.places()].astype(np.int64)
        code = bits @ (1 << np.arange(self.width - 1, -1, -1))
        return np.where(
            self.signed & (code >> (self.width - 1) == 1), code - (1 << self.width), code
        )


@dataclass
class Frame:
    """An id with its period, its signals by name, and its protection.

    `multiplexed` is a selector with the signals of each of its values, which follow in turn;
    `delay_s` is the age of the signals when the frame is sent.
    """

    number: int
    period_s: float
    length: int = 8
    signals: dict[str, Bits] = field(default_factory=dict)
    counter: Bits | None = None
    crc_byte: int | None = None
    constant: dict[Bits, int] = field(default_factory=dict)
    extended: bool = False
    multiplexed: tuple[Bits, tuple[dict[str, Bits], ...]] | None = None
    delay_s: float = 0.0


def encode(
    frames: Sequence[Frame], truth: Mapping[str, np.ndarray], rng: np.random.Generator
) -> Iterator[can.Message]:
    """Yield the frames of signals that are given each `STEP_S`, in time."""
    count = len(next(iter(truth.values())))
    rows = []
    for frame in frames:
        steps = np.arange(0, count, round(frame.period_s / STEP_S))
        payload = _payload(frame, np.maximum(steps - round(frame.delay_s / STEP_S), 0), truth)
        stamps = STEP_S * steps + rng.uniform(0.0, 0.004) + rng.normal(0.0, 2e-4, len(steps))
        rows += [
            (stamp, frame, data.tobytes()) for stamp, data in zip(stamps, payload, strict=True)
        ]
    rows.sort(key=lambda row: row[0])
    for stamp, frame, data in rows:
        yield can.Message(
            timestamp=stamp,
            arbitration_id=frame.number,
            is_extended_id=frame.extended,
            data=data,
            is_fd=frame.length > 8,
        )


def _payload(frame: Frame, steps: np.ndarray, truth: Mapping[str, np.ndarray]) -> np.ndarray:
    bits = np.zeros((len(steps), 8 * frame.length), np.uint8)
    for name, where in frame.signals.items():
        _put(bits, where, quantized(truth[name][steps], where))
    if frame.multiplexed is not None:
        selector, parts = frame.multiplexed
        turn = np.arange(len(steps)) % len(parts)
        _put(bits, selector, turn)
        for value, signals in enumerate(parts):
            mine = np.flatnonzero(turn == value)
            part = bits[mine]
            for name, where in signals.items():
                _put(part, where, quantized(truth[name][steps[mine]], where))
            bits[mine] = part
    for where, raw in frame.constant.items():
        _put(bits, where, np.full(len(steps), raw))
    if frame.counter is not None:
        _put(bits, frame.counter, np.arange(len(steps)))
    payload = np.packbits(bits, axis=1)
    if frame.crc_byte is not None:
        payload[:, frame.crc_byte] = 0
        crc = np.full(len(payload), 0xFF, np.uint8)
        for byte in range(frame.length):
            crc = _TABLE[crc ^ payload[:, byte]]
        payload[:, frame.crc_byte] = crc
    return payload


def quantized(values: np.ndarray, where: Bits) -> np.ndarray:
    """Return raw numbers, held within the range of the signal."""
    raw = np.rint((values - where.offset) / where.scale).astype(np.int64)
    if where.signed:
        return np.clip(raw, -(1 << (where.width - 1)), (1 << (where.width - 1)) - 1)
    return np.clip(raw, 0, (1 << where.width) - 1)


def _put(bits: np.ndarray, where: Bits, raw: np.ndarray) -> None:
    shifts = np.arange(where.width - 1, -1, -1)
    bits[:, where.places()] = (raw[:, None] >> shifts) & 1


def _crc_table() -> np.ndarray:
    """Return the table of the CRC-8 of SAE J1850 without its final complement."""
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value << 1) ^ (0x2F if value & 0x80 else 0)
        table.append(value & 0xFF)
    return np.array(table, np.uint8)


_TABLE = _crc_table()
