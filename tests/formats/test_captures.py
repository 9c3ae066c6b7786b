"""Captures of all formats are read as messages."""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import can
import pytest

from cangauge.bus.captures import find_capture, open_capture
from cangauge.errors import InputError

SPACED = (
    "0000.000000 000001D4 8 F7 07 00 00 87 44 30 7B\r\n"
    "0000.016722 0000056E 1 46       \r\n"
    "0000.021044 0000050C 6 00 00 00 02 5D 63  \r\n"
    "0000.022044 18FF0001 2 AA BB\r\n"
)
TABLE = (
    "ParserFlags\tCh\tCounter\tT/R\tTime\tFlags\tCAN ID\tLen\tData\tParser Name\tdefault\n"
    "1\t0\t14767\tRX\t1052620673\t\t0x000001da\t8\t0xc8 32 18 00 00 01 01 59 \tDefault Parser\t\n"
    "1\t0\t14768\tTX\t1052620674\t\t0x18ff0001\t2\t0x10 64 \tDefault Parser\t\n"
)
TABLE_WITHOUT_PARSER = (
    "ParserFlags\tCh\tCounter\tT/R\tTime\tFlags\tCAN ID\tLen\tData\t\n"
    "1\t0\t1\tRX\t565214935\t\t0x00000603\t1\t0x00 \t\n"
    "1\t0\t2\tRX\t565214958\t\t0x0000068c\t1\t0x00 \t\n"
)
CRTD = (
    "1632509059.533816 CXX OVMS CRTD\n"
    "1632509059.536559 1CXX Info Type:vfs Format:crtd(discard) Vehicle:NL\n"
    "1632509059.541604 2R11 174 00 00 00 aa 0f 00 00 00\n"
    "1632509064.511234 2CER Error intr=2171314 rxpkt=2184796 txpkt=24 errflags=0x22401c02\n"
    "1632509072.204836 1T11 797 03 22 12 05 55 55 55 55\n"
    "1632509072.304836 R29 18ff0001 03 22\n"
    "1632509072.683420 1CEV Event vehicle.awake\n"
)
SCREEN = (
    "  can0  1DB   [8]  00 04 C2 62 00 00 03 B6\n"
    "  can0  1ED   [3]  FF E3 62\n"
    "  can0  1DB   [8]  00 04 C2 62 00 00 00 BC\n"
    "  can0  18FF0001   [2]  01 02\n"
)
SCREEN_WITH_STAMPS = (
    " (1436509052.249713)  can0  1DB   [8]  00 04 C2 62 00 00 03 B6\n"
    " (1436509052.259713)  can0  123   [0]  remote request\n"
    " (1436509052.269713)  can0  20000080   [8]  00 00 00 00 00 00 00 00   ERRORFRAME\n"
    " (1436509052.279713)  can0  18FF0001   [2]  01 02   '..'\n"
)
CANDUMP_LOG = (
    "(1436509052.249713) vcan0 044#2A366C2BBA\n"
    "(1436509052.449847) vcan0 18FF0001#F6ADE003 T\n"
    "(1436509052.650004) vcan0 123#R\n"
    "(1436509052.650005) vcan0 124##1AABB\n"
    "(1436509052.650006) vcan0 20000080#0000000000000000\n"
)
GVRET = (
    "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
    "22213513,00000111,false,Rx,0,8,00,01,02,03,04,05,06,07,\n"
    "22214519,18FF0001,true,Tx,1,2,0A,3C,00,00,00,00,00,00,\n"
)
GVRET_WITHOUT_DIRECTION = (
    "\ufeffTime Stamp,ID,Extended,Bus,DLC,D1,D2,D3,D4,D5,D6,D7,D8\n"
    "2124377,3a0,0,1,8,ff,ff,c0,ff,ff,ff,ff,fd\n"
    "2124378,18ff0001,1,1,2,ff,ff,0,0,0,0,0,0\n"
)
CARBUS = (
    "@ TEXT @ 3 @ 64 @ 0 @ 2 @ 7459 @ 00:00:07.459 @\r# $LocalTime=11:19:54.503$\r"
    "26,641405\t1\t00000004\t112\t8\t00 20 C1 0E 01 72 89 00\t00000000\t     r  \t\r"
    "26,671594\t2\t00000004\t18FF0001\t2\t0F 00                  \t00000000\t  \t\r"
)
CAN_HACKER = (
    "CAN speed 1: 500k CAN speed 2: 500k CAN speed 3: 1000k/4000k Id format: HEX | Data format: HEX"
    "\n\t \n"
    ">\t0\t   23:59:59.303:4446.00\tSt\t0x197\t0\t4\t64\tE0\t9E\tC0\t \t \t \t \tp:1\n"
    ">\t1\t   0:0:9.69:298.00\tSt\t0x10B\t0\t3\tBA\t0D\tFC\t \t \t \t \t \tp:2\n"
    ">\t2\t   0:0:9.70:298.00\tExt\t0x18FF0001\t0\t1\tBA\t \t \t \t \t \t \t \tp:2\n"
)
TEXTS = {
    "SavvyCAN GVRET CSV": (GVRET, 2),
    "CARBUS Analyzer trace": (CARBUS, 2),
    "CAN Hacker log": (CAN_HACKER, 3),
    "seconds, id, length, bytes": (SPACED, 4),
    "tab-separated table": (TABLE, 2),
    "CRTD (OVMS)": (CRTD, 3),
    "candump without stamps": (SCREEN, 4),
    "candump with stamps": (SCREEN_WITH_STAMPS, 4),
    "candump log": (CANDUMP_LOG, 5),
}


