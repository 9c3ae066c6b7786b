"""The profiles of AUTOSAR's end-to-end protection, checked by the library `autosar-e2e`.

A header of CRC and counter (in some profiles also length and data id) stands in the payload; the
CRC covers the data id too, so that a frame sent under a wrong id is refused. Layouts and CRCs:
AUTOSAR FO, "Specification of SW-C End-to-End Communication Protection Library" and "E2E Protocol
Specification".

Which frame can carry which: profiles 1, 2, 5, 6 and 11 fit into 8 bytes; 4 (header of 12 bytes)
and 7 (of 20) need CAN FD.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, Literal

from e2e import p01, p02, p04, p05, p06, p07, p11

from cangauge.errors import InputError

DataIdMode = Literal["both", "alternating", "low", "nibble"]

LIST_LENGTH: Final = 16
"""Data ids in the list of profile 2, one for each value of the counter."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Where a profile's counter stands, and what checks it.

    Parameters
    ----------
    header : int
        Bytes of the header.
    counter_at, counter_bytes : int
        First byte of the counter in the header, its number of bytes (big-endian); 0 bytes: the
        low half of that byte.
    modulus : int
        Values of the counter: profiles 1 and 11 leave 15 out.
    id_bits : int
        Width of the data id; 0: a list of 16 bytes.
    modes : mapping of str to int
        How the data id can enter the CRC, where there is a choice.
    check, protect : callable
        Of the library.
    """

    header: int
    counter_at: int
    counter_bytes: int
    modulus: int
    id_bits: int
    modes: MappingProxyType[str, int]
    check: Callable[..., bool]
    protect: Callable[..., None]


_NONE: Final = MappingProxyType[str, int]({})
PROFILES: Final = MappingProxyType(
    {
        "e2e_01": Profile(
            2, 1, 0, 15, 16,
            MappingProxyType({
                "both": p01.E2E_P01_DATAID_BOTH,
                "alternating": p01.E2E_P01_DATAID_ALT,
                "low": p01.E2E_P01_DATAID_LOW,
                "nibble": p01.E2E_P01_DATAID_NIBBLE,
            }),
            p01.e2e_p01_check, p01.e2e_p01_protect,
        ),
        "e2e_02": Profile(2, 1, 0, 16, 0, _NONE, p02.e2e_p02_check, p02.e2e_p02_protect),
        "e2e_04": Profile(12, 2, 2, 1 << 16, 32, _NONE, p04.e2e_p04_check, p04.e2e_p04_protect),
        "e2e_05": Profile(3, 2, 1, 256, 16, _NONE, p05.e2e_p05_check, p05.e2e_p05_protect),
        "e2e_06": Profile(5, 4, 1, 256, 16, _NONE, p06.e2e_p06_check, p06.e2e_p06_protect),
        "e2e_07": Profile(20, 12, 4, 1 << 32, 32, _NONE, p07.e2e_p07_check, p07.e2e_p07_protect),
        "e2e_11": Profile(
            2, 1, 0, 15, 16,
            MappingProxyType({
                "both": p11.E2E_P11_DATAID_BOTH,
                "nibble": p11.E2E_P11_DATAID_NIBBLE,
            }),
            p11.e2e_p11_check, p11.e2e_p11_protect,
        ),
    }
)  # fmt: skip
"""By the name that a mapping takes."""


@dataclass(frozen=True, slots=True)
class E2eRule:
    """Protection of a message by a profile.

    Parameters
    ----------
    name : str
        One of `PROFILES`.
    data_id : int
        Of every profile but 2.
    data_ids : bytes
        The 16 data ids of profile 2, one for each value of the counter.
    data_id_mode : {"both", "alternating", "low", "nibble"}
        How the data id enters the CRC, in profiles 1 and 11 (only "both", "nibble").
    header_byte : int
        Where the header begins; always 0 in profile 2.
    protected_bytes : int
        So many bytes are protected; 0: the whole payload.

    Raises
    ------
    InputError
        If the profile is not known, or cannot have these figures.
    """

    name: str
    data_id: int = 0
    data_ids: bytes = b""
    data_id_mode: DataIdMode = "both"
    header_byte: int = 0
    protected_bytes: int = 0
    _profile: Profile = field(init=False, repr=False, compare=False)
    _arguments: dict[str, Any] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        profile = PROFILES.get(self.name)
        if profile is None:
            raise InputError(
                "unknown profile", field="protection", value=self.name,
                cure=f"known are {', '.join(PROFILES)}",
            )  # fmt: skip
        self._check(profile)
        arguments: dict[str, Any] = {"length": self.protected_bytes}
        if profile.id_bits:
            arguments["offset"] = self.header_byte
        if profile.modes:
            arguments["data_id_mode"] = profile.modes[self.data_id_mode]
        object.__setattr__(self, "_profile", profile)
        object.__setattr__(self, "_arguments", arguments)

    def _check(self, profile: Profile) -> None:
        if profile.id_bits:
            _require(0 <= self.data_id < 1 << profile.id_bits, "data_id", self.data_id,
                     f"{self.name} has a data id of {profile.id_bits} bits")  # fmt: skip
            _require(not self.data_ids, "data_id_list", None, f"{self.name} has one data id")
        else:
            _require(len(self.data_ids) == LIST_LENGTH, "data_id_list", len(self.data_ids),
                     f"{self.name} has a list of {LIST_LENGTH} data ids")  # fmt: skip
            _require(not self.header_byte, "header_byte", self.header_byte,
                     f"the header of {self.name} begins at byte 0")  # fmt: skip
        modes = profile.modes or {"both": 0}
        _require(self.data_id_mode in modes, "data_id_mode", self.data_id_mode,
                 f"{self.name} has {', '.join(modes)}")  # fmt: skip
        _require(self.header_byte >= 0, "header_byte", self.header_byte, "must not be negative")
        least = self.header_byte + profile.header
        _require(self.protected_bytes == 0 or self.protected_bytes >= least, "protected_bytes",
                 self.protected_bytes, f"must hold the header: at least {least}")  # fmt: skip

    @property
    def modulus(self) -> int:
        """How many values the counter has."""
        return self._profile.modulus

    def fits(self, length: int) -> bool:
        """Return whether a payload of so many bytes has room for header and protected bytes."""
        return length >= max(self.header_byte + self._profile.header, self.protected_bytes)

    def is_whole(self, data: bytes | bytearray) -> bool:
        """Return whether header and CRC agree, and the counter is one that there is."""
        if isinstance(data, bytes):
            data = bytearray(data)  # some of the library's checks take nothing else
        return (
            self._profile.check(data, self.data_ids or self.data_id, **self._arguments)
            and self.counter(data) < self._profile.modulus
        )

    def counter(self, data: bytes | bytearray) -> int:
        """Return the counter of a payload."""
        profile = self._profile
        place = self.header_byte + profile.counter_at
        if not profile.counter_bytes:
            return data[place] & 0x0F
        return int.from_bytes(data[place : place + profile.counter_bytes], "big")

    def protect(self, data: bytes | bytearray, counter: int) -> bytes:
        """Return the payload with header, counter (taken modulo its width) and CRC set."""
        profile = self._profile
        out = bytearray(data)
        place = self.header_byte + profile.counter_at
        counter %= profile.modulus
        if profile.counter_bytes:
            end = place + profile.counter_bytes
            out[place:end] = counter.to_bytes(profile.counter_bytes, "big")
        else:
            out[place] = out[place] & 0xF0 | counter
        profile.protect(
            out, self.data_ids or self.data_id, increment_counter=False, **self._arguments
        )
        return bytes(out)


def _require(holds: bool, name: str, value: object, problem: str) -> None:
    if not holds:
        raise InputError(problem, field=name, value=value)
