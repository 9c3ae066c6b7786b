"""Codecs of signals against cantools; the project's DBC files."""

from __future__ import annotations

import math
import pickle
import re
import tracemalloc
import warnings
from pathlib import Path

import cantools.database
import pytest
from cantools.database.can import Database, Message
from hypothesis import assume, given
from hypothesis import strategies as st

from cangauge._resources import shared_file
from cangauge.bus.database import MAX_DBC_BYTES, SignalCodec, load_dbc, signal_codec
from cangauge.bus.protection import RULES
from cangauge.bus.publish import reason_bits
from cangauge.errors import InputError, located
from cangauge.types import Reason, Status
from processor import at_most


def dbc(signals: str, length: int = 8, more: str = "") -> Message:
    text = f"BO_ 100 M: {length} X\n{signals}\n\n{more}"
    database = cantools.database.load_string(text, "dbc", strict=False)
    assert isinstance(database, Database)
    return database.messages[0]


def codec(signals: str, length: int = 8, more: str = "") -> SignalCodec:
    message = dbc(signals, length, more)
    with located("x.dbc", "current"):
        return signal_codec(message, message.get_signal_by_name("s"))


@st.composite
def layouts(draw: st.DrawFn) -> Message:
    start, width = draw(st.integers(0, 63)), draw(st.integers(1, 48))  # beyond, floats are inexact
    order, sign = draw(st.sampled_from("01")), draw(st.sampled_from("+-"))
    factor = draw(st.sampled_from(["1", "0.5", "0.1", "0.0001", "-2", "3"]))
    offset = draw(st.sampled_from(["0", "-40", "0.25"]))
    try:
        message = dbc(f' SG_ s : {start}|{width}@{order}{sign} ({factor},{offset}) [0|0] "" X')
        message.refresh(strict=True)
    except cantools.Error:
        assume(False)
    return message


@given(layouts(), st.binary(min_size=8, max_size=8))
def test_decodes_as_cantools_does_and_encoding_inverts_it(message: Message, data: bytes) -> None:
    found = signal_codec(message, message.signals[0])
    value = found.decode(data)
    assert value == message.decode(data)["s"]
    assert pickle.loads(pickle.dumps(found)).decode(data) == value  # noqa: S301 - our own
    payload, mask = bytearray(8), bytearray(8)
    found.encode_into(payload, value)
    found.field.put(mask, (1 << found.field.width) - 1)
    assert bytes(a & m for a, m in zip(data, mask, strict=True)) == bytes(payload)
    low, high = found.range
    assert low <= value <= high


@given(st.floats(-500, 500), st.sampled_from([0.5, 0.1, 0.0001, 7.0]))
def test_rounds_to_the_nearest_step(value: float, factor: float) -> None:
    found, payload = codec(f' SG_ s : 0|32@1- ({factor},3) [0|0] "A" X'), bytearray(8)
    found.encode_into(payload, value)
    decoded = found.decode(payload)
    assert abs(decoded - value) <= found.half_step * (1 + 1e-9)


@pytest.mark.parametrize(("width", "kind"), [(32, 1), (64, 2)])
def test_floats_are_exact(width: int, kind: int) -> None:
    signal = f' SG_ s : 0|{width}@1- (2,1) [0|0] "A" X'
    found, payload = codec(signal, more=f"SIG_VALTYPE_ 100 s : {kind};\n"), bytearray(8)
    for value in (0.0, -12.375, 300.25):
        found.encode_into(payload, value)
        assert found.decode(payload) == value
    found.field.put(payload, (1 << width) - 1)  # a NaN
    assert math.isnan(found.decode(payload))
    assert found.half_step == 0.0
    if width == 32:
        with pytest.raises(InputError, match="does not fit"):
            found.encode_into(payload, 1e39)


@pytest.mark.parametrize(
    "name", ["not available", "SNA", "NotAvailable", "invalid", "Signal_Invalid", "Init", "ERROR"]
)
def test_not_available_codes_of_value_tables(name: str) -> None:
    table = f'VAL_ 100 s 1023 "{name}" 3 "three" ;\n'
    found, payload = codec(' SG_ s : 7|10@0+ (0.5,0) [0|0] "V" X', more=table), bytearray(8)
    assert found.not_available == {1023}
    assert math.isnan(found.decode(bytes.fromhex("FFC0000000000000")))
    assert found.decode(bytes.fromhex("FF80000000000000")) == 511.0
    found.encode_into(payload, math.nan)
    assert payload.hex() == "ffc0000000000000"
    with pytest.raises(InputError, match="holds 0 to 511 V") as caught:
        found.encode_into(payload, 511.5)  # would read as "not available"
    assert caught.value.field == "s"


