"""What a vehicle is once its mapping is bound to its DBC: signals ready to decode and encode."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from cangauge.bus.protection import Protection
from cangauge.bus.signal_checks import SignalChecks
from cangauge.bus.signal_codec import SignalCodec
from cangauge.logs.log import FloatArray, TemperatureSource

Role = Literal["current", "voltage", "temperature", "soc_reference"]
EXTENDED: Final = 1 << 31
"""Added to an extended id, as SocketCAN does, so that it differs from the standard one."""


@dataclass(frozen=True, slots=True)
class BoundSignal:
    """One of a vehicle's signals: where it is in which frame, and what it means.

    Parameters
    ----------
    role : {"current", "voltage", "temperature", "soc_reference"}
    key : int
        Arbitration id, plus `EXTENDED` for an extended one.
    message : str
        Name of the message.
    length : int
        Bytes of the message.
    codec : SignalCodec
    gain, offset : float
        value = gain × (value in the DBC's unit) + offset, in A (positive = discharge), V, °C, %.
    checks : SignalChecks
        When its values are believed.
    """

    role: Role
    key: int
    message: str
    length: int
    codec: SignalCodec
    gain: float
    offset: float
    checks: SignalChecks = field(default_factory=SignalChecks)

    def decode(self, payload: bytes | bytearray) -> float:
        """Return the value in A, V, °C or % of a payload of `length` bytes; NaN: not available."""
        return self.gain * self.codec.decode(payload) + self.offset

    def encode_into(self, payload: bytearray, value: float) -> None:
        """Set the value in A, V, °C or %; NaN becomes "not available".

        Raises
        ------
        InputError
            If it does not fit.
        """
        self.codec.encode_into(payload, (value - self.offset) / self.gain)

    def quantise(self, values: FloatArray) -> FloatArray:
        """Return what `decode` gives after `encode_into`, for every value."""
        dbc_values = self.codec.quantise((np.asarray(values) - self.offset) / self.gain)
        return np.asarray(self.gain * dbc_values + self.offset)

    def fits(self, values: FloatArray) -> NDArray[np.bool_]:
        """Return which values `encode_into` takes; NaN counts as one that it does."""
        return self.codec.fits((np.asarray(values) - self.offset) / self.gain)

    @property
    def half_step(self) -> float:
        """Largest error of rounding in a frame, in A, V, °C or %; 0 for floats."""
        return abs(self.gain) * self.codec.half_step

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest value that a frame can carry, in A, V, °C or %."""
        ends = [self.gain * end + self.offset for end in self.codec.range]
        return min(ends), max(ends)

    @property
    def arbitration_id(self) -> int:
        """The id without the mark of extended ones."""
        return self.key & ~EXTENDED

    @property
    def is_extended(self) -> bool:
        """Whether the id has 29 bits."""
        return bool(self.key & EXTENDED)


@dataclass(frozen=True, slots=True)
class MessageRule:
    """Protection and period of one message."""

    rule: Protection | None
    period_s: float | None


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle's signals, ready to decode and encode.

    Parameters
    ----------
    name : str
    current, voltage : BoundSignal
    temperature, soc_reference : BoundSignal or None
    fixed_temperature_c : float
        Temperature where no signal gives it [°C]; NaN: none.
    temperature_source : {"cell", "pack", "coolant", "room", "unknown"}
    pair_within_s : float
        Current and voltage at most this far apart in bus time belong together [s].
    messages : dict of int to MessageRule
        By key (id, plus `EXTENDED`), for every message with a wanted signal.
    dbc_files : tuple of str
    """

    name: str
    current: BoundSignal
    voltage: BoundSignal
    temperature: BoundSignal | None
    soc_reference: BoundSignal | None
    fixed_temperature_c: float
    temperature_source: TemperatureSource
    pair_within_s: float
    messages: dict[int, MessageRule]
    dbc_files: tuple[str, ...]

    @property
    def signals(self) -> tuple[BoundSignal, ...]:
        """All signals that there are: current, voltage, temperature, reference SoC."""
        found = (self.current, self.voltage, self.temperature, self.soc_reference)
        return tuple(signal for signal in found if signal is not None)

    @property
    def wanted_ids(self) -> tuple[int, ...]:
        """Arbitration ids that carry a wanted signal, each once."""
        return tuple(dict.fromkeys(signal.arbitration_id for signal in self.signals))

    @property
    def filters(self) -> list[dict[str, int | bool]]:
        """The wanted ids as filters of python-can (`bus.set_filters`), for the kernel."""
        keys = dict.fromkeys(signal.key for signal in self.signals)
        return [
            {
                "can_id": key & ~EXTENDED,
                "can_mask": 0x1FFFFFFF if key & EXTENDED else 0x7FF,
                "extended": bool(key & EXTENDED),
            }
            for key in keys
        ]
