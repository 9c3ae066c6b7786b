"""A message with a counter, and no CRC that is known: repeated frames are refused, losses seen."""

from __future__ import annotations

from dataclasses import dataclass

from cangauge.bus.signal_codec import Field
from cangauge.errors import InputError


@dataclass(frozen=True, slots=True)
class CounterRule:
    """A counter that is a signal of the DBC.

    Parameters
    ----------
    name : str
    field : Field
        Where the counter is.
    length : int
        Bytes of the message.
    modulus : int
        How many values the counter has: it counts 0 … `modulus` − 1.

    Raises
    ------
    InputError
        If the counter's bits cannot hold so many values.
    """

    name: str
    field: Field
    length: int
    modulus: int

    def __post_init__(self) -> None:
        most = 1 << self.field.width
        if not 3 <= self.modulus <= most:
            raise InputError(
                f"a counter of {self.field.width} bits has 3 to {most} values"
                if most >= 3
                else "a counter of one bit tells too little",
                field=f"{self.name}.counter_modulus",
                value=self.modulus,
            )

    def fits(self, length: int) -> bool:
        """Return whether a payload of so many bytes is the message's."""
        return length == self.length

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether the counter is one that there is; more is not known."""
        return self.field.get(data) < self.modulus

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload."""
        return self.field.get(data)

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with the counter set."""
        out = bytearray(data)
        self.field.put(out, counter % self.modulus)
        return bytes(out)