def test_an_enumeration_has_no_not_available_codes() -> None:
    table = 'VAL_ 100 s 0 "init" 1 "valid" 3 "invalid" ;\n'
    found = codec(' SG_ s : 0|2@1+ (1,0) [0|3] "" X', more=table)
    assert [found.decode(bytes([raw]) + bytes(7)) for raw in range(4)] == [0, 1, 2, 3]


def test_values_that_do_not_fit_are_refused() -> None:
    found, payload = codec(' SG_ s : 0|8@1- (1,0) [0|0] "A" X'), bytearray(8)
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
    present = [found.is_in(bytes([first, *bytes(7)])) for first in (0x21, 0x31, 0x22, 0x11)]
    assert present == [True, True, False, False]
    payload = bytearray(8)
    found.encode_into(payload, 77.0)
    assert (found.is_in(payload), found.decode(payload)) == (True, 77.0)


@pytest.mark.parametrize("layout", ["60|8@1+ (1,0)", "57|8@0+ (1,0)", "0|8@1+ (0,0)"])
def test_impossible_layouts_are_refused(layout: str) -> None:
    with pytest.raises(InputError, match=r"x\.dbc: current") as caught:
        codec(f' SG_ s : {layout} [0|0] "A" X')
    assert caught.value.value == "s"


# --- The project's files


def strictly(name: str) -> Database:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = cantools.database.load_file(shared_file("dbc", name), strict=True)
    assert isinstance(found, Database)
    return found


NAMES = sorted(path.name for path in shared_file("dbc", "soc_estimate.dbc").parent.glob("*.dbc"))
LOADED = {name: strictly(name) for name in NAMES}

# SavvyCAN reads line by line: what does not fit in one line in this form is not loaded.
NUMBER = r"[0-9.+\-eE]+"
SAVVYCAN = {
    "BO_ ": re.compile(r"BO_ \d+ \w+ ?: \d+ \w+"),
    "SG_ ": re.compile(
        rf"SG_ \w+( M| m\d+)? : \d+\|\d+@[01][+-] \({NUMBER},{NUMBER}\)"
        rf' \[{NUMBER}\|{NUMBER}\] ".*" \w.*'
    ),
    "CM_ ": re.compile(r'CM_ ((BO_|BU_) \w+ |SG_ \d+ \w+ )?"[^"]*";'),
    "VAL_ ": re.compile(r'VAL_ \d+ \w+ (-?\d+ "[^"]*" )+;'),
    "BA_DEF_ ": re.compile(r'BA_DEF_ ((BO_|SG_|BU_) )?"\w+" (INT|FLOAT|STRING|ENUM) ?.*;'),
}


@pytest.mark.parametrize("name", NAMES)
def test_a_file_is_complete_and_savvycan_reads_each_line(name: str) -> None:
    messages = LOADED[name].messages
    assert len({message.frame_id for message in messages}) == len(messages) > 0
    if name != "bmw_i3.dbc":
        assert all(message.comment for message in messages)
        names = [signal.name for message in messages for signal in message.signals]
        assert len(set(names) - {"soc_pct"}) == len([each for each in names if each != "soc_pct"])
    read = 0
    for line in shared_file("dbc", name).read_text(encoding="utf-8").splitlines():
        for begin, form in SAVVYCAN.items():
            if line.strip().startswith(begin):
                assert form.fullmatch(" ".join(line.split())), line
                read += 1
    assert read > 10


@pytest.mark.parametrize("name", NAMES)
@given(data=st.binary(min_size=8, max_size=8))
def test_codec_agrees_with_cantools_on_every_signal(name: str, data: bytes) -> None:
    for message in LOADED[name].messages:
        payload = data[: message.length]
        try:
            expected = message.decode(payload, decode_choices=False)
        except cantools.database.DecodeError:
            continue  # a multiplexer with a value that no signal belongs to, or a longer reply
        for signal in message.signals:
            found = signal_codec(message, signal)
            assert found.is_in(payload) == (signal.name in expected)
            if signal.name in expected:
                value, wanted = found.decode(payload), float(expected[signal.name])
                raw = round((wanted - found.offset) / found.factor)
                assert raw in found.not_available if math.isnan(value) else value == wanted


