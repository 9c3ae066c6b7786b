"""Broken, unusual and hostile DBC files: refused quickly, in one line."""

from __future__ import annotations

import contextlib
import time
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cangauge._io import MAX_DBC_BYTES
from cangauge.bus.database import load_dbc
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError

GOOD = 'BO_ 256 M: 8 X\n SG_ s : 0|8@1+ (1,0) [0|0] "A" X\n'


def load(folder: Path, content: bytes) -> None:
    path = folder / "x.dbc"
    path.write_bytes(content)
    load_dbc(path)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("BO_ 1 X: 100000000 Y\n", "a message that is too long"),
        ("BO_\t1\tX\t:\t100000000Y\n", "a message that is too long"),
        ("BS_:500:1,2BO_ 1X:100000000 Y\n", "a message that is too long"),
        ("BO_ 1 X: " + "9" * 5000 + " Y\n", "a message that is too long"),
        ('BO_ 1 X: 8 Y\n SG_ a : 0|800000000@1+ (1,0) [0|1] "" Y\n', "signal that is too long"),
        ('BO_ 1 X: 8 Y\n SG_ a m3 : 100000000|8@0+ (1,0) [0|1] "" Y\n', "start bit out of range"),
        ('BO_ 1 X: 8 Y\n SG_ a : -2147483649|8@1+ (1,0) [0|1] "" Y\n', "start bit out of range"),
        ('BO_ 1 X: 8 Y\n SG_ a : 0|-100000000@0+ (1,0) [0|1] "" Y\n', "signal that is too long"),
        ("BO_ 1 X: -8 Y\n", "a message that is too long"),
        ("BO_ 1 X: +100000000 Y\n", "a message that is too long"),
        ("BO_ 1 X: // here:\n 100000000 Y\n", "a message that is too long"),
        (
            'BO_ 1 X: 8 Y\n SG_ a m0 : 0|8@1+ (1,0) [0|1] "" Y\n SG_ M M : 8|8@1+ (1,0) [0|1] "" Y'
            '\n SG_ x y : 16|8@1+ (1,0) [0|1] "" Y\n',
            "not a DBC",
        ),
        (GOOD + "SG_MUL_VAL_ 256 s s 0-4000000000;\n", "too many multiplexer values"),
        (GOOD + "SG_MUL_VAL_ 256 s s " + "0-60000, " * 9 + "0-1;\n", "too many multiplexer"),
        ("BO_ 1 X: 8 Y\n" * 30_000, "more than 20000 messages"),
        ("BO_ 1 X: 8 Y\n" * 400_000, "larger than the 4 MB"),
        (
            GOOD + "SG_MUL_VAL_ 256 s s 0-" + "9" * 5000 + ";\n",
            "value that is too large",
        ),
        ("SG_ " * 100_000, "not a DBC"),
        ("SG_ " + "a" * 1_000_000, "not a DBC"),
        ("BO_ " + "1" * 1_000_000, "not a DBC"),
        ("SG_MUL_VAL_ " * 50_000, "not a DBC"),
        ("SG_MUL_VAL_ " + "1" * 1_000_000, "not a DBC"),
        ("BO_ x", "not a DBC"),
        ("time_s,current_a\n0,1\n", "not a DBC"),
        ('VERSION "1"\n', "no messages"),
        ("  \n", "is empty"),
        ("\x00" * 100, "not a DBC"),
    ],
)
def test_refused_in_bounded_time_and_memory(tmp_path: Path, content: str, text: str) -> None:
    tracemalloc.start()
    start = time.process_time()
    with pytest.raises(InputError, match=text) as caught:
        load(tmp_path, content.encode())
    elapsed = time.process_time() - start
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "\n" not in str(caught.value)
    assert elapsed < 5.0
    assert peak < 50 * MAX_DBC_BYTES


def test_a_circle_of_multiplexers_is_refused(tmp_path: Path) -> None:
    text = (
        "BO_ 256 M: 8 X\n"
        ' SG_ a m1M : 0|8@1+ (1,0) [0|0] "A" X\n'
        ' SG_ b m1M : 8|8@1+ (1,0) [0|0] "A" X\n\n'
        "SG_MUL_VAL_ 256 a b 1-1;\nSG_MUL_VAL_ 256 b a 1-1;\n"
    )
    (tmp_path / "x.dbc").write_text(text)
    (tmp_path / "x.toml").write_text(
        'dbc = "x.dbc"\ncurrent.signal = "a"\nvoltage.signal = "b"\ntemperature.fixed_c = 20\n'
    )
    with pytest.raises(InputError, match="circle"):
        Vehicle.load(map=tmp_path / "x.toml")