def write(folder: Path, content: str | bytes, name: str = "capture.txt") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def facts(message: can.Message) -> tuple[float, int, bool, str]:
    return (
        message.timestamp,
        message.arbitration_id,
        message.is_extended_id,
        message.data.hex(),
    )


@pytest.mark.parametrize("name", list(TEXTS))
@pytest.mark.parametrize("packed", [False, True])
def test_every_text_format_is_recognised_and_read(tmp_path: Path, name: str, packed: bool) -> None:
    text, frames = TEXTS[name]
    path = write(tmp_path, gzip.compress(text.encode()) if packed else text, "any.name")
    capture = open_capture(path)
    messages = list(capture)
    info = capture.info
    assert (info.format, info.frames, info.malformed) == (name, frames, 0)
    assert len(messages) == frames
    assert messages[-1].is_extended_id or name in {"tab-separated table", "candump log"}
    assert [facts(each) for each in capture] == [facts(each) for each in messages]  # again


def test_seconds_id_length_bytes(tmp_path: Path) -> None:
    first, second, third, _ = open_capture(write(tmp_path, SPACED))
    assert facts(first) == (0.0, 0x1D4, False, "f70700008744307b")
    assert facts(second) == (0.016722, 0x56E, False, "46")
    assert facts(third) == (0.021044, 0x50C, False, "000000025d63")


def test_tables_have_stamps_in_whole_milliseconds(tmp_path: Path) -> None:
    capture = open_capture(write(tmp_path, TABLE))
    first, second = capture
    assert facts(first) == (1052620.673, 0x1DA, False, "c832180000010159")
    assert facts(second) == (1052620.674, 0x18FF0001, True, "1064")
    assert (first.is_rx, second.is_rx) == (True, False)
    assert capture.info.stamps == "ms"
    assert capture.info.remarks == ("time stamps are whole milliseconds",)
    other = list(open_capture(write(tmp_path, TABLE_WITHOUT_PARSER)))
    assert [facts(each) for each in other] == [
        (565214.935, 0x603, False, "00"),
        (565214.958, 0x68C, False, "00"),
    ]


def test_crtd_keeps_the_buses_apart(tmp_path: Path) -> None:
    first, second, third = open_capture(write(tmp_path, CRTD))
    assert facts(first) == (1632509059.541604, 0x174, False, "000000aa0f000000")
    assert (first.channel, second.channel, third.channel) == (2, 1, 1)
    assert (first.is_rx, second.is_rx) == (True, False)


def test_gvret_csv_in_both_spellings(tmp_path: Path) -> None:
    first, second = open_capture(write(tmp_path, GVRET))
    assert facts(first) == (22.213513, 0x111, False, "0001020304050607")
    assert facts(second) == (22.214519, 0x18FF0001, True, "0a3c")
    assert (first.channel, second.channel, first.is_rx, second.is_rx) == (0, 1, True, False)
    first, second = open_capture(write(tmp_path, GVRET_WITHOUT_DIRECTION))
    assert facts(first) == (2.124377, 0x3A0, False, "ffffc0fffffffffd")
    assert facts(second) == (2.124378, 0x18FF0001, True, "ffff")


def test_gvret_stamps_too_fast_for_a_bus_are_milliseconds(tmp_path: Path) -> None:
    rows = "".join(f"{5000 + k // 2},112,0,1,2,ff,{k:x}\n" for k in range(200))
    text = GVRET_WITHOUT_DIRECTION.splitlines(keepends=True)[0] + rows
    times = [each.timestamp for each in open_capture(write(tmp_path, text))]
    assert (times[0], times[-1]) == (5.0, 5.099)


def test_traces_of_can_hacker_and_carbus(tmp_path: Path) -> None:
    first, second = open_capture(write(tmp_path, CARBUS))
    assert facts(first) == (26.641405, 0x112, False, "0020c10e01728900")
    assert facts(second) == (26.671594, 0x18FF0001, True, "0f00")
    milliseconds = CARBUS.replace("TEXT @ 3", "TEXT @ 2").replace("641405", "641")
    assert next(iter(open_capture(write(tmp_path, milliseconds)))).timestamp == 26.641
    first, second, third = open_capture(write(tmp_path, CAN_HACKER))
    assert facts(first) == (86399.303, 0x197, False, "64e09ec0")
    assert facts(second) == (86409.069, 0x10B, False, "ba0dfc")  # past midnight
    assert (third.is_extended_id, third.channel) == (True, 2)