def test_leaf_frames_as_recorded() -> None:
    leaf = LOADED["nissan_leaf.dbc"]
    values = leaf.decode_message("BATTERY_1DB", bytes.fromhex("FDA0BAAA000001A8"), False)
    # On the bus, negative is discharge.
    assert (values["current_a"], values["voltage_v"]) == (-9.5, 373.0)
    assert (values["main_relay_on"], values["counter_1db"]) == (1, 1)
    assert values["crc_1db"] == RULES["leaf"].crc(bytes.fromhex("FDA0BAAA00000100")) == 0xA8
    soc = leaf.decode_message("BATTERY_55B", bytes.fromhex("D8800000E7001123"))["soc_pct"]
    assert soc == pytest.approx(86.6, abs=1e-9)


def test_published_frames_agree_with_the_estimator() -> None:
    soc = LOADED["soc_estimate.dbc"]
    message = soc.get_message_by_name("SOC_ESTIMATE")
    status = message.get_signal_by_name("status").choices
    assert status == {int(each): each.name.lower() for each in Status}
    reason = message.get_signal_by_name("reason")
    assert reason.length == 20
    # What comes after the frame's bits shares one of them.
    assert list(Reason)[20:] == [Reason.SIGN_SUSPECT]
    assert reason_bits(Reason.SIGN_SUSPECT | Reason.CURRENT_GAP) == 1 << 12 | 1 << 1
    assert all(f" {bit}: " in str(reason.comment) for bit in range(20))
    assert message.get_signal_by_name("soc_pct").conversion.scale <= 0.01
    for name, frame_id, cycle_ms in (("SOC_ESTIMATE", 0x5A0, 100), ("SOC_DETAIL", 0x5A1, 1000)):
        message = soc.get_message_by_name(name)
        assert (message.frame_id, message.cycle_time) == (frame_id, cycle_ms)
        assert message.dbc.attributes["E2EProfile"].value == "02"


def test_counter_and_crc_are_where_the_rule_has_them() -> None:
    for message in LOADED["generic_pack.dbc"].messages:
        data = RULES["generic"].protect(bytes(message.length), 11)
        values = message.decode(data, decode_choices=False)
        found = {key.partition("_")[0]: value for key, value in values.items()}
        assert (found["counter"], found["crc"]) == (11, data[-1])


@pytest.mark.parametrize("suffix", ["arxml", "kcd", "SYM"])
def test_other_databases_are_refused_with_their_conversion(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"car.{suffix}"
    path.write_text('<?xml version="1.0"?>\n<NetworkDefinition/>\n')
    with pytest.raises(InputError, match=r"python -m cantools convert .*car\.\w+ car\.dbc"):
        load_dbc(path)


@pytest.mark.parametrize("line", ["SG_MUL_VAL_ 256 B X 1-1;", "SG_MUL_VAL_ 256 B A 1-1;"])
def test_a_multiplexer_that_is_missing_or_its_own_is_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "x.dbc"
    path.write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: E\nBO_ 256 M: 8 E\n SG_ A m1M : 0|8@1+ (1,0) [0|0] "" E\n'
        f' SG_ B m1M : 8|8@1+ (1,0) [0|0] "" E\nSG_MUL_VAL_ 256 A B 1-1;\n{line}\n'
    )
    message = load_dbc(path).messages[0]
    with pytest.raises(InputError, match="multiplexer"):
        signal_codec(message, message.signals[0])


@pytest.mark.parametrize(
    "line",
    [
        'BO_ 1 M: 8 E\n SG_ A : 2566844926|8@0+ (1,0) [0|0] "" E\n',
        'BO_ 1 M: 8 E\n SG_ A : 0 | +99999999999@1- (1,0) [0|0] "" E\n',
        'BO_ 1 M: 3000000000 E\n SG_ A : 0|8@1+ (1,0) [0|0] "" E\n',
        'BO_ 1 M: 5000 E\n SG_ A : 0|8@1+ (1,0) [0|0] "" E\n',
        "SG_MUL_VAL_ 256 A B 1-2, 3-4000000000;\n",
        "SG_MUL_VAL_ 256 A B 4000000000-0, 0-4000000000;\n",
        f"SG_MUL_VAL_ 256 A B 1{'0' * 400}-{'9' * 401};\n",
    ],
    ids=["start", "length", "message", "bytes", "multiplexer", "reversed", "digits"],
)
def test_numbers_that_would_take_gigabytes_are_refused_before(tmp_path: Path, line: str) -> None:
    path = tmp_path / "x.dbc"
    path.write_text(f'VERSION ""\nNS_ :\nBS_:\nBU_: E\nBO_ 256 X: 8 E\n{line}')
    tracemalloc.start()
    with pytest.raises(InputError, match="more than"):
        load_dbc(path)
    assert tracemalloc.get_traced_memory()[1] < 2 * MAX_DBC_BYTES  # reading takes once that
    tracemalloc.stop()


