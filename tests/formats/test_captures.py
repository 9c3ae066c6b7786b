"""Captures of all formats are read as messages."""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import can
import pytest

from cangauge.bus.captures import find_capture, open_capture
from cangauge.bus.recording import open_recording
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
    assert (info["format"], info["frames"], info["malformed"]) == (name, frames, 0)
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
    assert capture.info["stamps"] == "ms"
    assert capture.info["remarks"] == ("time stamps are whole milliseconds",)
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


@pytest.mark.parametrize(
    ("per_s", "length", "read", "remark"),
    [
        (10, 8, "ms", "too many frames per microsecond"),  # 111 bits each 100 us: over 1 Mbit/s
        (10, 2, "us", "0x112 comes every 0.1 ms"),  # 63 bits: possible
        (2, 8, "us", "0x112 comes every 0.5 ms; if they are milliseconds, multiply them"),
    ],
)
def test_gvret_filtered_to_an_id(
    tmp_path: Path, per_s: int, length: int, read: str, remark: str
) -> None:
    data = ",".join(["ff"] * length)
    rows = "".join(f"{5000 + k * 1000 // per_s},112,0,1,{length},{data}\n" for k in range(200))
    text = GVRET_WITHOUT_DIRECTION.splitlines(keepends=True)[0] + rows
    capture = open_capture(write(tmp_path, text))
    times = [each.timestamp for each in capture]
    assert times[-1] - times[0] == pytest.approx(199 / per_s / (1 if read == "ms" else 1000))
    assert capture.info["stamps"] == read
    assert remark in capture.info["remarks"][-1]


@pytest.mark.parametrize(
    ("number", "length", "bits"),
    [("112", 0, 47), ("112", 8, 111), ("18ff0001", 0, 67), ("18ff0001", 8, 131),
     ("112", 64, 30), ("18ff0001", 64, 49)],
)  # fmt: skip
def test_gvret_in_microseconds_leaves_time_for_the_bits(
    tmp_path: Path, number: str, length: int, bits: int
) -> None:
    """Of CAN FD, the bits that are not sent at the rate of the data."""
    for gap_us, read in ((bits - 1, "ms"), (bits + 1, "us")):
        data = ",".join(["ff"] * max(length, 1))
        rows = "".join(f"{gap_us * k},{number},0,1,{length},{data}\n" for k in range(200))
        text = GVRET_WITHOUT_DIRECTION.splitlines(keepends=True)[0] + rows
        capture = open_capture(write(tmp_path, text))
        list(capture)
        assert capture.info["stamps"] == read


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


def test_battery_emulator_does_not_pad_ids(tmp_path: Path) -> None:
    lines = "(216.112) RX0 7A [8] 00 00 D2 B6 BC 5E 00 00\n(216.116) tx1 a5b [2] 01 f4\n"
    first, second, *_ = open_capture(write(tmp_path, "ets Jul 29 2019 12:21:46\n" + 2 * lines))
    assert facts(first) == (216.112, 0x7A, False, "0000d2b6bc5e0000")
    assert facts(second) == (216.116, 0xA5B, True, "01f4")
    assert (first.channel, first.is_rx, second.is_rx) == ("RX0", True, False)
    with pytest.raises(InputError, match="not a known kind"):  # candump pads them
        open_capture(write(tmp_path, lines.replace("RX0", "can0").replace("tx1", "can1")))


def test_cabana_in_both_spellings(tmp_path: Path) -> None:
    text = "time,addr,bus,data\n0.061,308,0,08007c630a00d064\n15,0x18ff50e5,129,0x4A\n"
    first, second = open_capture(write(tmp_path, text))
    assert facts(first) == (0.061, 308, False, "08007c630a00d064")
    assert facts(second) == (15.0, 0x18FF50E5, True, "4a")


def test_relative_stamps_of_asc_beyond_all_numbers_are_no_frames(tmp_path: Path) -> None:
    head = (
        "date Wed Mar 13 23:50:00 2024\nbase hex  timestamps relative\nno internal events logged\n"
    )
    line = " 1  1DB  Rx  d 1 00\n"
    huge = "9" * 400 + ".0"
    path = tmp_path / "x.asc"
    path.write_text(head + "".join(stamp + line for stamp in ("0.1", huge, huge, "0.2", "0.1")))
    assert [message.timestamp for message in open_capture(path)] == pytest.approx([0.1, 0.3, 0.4])


def test_relative_stamps_of_asc_that_rise_count_from_the_start(tmp_path: Path) -> None:
    text = "date Wed Mar 13 23:50:00 2024\nbase hex  timestamps relative\n" + "".join(
        f"{k / 100 - 0.012 * (k % 5 == 3):.3f} 1 1DB Rx d 1 AA\n" for k in range(300)
    )  # every fifth frame is written after the one that follows it
    capture = open_capture(write(tmp_path, text))
    assert [each.timestamp for each in capture][-1] == 2.99
    assert capture.info["remarks"] == ("relative time stamps rise: taken as time since the start",)