def nested(levels: int, values: int, copies: int = 1) -> str:
    """A chain of multiplexers, each switching the next by every one of its values."""
    signals, ranges = [], []
    for level in range(levels):
        mark = "m0M" if level else "M"
        signals += copies * [f' SG_ s{level} {mark} : {8 * level}|8@1+ (1,0) [0|0] "A" X']
        if level:
            ranges.append(f"SG_MUL_VAL_ 256 s{level} s{level - 1} 0-{values - 1};")
    return "\n".join(["BO_ 256 Nested: 64 X", *signals, "", *ranges, ""])


def flat(signals: int) -> str:
    multiplexed = (f' SG_ s{n} m{n} : 16|8@1+ (1,0) [0|0] "" X\n' for n in range(signals))
    return 'BO_ 256 Flat: 8 X\n SG_ M M : 0|16@1+ (1,0) [0|0] "" X\n' + "".join(multiplexed)


MULTIPLYING = {
    "12 levels of 4 values": nested(12, 4),
    "24 levels of 2 values": nested(24, 2),
    "3 levels of 400 values": nested(3, 400),
    "40 levels": nested(40, 8),
    "signals of one name": nested(24, 1, copies=2),
    "named values": nested(2, 200) + "".join(
        f"VAL_ 256 s{level} " + " ".join(f'{n} "x{n}"' for n in range(900)) + " ;\n"
        for level in range(2)
    ),
    "a signal for each value": flat(20_000),
}  # fmt: skip


@pytest.mark.parametrize("name", MULTIPLYING)
def test_multiplexers_that_multiply_are_refused_at_once(tmp_path: Path, name: str) -> None:
    began_s = time.process_time()
    with pytest.raises(InputError, match="multiplex"):
        load(tmp_path, MULTIPLYING[name].encode())
    assert time.process_time() - began_s < 2.0


@pytest.mark.parametrize("text", [nested(3, 3), nested(6, 4), nested(2, 256), flat(1000)])
def test_modest_multiplexing_is_read(tmp_path: Path, text: str) -> None:
    load(tmp_path, text.encode())


def test_windows_umlauts_and_byte_order_marks_are_read(tmp_path: Path) -> None:
    load(tmp_path, (GOOD + 'CM_ "Größe in °C";\n').encode("cp1252"))
    load(tmp_path, b"\xef\xbb\xbf" + GOOD.encode())
    load(tmp_path, GOOD.replace("\n", "\r\n").encode())


def test_absent_files_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_dbc(tmp_path / "absent.dbc")
    with pytest.raises(InputError, match="this is a folder"):
        load_dbc(tmp_path)


def test_messages_defined_twice_print_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    load(tmp_path, (GOOD * 3).encode())
    assert capfd.readouterr() == ("", "")


_LINES = st.sampled_from(
    [
        GOOD,
        "BO_ 257 N: 8 X\n",
        ' SG_ t M : 8|8@0- (0.1,-40) [0|1] "V" X\n',
        ' SG_ u m1 : 8|8@0- (0,0) [0|1] "V" X\n',
        'VAL_ 256 s 1 "one" 2 "two" ;\n',
        'CM_ SG_ 256 s "text";\n',
        "SIG_VALTYPE_ 256 s : 1;\n",
        'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\n',
        'BA_ "GenMsgCycleTime" BO_ 256 10;\n',
        "SG_MUL_VAL_ 256 u t 1-3;\n",
    ]
)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    lines=st.lists(_LINES, max_size=8),
    cut=st.integers(0, 200),
    junk=st.text(max_size=12),
)
def test_anything_is_read_or_refused(tmp_path: Path, lines: list[str], cut: int, junk: str) -> None:
    text = "".join(lines)
    text = text[:cut] + junk + text[cut:]
    with contextlib.suppress(InputError):
        load(tmp_path, text.encode("utf-8", errors="replace"))
