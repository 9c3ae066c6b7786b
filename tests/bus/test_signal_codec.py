"""Codec of one signal, against cantools."""

from __future__ import annotations

import math

import cantools.database
import numpy as np
import pytest
from cantools.database.can import Database, Message
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cangauge.bus.database import SignalCodec, signal_codec
from cangauge.errors import InputError


def dbc(signals: str, length: int = 8, more: str = "") -> Message:
    text = f"BO_ 100 M: {length} X\n{signals}\n\n{more}"
    database = cantools.database.load_string(text, "dbc", strict=False)
    assert isinstance(database, Database)
    return database.messages[0]


def codec(signals: str, length: int = 8, more: str = "", name: str = "s") -> SignalCodec:
    message = dbc(signals, length, more)
    return signal_codec(message, message.get_signal_by_name(name), source="x.dbc", field="current")


@st.composite
def layouts(draw: st.DrawFn) -> tuple[str, Message]:
    start, width = draw(st.integers(0, 63)), draw(st.integers(1, 64))
    order, sign = draw(st.sampled_from("01")), draw(st.sampled_from("+-"))
    factor = draw(st.sampled_from(["1", "0.5", "0.1", "0.0001", "-2", "3"]))
    offset = draw(st.sampled_from(["0", "-40", "0.25"]))
    try:
        message = dbc(f' SG_ s : {start}|{width}@{order}{sign} ({factor},{offset}) [0|0] "" X')
        message.refresh(strict=True)
    except cantools.Error:
        assume(False)
    return message.name, message


@settings(max_examples=300, deadline=None)
@given(layout=layouts(), data=st.binary(min_size=8, max_size=8))
def test_decodes_as_cantools_does(layout: tuple[str, Message], data: bytes) -> None:
    _, message = layout
    signal = message.signals[0]
    assume(signal.length <= 48)  # a float does not hold every raw number beyond 2^53
    found = signal_codec(message, signal, source="x", field="f")
    assert found.decode(data) == message.decode(data)["s"]


@settings(max_examples=300, deadline=None)
@given(layout=layouts(), data=st.binary(min_size=8, max_size=8))
def test_encoding_inverts_decoding_in_its_own_bits(
    layout: tuple[str, Message], data: bytes
) -> None:
    _, message = layout
    signal = message.signals[0]
    assume(signal.length <= 48)
    found = signal_codec(message, signal, source="x", field="f")
    value = found.decode(data)
    payload = bytearray(bytes(8))
    found.encode_into(payload, value)
    mask = bytearray(8)
    found.field.put(mask, (1 << signal.length) - 1)
    assert bytes(a & m for a, m in zip(data, mask, strict=True)) == bytes(payload)


@given(value=st.floats(-500, 500), factor=st.sampled_from([0.5, 0.1, 0.0001, 7.0]))
def test_rounds_to_the_nearest_step(value: float, factor: float) -> None:
    found = codec(f' SG_ s : 0|32@1- ({factor},3) [0|0] "A" X')
    payload = bytearray(8)
    found.encode_into(payload, value)
    decoded = found.decode(payload)
    assert abs(decoded - value) <= found.half_step * (1 + 1e-9)
    assert float(found.quantize(np.array([value]))[0]) == decoded


@pytest.mark.parametrize(("width", "kind"), [(32, 1), (64, 2)])
def test_floats_are_exact(width: int, kind: int) -> None:
    found = codec(
        f' SG_ s : 0|{width}@1- (2,1) [0|0] "A" X', more=f"SIG_VALTYPE_ 100 s : {kind};\n"
    )
    payload = bytearray(8)
    for value in (0.0, -12.375, 300.25):
        found.encode_into(payload, value)
        assert found.decode(payload) == value
        assert float(found.quantize(np.array([value]))[0]) == value
    found.field.put(payload, (1 << width) - 1)  # a NaN
    assert math.isnan(found.decode(payload))
    assert found.half_step == 0.0


@pytest.mark.parametrize(
    "name", ["not available", "SNA", "NotAvailable", "invalid", "Signal_Invalid", "Init", "ERROR"]
)
def test_not_available_codes_of_value_tables(name: str) -> None:
    found = codec(
        ' SG_ s : 7|10@0+ (0.5,0) [0|0] "V" X', more=f'VAL_ 100 s 1023 "{name}" 3 "three" ;\n'
    )
    assert found.not_available == {1023}
    assert math.isnan(found.decode(bytes.fromhex("FFC0000000000000")))
    assert found.decode(bytes.fromhex("FF80000000000000")) == 511.0
    payload = bytearray(8)
    found.encode_into(payload, math.nan)
    assert payload.hex() == "ffc0000000000000"
    with pytest.raises(InputError, match="holds 0 to 511 V") as caught:
        found.encode_into(payload, 511.5)  # would read as "not available"
    assert caught.value.field == "s"


def test_an_enumeration_has_no_not_available_codes() -> None:
    found = codec(
        ' SG_ s : 0|2@1+ (1,0) [0|3] "" X', more='VAL_ 100 s 0 "init" 1 "valid" 3 "invalid" ;\n'
    )
    assert [found.decode(bytes([raw]) + bytes(7)) for raw in range(4)] == [0, 1, 2, 3]


def test_values_that_do_not_fit_are_refused() -> None:
    found = codec(' SG_ s : 0|8@1- (1,0) [0|0] "A" X')
    payload = bytearray(8)
    for value in (128.0, -129.0, math.inf, math.nan):
        with pytest.raises(InputError):
            found.encode_into(payload, value)
    assert payload == bytes(8)
    found.encode_into(payload, -128.4)  # rounds into the range
    assert found.decode(payload) == -128.0


def test_nested_multiplexers_must_all_match() -> None:
    signals = """ SG_ top M : 0|4@1+ (1,0) [0|0] "" X
 SG_ sub m1M : 4|4@1+ (1,0) [0|0] "" X
 SG_ s m2 : 8|8@1+ (1,0) [0|0] "A" X"""
    found = codec(signals, more="SG_MUL_VAL_ 100 sub top 1-1;\nSG_MUL_VAL_ 100 s sub 2-3;\n")
    assert found.is_in(bytes([0x21, 5, 0, 0, 0, 0, 0, 0]))
    assert found.is_in(bytes([0x31, 5, 0, 0, 0, 0, 0, 0]))
    assert not found.is_in(bytes([0x22, 5, 0, 0, 0, 0, 0, 0]))
    assert not found.is_in(bytes([0x11, 5, 0, 0, 0, 0, 0, 0]))
    payload = bytearray(8)
    found.encode_into(payload, 77.0)
    assert found.is_in(payload)
    assert found.decode(payload) == 77.0


@pytest.mark.parametrize(
    "signal",
    [
        ' SG_ s : 60|8@1+ (1,0) [0|0] "A" X',
        ' SG_ s : 57|8@0+ (1,0) [0|0] "A" X',
        ' SG_ s : 0|8@1+ (0,0) [0|0] "A" X',
    ],
)
def test_impossible_layouts_are_refused(signal: str) -> None:
    with pytest.raises(InputError, match=r"x\.dbc: current") as caught:
        codec(signal)
    assert caught.value.value == "s"