PEAK = {
    # As PEAK's description of the format has them.
    "1.2": (
        "     1)      1059.900  1  Rx         0300  7  00 00 00 00 04 00 00 \n"
        "     5)      1346.834  1  Warng  FFFFFFFF  4  00 00 00 04  BUSLIGHT\n"
        "     7)      1352.743  2  Tx     18EFC034  3  RTR\n"
    ),
    "2.1": (
        "      1      1059.900 DT 1      0300 Rx -  7    00 00 00 00 04 00 00\n"
        "      5      1334.416 FD 2  18EFC034 Tx -  9    01 02 03 04 05 06 07 08 09 0A 0B 0C\n"
    ),
}


@pytest.mark.parametrize("version", list(PEAK))
def test_versions_of_peak_trc(tmp_path: Path, version: str) -> None:
    columns = ";$COLUMNS=N,O,T,B,I,d,R,L,D\n" if version == "2.1" else ""
    head = f";$FILEVERSION={version}\n;$STARTTIME=39878.6772258947;\n{columns};\n"
    first, second = open_capture(write(tmp_path, head + PEAK[version]))
    assert first.timestamp == pytest.approx(1236356112.317302 + 1.0599, abs=2e-6)
    assert facts(first)[1:] == (0x300, False, "00000000040000")
    assert (second.arbitration_id, second.is_rx, second.channel) == (0x18EFC034, False, 2)
    assert second.is_remote_frame if version == "1.2" else second.dlc == 12


@pytest.mark.parametrize(
    ("content", "name", "cure"),
    [
        (b"***BUSMASTER Ver 3.2.2***\n", "BUSMASTER", "SavvyCAN"),
        (b"Chn Identifier Flg   DLC  D0...1...2\n", "Kvaser", "SavvyCAN"),
        (b"# Logger type: CANLogger1000\n", "CLX000", "SavvyCAN"),
        (b"0.0005;RX;0x305;2;0x1F;0x03;\n", "Microchip", "SavvyCAN"),
        (b"t30521F03\r\nT18FF50E514A\r\n", "slcan", "Z1"),
        (b'"No.","Time","Source","Info"\n"1","0.5","","ID: 773"\n', "Wireshark", "pcapng"),
        (b"ATMA\r\n305 1F 03 20 10\r\n", "ELM327", "stamps the frames"),
        ("date Wed Mar 13 23:50:00 2024\nbase hex\n".encode("utf-16"), "UTF-16", "iconv"),
        (b"LOGFILEVERSION\nLine,Abs Time(Sec),Arb ID,B1,B2\n1,0.5,305,1F,3\n", "table of CAN",
         "time,addr,bus,data"),
        ("序号,时间标识,帧ID,数据(HEX)\n0,23:50:00,0x305,1F 03\n".encode(), "table of CAN",
         "time,addr,bus,data"),
    ],
)  # fmt: skip
def test_captures_that_are_not_read_name_the_conversion(
    tmp_path: Path, content: bytes, name: str, cure: str
) -> None:
    with pytest.raises(InputError, match=name) as caught:
        open_recording(write(tmp_path, content))
    assert cure in str(caught.value.cure)


def test_without_stamps_frames_of_the_clock_count_time(tmp_path: Path) -> None:
    path = write(tmp_path, SCREEN)
    capture = open_capture(path)
    assert [each.timestamp for each in capture] == [0.0, 0.0, 0.01, 0.01]
    assert capture.info["stamps"] == "none"
    assert "0x1DB, one every 10 ms" in capture.info["remarks"][0]
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
    assert capture.info["cut_off"]
    assert f"cut off after {frames} frames" in capture.info["remarks"][-1]


def test_a_capture_of_a_thousand_buses_is_one_of_the_first(tmp_path: Path) -> None:
    # Whoever reaches a UDP port may name another bus in each packet, and each takes a decoder.
    path = tmp_path / "x.log"
    names = [*["can0"] * 1000, *(f"x{number}" for number in range(900))]
    path.write_text("".join(f"({n}.000000) {name} 123#00\n" for n, name in enumerate(names)))
    capture = open_capture(path)
    assert {message.channel for message in capture} == {"can0", *(f"x{n}" for n in range(63))}
    assert capture.info["malformed"] == 900 - 63


def test_a_few_malformed_lines_are_skipped_and_counted(tmp_path: Path) -> None:
    lines = SPACED.splitlines(keepends=True) * 5
    lines[3] = "0000.022044 000001FF 2 AA\r\n"  # a byte is missing
    lines[9] = "!!! buffer overrun\r\n"
    lines[10] = "0000.000000 00000001 65" + " 00" * 65 + "\r\n"  # longer than any frame
    lines[12] = "0000.000000 FFFFFFFF 1 00\r\n"  # no such id
    capture = open_capture(write(tmp_path, "".join(lines)))
    assert sum(1 for _ in capture) == 16
    assert (capture.info["malformed"], capture.info["first_malformed"]) == (4, 4)
    assert capture.info["remarks"] == ("4 malformed lines skipped (first: 4)",)


def test_a_banner_before_the_frames_is_skipped(tmp_path: Path) -> None:
    capture = open_capture(write(tmp_path, "welcome to my logger\n" * 50 + SPACED * 100))
    assert sum(1 for _ in capture) == 400
    assert capture.info["malformed"] == 50


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