def test_a_comment_may_hold_any_numbers(tmp_path: Path) -> None:
    (tmp_path / "x.dbc").write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: E\nBO_ 1 M: 8 E\n SG_ A : 0|8@1+ (1,0) [0|0] "" E\n'
        'CM_ BO_ 1 "40000|8@1 \\"SG_MUL_VAL_ 1-4000000000";\n'
    )
    assert load_dbc(tmp_path / "x.dbc").messages[0].name == "M"


PACK = (
    'VERSION ""\nNS_ :\nBS_:\nBU_: E\nBO_ 854 PACK: 8 E\n'
    ' SG_ U : 0|16@1+ (0.1,0) [0|0] "V" E\n SG_ I : 16|16@1- (0.1,0) [0|0] "A" E\n'
)


@pytest.mark.parametrize(
    ("lines", "remark"),
    [
        ('VAL_ 854 Renamed 1 "on;" 0 "off" ;\n', "of a signal that is gone: Renamed"),
        ('VAL_ 855 U 1 "on" ;\nSIG_VALTYPE_ 854 X : 1;\n', "of signals that are gone: U, X"),
        ('BO_ 3221225472 VECTOR__INDEPENDENT_SIG_MSG: 0 Vector__XXX\n'
         ' SG_ Old : 0|8@1+ (1,0) [0|0] "" E\nVAL_ 3221225472 Old 1 "on" ;\n', "gone: Old"),
        ('CM_ SG_ 854 U "VAL_ 854 Renamed 1;";\n', ""),
        ('BO_ 103727155 LEFT: 8 E\n SG_ A : 0|8@1+ (1,0) [0|0] "" E\n'
         'VAL_ 103727155 A 1 "on" ;\n', "more than 11 bits are taken as extended"),
    ],
    ids=["value", "type", "unassigned", "comment", "flag"],
)  # fmt: skip
def test_lines_that_editors_leave_are_read_over(tmp_path: Path, lines: str, remark: str) -> None:
    path, remarks = tmp_path / "x.dbc", list[str]()
    path.write_text(PACK + lines)
    read = load_dbc(path, remarks)
    assert [each.name for each in read.messages[0].signals] == ["U", "I"]
    assert all(each.is_extended_frame for each in read.messages[1:])
    assert len(remarks) == bool(remark)
    assert remark in "".join(remarks)


@pytest.mark.parametrize("pages", [2, 4, 256])
def test_nested_multiplexers_take_bounded_time(tmp_path: Path, pages: int) -> None:
    path, depth = tmp_path / "x.dbc", 12
    signals = [f' SG_ S{k} m0M : {2 * k}|2@1+ (1,0) [0|0] "" E\n' for k in range(1, depth)]
    lines = [f"SG_MUL_VAL_ 256 S{k} S{k - 1} 0-{pages - 1};\n" for k in range(1, depth)]
    path.write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: E\nBO_ 256 M: 64 E\n SG_ S0 M : 0|2@1+ (1,0) [0|0] "" E\n'
        + "".join(signals + lines)
    )
    with at_most(2.0):
        if pages == 2:
            assert len(load_dbc(path).messages[0].signals) == depth
        else:
            with pytest.raises(InputError, match="multiplexers select more than"):
                load_dbc(path)


@pytest.mark.parametrize(
    "text",
    [
        '"' + '\\"' * 400_000,
        '"' + '\\"' * 400_000 + "\\",
        "VAL_ 1 A 1 " * 90_000,
        "SG_MUL_VAL_ 1 A B 1-2 " * 60_000,
    ],
    ids=["quotes", "backslash", "values", "ranges"],
)
def test_a_damaged_text_is_refused_in_linear_time(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.dbc"
    path.write_text(f"{PACK}{text}")
    with at_most(4.0), pytest.raises(InputError):
        load_dbc(path)
