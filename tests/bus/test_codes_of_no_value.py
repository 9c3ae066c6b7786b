"""Codes without a value, written as the bits are or as the number that they mean."""

from __future__ import annotations

import math
import struct

import cantools.database
import pytest
from cantools.database.can import Database

from cangauge.bus.database import SignalCodec, signal_codec
from cangauge.errors import InputError


def codec(kind: str, *codes: int, more: str = "") -> SignalCodec:
    text = f'BO_ 100 M: 8 X\n SG_ s : {kind} (0.1,0) [0|0] "A" X\n\n{more}'
    database = cantools.database.load_string(text, "dbc", strict=False)
    assert isinstance(database, Database)
    message = database.messages[0]
    signal = message.get_signal_by_name("s")
    return signal_codec(message, signal, not_available=tuple(codes))


@pytest.mark.parametrize("code", [0x8000, -0x8000])
def test_a_code_of_a_signed_signal_may_be_written_as_its_bits(code: int) -> None:
    of_map, of_dbc = codec("0|16@1-", code), codec("0|16@1-", more=f'VAL_ 100 s {code} "SNA" ;')
    for found in (of_map, of_dbc):
        assert math.isnan(found.decode(struct.pack("<h6x", -0x8000)))
        assert found.decode(struct.pack("<h6x", -0x7FFF)) == pytest.approx(-3276.7)
        payload = bytearray(8)
        found.encode_into(payload, math.nan)
        assert payload == struct.pack("<h6x", -0x8000)
    assert math.isnan(codec("0|16@1-", 0xFFFF).decode(b"\xff" * 8))


@pytest.mark.parametrize(
    ("kind", "code", "ends"),
    [("0|16@1-", 0x10000, "-32768 to 65535"), ("0|16@1-", -0x8001, "-32768 to 65535"),
     ("0|12@1+", 4096, "0 to 4095"), ("0|12@1+", -1, "0 to 4095")],
)  # fmt: skip
def test_a_code_that_cannot_occur_is_refused(kind: str, code: int, ends: str) -> None:
    with pytest.raises(InputError, match="never has this code") as caught:
        codec(kind, code)
    assert caught.value.field == "not_available"
    assert caught.value.value == code
    assert ends in str(caught.value)
    # In a value table it means nothing: the file is often of a tool.
    assert not codec(kind, more=f'VAL_ 100 s {code} "SNA" ;').not_available


def test_a_float_has_no_codes() -> None:
    with pytest.raises(InputError, match="a float has no codes"):
        codec("0|32@1-", 0xFFFF, more="SIG_VALTYPE_ 100 s : 1;")