def test_without_stamps_frames_of_the_clock_count_time(tmp_path: Path) -> None:
    path = write(tmp_path, SCREEN)
    capture = open_capture(path)
    assert [each.timestamp for each in capture] == [0.0, 0.0, 0.01, 0.01]
    assert capture.info.stamps == "none"
    assert "0x1DB, one every 10 ms" in capture.info.remarks[0]
    slower = open_capture(path, clock=(0x1ED, 0.5))
    assert [each.timestamp for each in slower] == [0.0, 0.0, 0.0, 0.0]
    with pytest.raises(InputError, match="no frames of 0x123"):
        list(open_capture(path, clock=(0x123, 0.1)))


def test_kinds_of_frames_in_candump(tmp_path: Path) -> None:
    for text in (SCREEN_WITH_STAMPS, CANDUMP_LOG):
        messages = list(open_capture(write(tmp_path, text)))
        assert sum(each.is_remote_frame for each in messages) == 1
        assert sum(each.is_error_frame for each in messages) == 1
    assert sum(each.is_fd for each in messages) == 1
    assert facts(messages[3]) == (1436509052.650005, 0x124, False, "aabb")
    assert messages[1].is_rx is False


def read_or_refuse(path: Path) -> int:
    """Return the number of frames; 0 where it is refused. Any other error fails the test."""
    try:
        return sum(1 for _ in open_capture(path))
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017  # both outcomes are right here
        return 0


def test_a_gzip_cut_at_every_byte_gives_what_can_be_read(tmp_path: Path) -> None:
    lines = "".join(
        f"{n / 100:.6f} 000001DB 8 " + " ".join(f"{n * k % 251:02X}" for k in range(8)) + "\n"
        for n in range(600)
    )
    packed = gzip.compress(lines.encode())
    for cut in range(0, len(packed), 499):
        readable = zlib.decompressobj(wbits=31).decompress(packed[:cut]).count(b"\n")
        frames = read_or_refuse(write(tmp_path, packed[:cut]))
        assert readable <= frames <= readable + 1  # the last line may lack its end alone
    capture = open_capture(write(tmp_path, packed[:-20]))
    frames = sum(1 for _ in capture)
    assert capture.info.cut_off
    assert f"cut off after {frames} frames" in capture.info.remarks[-1]


def test_a_few_malformed_lines_are_skipped_and_counted(tmp_path: Path) -> None:
    lines = SPACED.splitlines(keepends=True) * 5
    lines[3] = "0000.022044 000001FF 2 AA\r\n"  # a byte is missing
    lines[9] = "!!! buffer overrun\r\n"
    lines[10] = "0000.000000 00000001 65" + " 00" * 65 + "\r\n"  # longer than any frame
    lines[12] = "0000.000000 FFFFFFFF 1 00\r\n"  # no such id
    capture = open_capture(write(tmp_path, "".join(lines)))
    assert sum(1 for _ in capture) == 16
    assert (capture.info.malformed, capture.info.first_malformed) == (4, 4)
    assert capture.info.remarks == ("4 malformed lines skipped (first: 4)",)


def test_a_banner_before_the_frames_is_skipped(tmp_path: Path) -> None:
    capture = open_capture(write(tmp_path, "welcome to my logger\n" * 50 + SPACED * 100))
    assert sum(1 for _ in capture) == 400
    assert capture.info.malformed == 50


def test_mostly_junk_is_refused_by_line(tmp_path: Path) -> None:
    text = SPACED * 120 + "junk\n" * 2000
    with pytest.raises(InputError, match="the first is 481") as caught:
        list(open_capture(write(tmp_path, text)))
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n\n",
        b"hello world\n" * 10,
        b"time_s,current_a,voltage_v,temperature_c\n0,1,2,3\n1,1,2,3\n",
        b"PAR1" + bytes(100),
        bytes(range(256)) * 20,
        b"\x1f\x8b" + bytes(50),
        b"ParserFlags\tCh\tCounter\tT/R\tTime\tFlags\tCAN ID\tLen\tData\t\n",
    ],
)
def test_what_is_no_capture(tmp_path: Path, content: bytes) -> None:
    path = write(tmp_path, content)
    assert find_capture(path) is None
    with pytest.raises(InputError, match="not a known kind of capture") as caught:
        open_capture(path)
    assert "candump" in str(caught.value.cure)


def test_absent_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        open_capture(tmp_path / "absent")
    with pytest.raises(InputError, match="folder"):
        open_capture(tmp_path)


def test_lines_without_end_take_no_memory(tmp_path: Path) -> None:
    path = write(tmp_path, gzip.compress((SPACED * 30).encode() + b"A" * 50_000_000))
    assert path.stat().st_size < 100_000
    with pytest.raises(InputError, match="lines are no frames"):
        list(open_capture(path))


def test_mf4_without_its_reader_names_the_package(tmp_path: Path) -> None:
    path = write(tmp_path, b"MDF     4.10    " + struct.pack("<100x"))
    try:
        import asammdf  # noqa: F401, PLC0415
    except ModuleNotFoundError:
        with pytest.raises(InputError, match=r"cangauge\[mf4\]"):
            list(open_capture(path))
    else:
        assert read_or_refuse(path) == 0
