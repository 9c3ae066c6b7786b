"""The DBC files of the project: strict, complete, agreeing with recorded frames."""

from __future__ import annotations

import math
import warnings

import cantools.database
import pytest
from cantools.database.can import Database
from hypothesis import given, settings
from hypothesis import strategies as st

from cangauge._resources import shared_file
from cangauge.bus.database import signal_codec
from cangauge.bus.protection import CRC_ONLY_RULE, GENERIC_RULE, LEAF_RULE, E2eRule
from cangauge.bus.publish import reason_bits
from cangauge.types import Reason, Status

FILES = ("nissan_leaf.dbc", "generic_pack.dbc", "soc_estimate.dbc")


def database(name: str) -> Database:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = cantools.database.load_file(shared_file("dbc", name), strict=True)
    assert isinstance(found, Database)
    return found


@pytest.mark.parametrize("name", FILES)
def test_loads_strictly_with_a_comment_for_every_message(name: str) -> None:
    messages = database(name).messages
    assert messages
    assert all(message.comment for message in messages)
    assert len({message.frame_id for message in messages}) == len(messages)


@pytest.mark.parametrize("name", FILES)
def test_signal_names_are_unique(name: str) -> None:
    names = [
        signal.name
        for message in database(name).messages
        for signal in message.signals
        if signal.name != "soc_pct"
    ]
    assert len(set(names)) == len(names)


def test_leaf_frame_as_recorded() -> None:
    leaf = database("nissan_leaf.dbc")
    values = leaf.decode_message("BATTERY_1DB", bytes.fromhex("FDA0BAAA000001A8"), False)
    assert values["current_a"] == -9.5  # on the bus, negative = discharge
    assert values["voltage_v"] == 373.0
    assert values["main_relay_on"] == 1
    assert values["counter_1db"] == 1
    assert values["crc_1db"] == LEAF_RULE.crc(bytes.fromhex("FDA0BAAA00000100")) == 0xA8
    soc = leaf.decode_message("BATTERY_55B", bytes.fromhex("D8800000E7001123"))["soc_pct"]
    assert soc == pytest.approx(86.6, abs=1e-9)


def test_leaf_temperatures_are_multiplexed() -> None:
    leaf = database("nissan_leaf.dbc")
    for payload, name in (
        ("405068003a000000", "temperature_max_c"),
        ("805656003cd40002", "temperature_average_c"),
        ("c06060003ad40000", "temperature_min_c"),
    ):
        data = bytes.fromhex(payload)
        assert leaf.decode_message("BATTERY_5C0", data)[name] == data[2] / 2 - 40


def test_status_and_reasons_agree_with_the_estimator() -> None:
    soc = database("soc_estimate.dbc")
    message = soc.get_message_by_name("SOC_ESTIMATE")
    status = message.get_signal_by_name("status").choices
    assert status == {int(each): each.name.lower() for each in Status}
    reason = message.get_signal_by_name("reason")
    assert reason.length == 20
    for bit in range(20):
        assert f" {bit}: " in str(reason.comment)
    # What comes after the frame's bits shares one of them.
    assert list(Reason)[20:] == [Reason.SIGN_SUSPECT]
    assert reason_bits(Reason.SIGN_SUSPECT | Reason.CURRENT_GAP) == 1 << 12 | 1 << 1
    assert (message.frame_id, message.cycle_time) == (0x5A0, 100)
    detail = soc.get_message_by_name("SOC_DETAIL")
    assert (detail.frame_id, detail.cycle_time) == (0x5A1, 1000)
    assert message.get_signal_by_name("soc_pct").conversion.scale <= 0.01


@pytest.mark.parametrize("microseconds", [0, -10_000_000, 2**53, -(2**53)])
def test_replay_clock_holds_any_time(microseconds: int) -> None:
    soc = database("soc_estimate.dbc")
    data = soc.encode_message("REPLAY_CLOCK", {"log_time_us": microseconds, "crc_clock": 0})
    data = CRC_ONLY_RULE.protect(data, 0)
    decoded = soc.decode_message(0x5AF, data)
    assert decoded["log_time_us"] == microseconds
    assert decoded["crc_clock"] == CRC_ONLY_RULE.crc(data)


def test_counter_and_crc_are_where_the_rule_has_them() -> None:
    for message in database("generic_pack.dbc").messages:
        data = GENERIC_RULE.protect(bytes(message.length), 11)
        values = message.decode(data, decode_choices=False)
        counters = [value for key, value in values.items() if key.startswith("counter_")]
        assert counters == [11]
        crc = next(value for key, value in values.items() if key.startswith("crc_"))
        assert crc == data[-1]


@pytest.mark.parametrize("name", ["SOC_ESTIMATE", "SOC_DETAIL"])
def test_the_dbc_states_the_protection_of_published_frames(name: str) -> None:
    message = database("soc_estimate.dbc").get_message_by_name(name)
    attributes = message.dbc.attributes
    assert attributes["E2EProfile"].value == "02"
    data_ids = bytes.fromhex(attributes["E2EDataIdList"].value)
    assert len(set(data_ids)) == 16
    rule = E2eRule("e2e_02", data_ids=data_ids)
    values = message.decode(rule.protect(bytes(8), 11), decode_choices=False)
    assert next(value for key, value in values.items() if key.startswith("counter_")) == 11


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=60, deadline=None)
@given(data=st.binary(min_size=8, max_size=8))
def test_codec_agrees_with_cantools_on_every_signal(name: str, data: bytes) -> None:
    for message in _messages(name):
        payload = data[: message.length]
        try:
            expected = message.decode(payload, decode_choices=False)
        except cantools.database.DecodeError:
            continue  # a multiplexer with a value that no signal belongs to
        for signal in message.signals:
            codec = signal_codec(message, signal, source=name, field="")
            assert codec.is_in(payload) == (signal.name in expected)
            if signal.name not in expected:
                continue
            value, wanted = codec.decode(payload), float(expected[signal.name])
            if math.isnan(value):
                assert signal.conversion.choices is not None
                raw = (wanted - codec.offset) / codec.factor
                assert signal.conversion.choices[round(raw)] == "not available"
            else:
                assert value == wanted


_LOADED = {name: database(name).messages for name in FILES}


def _messages(name: str) -> list[cantools.database.Message]:
    return _LOADED[name]
