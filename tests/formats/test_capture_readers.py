"""Every reader of captures keeps the contract of `CaptureReader`, each by the same tests."""

from __future__ import annotations

import gzip
import os
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import ClassVar

import can
import pytest
from can.io.generic import MessageWriter

from cangauge.bus.captures import open_capture
from cangauge.bus.readers import CandumpLogReader, CaptureReader
from cangauge.errors import InputError
from cangauge.extras.formats import pcap, text
from cangauge.extras.formats import python_can as library

START_S = 1436509052.25
FRAMES = 40


def frames_of(
    *, extended: bool = True, remote: bool = False, error: bool = False, fd: bool = False
) -> list[can.Message]:
    """Return frames of all kinds that a format can express, 10 ms apart."""
    random = Random(1)  # noqa: S311 - repeatable frames
    frames = []
    for k in range(FRAMES):
        is_fd = fd and k % 5 == 3
        length = random.choice([12, 64]) if is_fd else random.randrange(9)
        is_extended = extended and k % 4 == 1
        frames.append(
            can.Message(
                timestamp=START_S + k / 100,
                arbitration_id=0x18FF0000 + k if is_extended else 0x100 + k,
                is_extended_id=is_extended,
                data=random.randbytes(length),
                channel=k % 2,
                is_fd=is_fd,
                bitrate_switch=is_fd and k % 2 == 0,
            )
        )
    if remote:
        frames[7] = can.Message(
            timestamp=frames[7].timestamp, arbitration_id=0x123, is_remote_frame=True, dlc=4,
            is_extended_id=False, channel=1,
        )  # fmt: skip
    if error:
        frames[8] = can.Message(
            timestamp=frames[8].timestamp, arbitration_id=0x80, is_error_frame=True, data=bytes(8),
            channel=0,
        )  # fmt: skip
    return frames


def _hex(frame: can.Message, separator: str = " ") -> str:
    return frame.data.hex(" ").upper().replace(" ", separator)


class Conformance:
    """Subclass it for a format: its reader, how a file is written, and what the format keeps."""

    reader: ClassVar[type[CaptureReader]]
    kinds: ClassVar[dict[str, bool]] = {}
    resolution_s: ClassVar[float | None] = 1e-6
    """None: no stamps."""
    has_channels: ClassVar[bool] = True
    is_relative: ClassVar[bool] = False
    """Stamps count from the first frame, or from midnight."""

    def write(self, path: Path, frames: Iterable[can.Message]) -> None:
        raise NotImplementedError

    @pytest.fixture
    def path(self, tmp_path: Path) -> Path:
        path = tmp_path / "capture.any"
        self.write(path, frames_of(**self.kinds))
        return path

    def facts(self, frames: Iterable[can.Message]) -> list[tuple[object, ...]]:
        return [
            (
                frame.arbitration_id if not frame.is_error_frame else None,
                frame.is_extended_id if not frame.is_error_frame else None,
                frame.is_remote_frame,
                frame.is_error_frame,
                frame.is_fd,
                frame.bitrate_switch,
                frame.dlc,
                b"" if frame.is_error_frame else bytes(frame.data),
                str(frame.channel).removeprefix("can") if self.has_channels else None,
            )
            for frame in frames
        ]

    def test_round_trip(self, path: Path) -> None:
        written = frames_of(**self.kinds)
        with self.reader(path) as reader:
            read = list(reader)
        assert self.facts(read) == self.facts(written)
        assert (reader.frames, reader.malformed, reader.cut_off) == (FRAMES, 0, False)
        if self.resolution_s is None:
            assert reader.stamps == "none"
            return
        offset_s = read[0].timestamp - START_S if self.is_relative else 0.0
        for got, frame in zip(read, written, strict=True):
            assert got.timestamp - offset_s == pytest.approx(
                frame.timestamp, abs=0.51 * self.resolution_s, rel=0
            )

    def test_recognised_by_content_alone(self, path: Path) -> None:
        assert open_capture(path).info["format"] == self.reader.name

    def test_packed_and_from_a_file_object(self, path: Path, tmp_path: Path) -> None:
        plain = self.facts(self.reader(path))
        packed = tmp_path / "packed"
        packed.write_bytes(gzip.compress(path.read_bytes()))
        with self.reader(packed) as reader:
            assert self.facts(reader) == plain
        with path.open("rb") as file:
            assert self.facts(self.reader(file)) == plain

    def test_cut_anywhere_gives_no_wrong_frame(self, path: Path, tmp_path: Path) -> None:
        data = path.read_bytes()
        complete = self.facts(self.reader(path))
        cut = tmp_path / "cut"
        lengths = Random(2).sample(range(1, len(data)), min(150, len(data) - 1))  # noqa: S311
        for length in sorted(lengths):
            cut.write_bytes(data[:length])
            try:
                found = self.facts(self.reader(cut).messages())
            except InputError:
                continue
            assert found == complete[: len(found)]


class Lines(Conformance):
    """A text format: a header and a line per frame."""

    header: ClassVar[str] = ""
    line: ClassVar[Callable[[can.Message], str]]

    def write(self, path: Path, frames: Iterable[can.Message]) -> None:
        path.write_bytes((self.header + "".join(map(type(self).line, frames))).encode())


class TestCrtd(Lines):
    reader = text.CrtdReader
    header = "1436509052.000000 CXX OVMS CRTD\n"

    @staticmethod
    def line(f: can.Message) -> str:
        bits = 29 if f.is_extended_id else 11
        data = f" {_hex(f)}" if f.data else ""
        return f"{f.timestamp:.6f} {f.channel}R{bits} {f.arbitration_id:x}{data}\n"


class TestCandumpLog(Lines):
    reader = CandumpLogReader
    kinds: ClassVar = {"remote": True, "error": True, "fd": True}

    def write(self, path: Path, frames: Iterable[can.Message]) -> None:
        with path.open("w") as file, can.CanutilsLogWriter(file) as writer:
            for frame in frames:
                frame.channel = f"can{frame.channel}"
                writer.on_message_received(frame)

    def facts(self, frames: Iterable[can.Message]) -> list[tuple[object, ...]]:
        # The format has no length of a remote frame unless python-can writes it.
        return [(*each[:6], *each[7:]) if each[2] else each for each in super().facts(frames)]


class TestCandumpScreen(Lines):
    reader = text.CandumpReader

    @staticmethod
    def line(f: can.Message) -> str:
        number = f"{f.arbitration_id:08X}" if f.is_extended_id else f"{f.arbitration_id:03X}"
        return f" ({f.timestamp:.6f})  can{f.channel}  {number}   [{f.dlc}]  {_hex(f)}\n"


class TestCandumpWithDates(TestCandumpScreen):
    @staticmethod
    def line(f: can.Message) -> str:
        date = datetime.fromtimestamp(f.timestamp, UTC).isoformat(" ", "microseconds")[:26]
        return f" ({date})  " + TestCandumpScreen.line(f).split(")  ", 1)[1]


class TestBatteryEmulator(Lines):
    reader = text.BatteryEmulatorReader
    resolution_s = 1e-3
    kinds: ClassVar = {"fd": True}

    @staticmethod
    def line(f: can.Message) -> str:
        data = f" {_hex(f)}" if f.data else " "
        return f"({f.timestamp:.3f}) RX{f.channel} {f.arbitration_id:X} [{len(f.data)}]{data}\n"

    def facts(self, frames: Iterable[can.Message]) -> list[tuple[object, ...]]:
        # No bit rate switch, and the direction is written in the channel.
        return [(*each[:5], *each[6:8], f"{each[8]}"[-1]) for each in super().facts(frames)]


class TestCandumpWithoutStamps(Lines):
    reader = text.UnstampedCandumpReader
    resolution_s = None

    @staticmethod
    def line(f: can.Message) -> str:
        return "  " + TestCandumpScreen.line(f).split(")  ")[1]


class TestGvret(Lines):
    reader = text.GvretReader
    header = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
    kinds: ClassVar = {"fd": True}

    @staticmethod
    def line(f: can.Message) -> str:
        extended = str(f.is_extended_id).lower()
        time_us = round(f.timestamp * 1e6)
        return f"{time_us},{f.arbitration_id:08X},{extended},Rx,{f.channel},{len(f.data)}," + (
            _hex(f, ",") + ",\n"
        )

    def facts(self, frames: Iterable[can.Message]) -> list[tuple[object, ...]]:
        return [(*each[:5], *each[6:]) for each in super().facts(frames)]  # no bit rate switch


class TestGvretWithoutDirection(TestGvret):
    header = "Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"

    @staticmethod
    def line(f: can.Message) -> str:
        return TestGvret.line(f).replace(",Rx", "")


class TestIdAndData(Lines):
    reader = text.IdDataReader
    header = "ID,Data Bytes\n"
    resolution_s = None
    has_channels = False

    @staticmethod
    def line(f: can.Message) -> str:
        return f"{f.arbitration_id:08X},{_hex(f)} \n"


class TestCabana(Lines):
    reader = text.CabanaReader
    header = "time,addr,bus,data\n"
    resolution_s = 1e-3

    @staticmethod
    def line(f: can.Message) -> str:
        return f"{f.timestamp:.3f},0x{f.arbitration_id:x},{f.channel},0x{f.data.hex().upper()}\n"


class TestCarbus(Lines):
    reader = text.CarbusReader
    header = "@ TEXT @ 3 @ 64 @ 0 @ 40 @ 400 @ 00:00:00.400 @\r"

    @staticmethod
    def line(f: can.Message) -> str:
        time_us = round(f.timestamp * 1e6)
        return (
            f"{time_us // 1_000_000},{time_us % 1_000_000:06}\t{f.channel}\t00000004"
            f"\t{f.arbitration_id:03X}\t{f.dlc}\t{_hex(f):23}\t00000000\t{'':8}\t\r"
        )


class TestUsbCan(Lines):
    reader = text.UsbCanReader
    kinds: ClassVar = {"remote": True}
    header = "NO    Direction  Time Scale  Frame Type  Frame Format  Frame ID  Length  Data\n"
    has_channels = False
    is_relative = True
    resolution_s = 1e-3

    @staticmethod
    def line(f: can.Message) -> str:
        clock = datetime.fromtimestamp(f.timestamp, UTC).strftime("%H:%M:%S:%f")[:-3]
        kind = "Remote" if f.is_remote_frame else "Data"
        form = "Extended" if f.is_extended_id else "Standard"
        return (
            f"7      Receive      {clock}      {kind} frame      {form} frame"
            f"      {f.arbitration_id:08x}      {f.dlc}      {_hex(f).lower()}       \n"
        )


class TestSlcan(Lines):
    reader = text.SlcanReader
    has_channels = False
    is_relative = True
    resolution_s = 1e-3

    @staticmethod
    def line(f: can.Message) -> str:
        number = f"T{f.arbitration_id:08X}" if f.is_extended_id else f"t{f.arbitration_id:03X}"
        stamp_ms = round(1000.0 * f.timestamp) % 60_000
        return f"{number}{f.dlc}{_hex(f, '')}{stamp_ms:04X}\r"


class TestCanHacker(Lines):
    reader = text.CanHackerReader
    header = "CAN speed 1: 500k CAN speed 2: 500k Id format: HEX | Data format: HEX\n\t \n"
    resolution_s = 1e-3
    is_relative = True

    @staticmethod
    def line(f: can.Message) -> str:
        ms = round(f.timestamp * 1e3) % 86_400_000
        clock = f"{ms // 3_600_000}:{ms // 60_000 % 60}:{ms // 1000 % 60}.{ms % 1000}:10.00"
        kind = "Ext" if f.is_extended_id else "St"
        data = "\t".join([*_hex(f).split(), *[" "] * (8 - f.dlc)])
        return (
            f">\t0\t   {clock}\t{kind}\t0x{f.arbitration_id:X}\t0\t{f.dlc}\t{data}\tp:{f.channel}\n"
        )


class TestTable(Lines):
    reader = text.TableReader
    header = "ParserFlags\tCh\tCounter\tT/R\tTime\tFlags\tCAN ID\tLen\tData\tParser\n"
    resolution_s = 1e-3

    @staticmethod
    def line(f: can.Message) -> str:
        time_ms = round(1000 * f.timestamp)
        return f"1\t{f.channel}\t1\tRX\t{time_ms}\t\t0x{f.arbitration_id:08x}\t{f.dlc}\t0x" + (
            f"{_hex(f)} \tDefault\n"
        )


class TestSpaced(Lines):
    reader = text.SpacedReader
    header = "Time   ID     DLC Data                    Comment\n"
    has_channels = False

    @staticmethod
    def line(f: can.Message) -> str:
        data = f" {_hex(f)}" if f.data else ""
        return f"{f.timestamp:.6f} {f.arbitration_id:08X} {f.dlc}{data}\r\n"


class TestSpacedInMilliseconds(Lines):
    reader = text.SpacedReader
    has_channels = False
    resolution_s = 1e-3

    @staticmethod
    def line(f: can.Message) -> str:
        data = " ".join(f"{byte:X}" for byte in f.data)
        return f"{round(1000 * f.timestamp)}  {f.arbitration_id:X}  {f.dlc}  {data} \n"


class Written(Conformance):
    """A format that a writer of python-can's shape writes."""

    writer: ClassVar[Callable[[Path], MessageWriter]]

    def write(self, path: Path, frames: Iterable[can.Message]) -> None:
        with type(self).writer(path) as writer:
            for frame in frames:
                writer.on_message_received(frame)


class TestAsc(Written):
    reader = text.AscReader
    writer = can.ASCWriter
    kinds: ClassVar = {"remote": True, "fd": True}
    is_relative = True
    resolution_s = 1e-3  # python-can rounds the start to whole milliseconds


class TestAscOfDifferences(Conformance):
    """Relative time stamps, as Vector writes them: since the event before, frame or not."""

    reader = text.AscReader
    is_relative = True

    def write(self, path: Path, frames: Iterable[can.Message]) -> None:
        lines = ["date Wed Mar 13 11:50:00.000 pm 2024", "base hex  timestamps relative",
                 "internal events logged", "Begin Triggerblock Wed Mar 13 11:50:00.000 pm 2024",
                 "   0.000000 Start of measurement"]  # fmt: skip
        before_s = START_S - 0.5
        for number, frame in enumerate(frames):
            gap_s = frame.timestamp - before_s
            if number % 3 == 2:
                lines.append(f"{gap_s / 4:11.6f} 1  Statistic: D 12 R 0 XD 0 XR 0 E 0 O 0 B 3.01%")
                gap_s *= 3 / 4
            name = f"{frame.arbitration_id:X}{'x' * frame.is_extended_id}"
            where = f"{frame.channel + 1}  {name:15} Rx   d {frame.dlc}"
            lines.append(f"{gap_s:11.6f} {where} {_hex(frame)}")
            before_s = frame.timestamp
        path.write_text("\n".join([*lines, "End TriggerBlock", ""]))


class TestBlf(Written):
    reader = library.READERS[0]
    writer = can.BLFWriter
    kinds: ClassVar = {"remote": True, "error": True, "fd": True}


class TestTrc(Written):
    reader = library.READERS[1]
    writer = can.TRCWriter
    has_channels = False
    is_relative = True
    resolution_s = 1e-3


class TestCsv(Written):
    reader = library.READERS[3]
    writer = can.CSVWriter
    kinds: ClassVar = {"remote": True, "error": True}
    has_channels = False


def _socketcan(frame: can.Message, order: str = ">") -> bytes:
    """Return a frame as SocketCAN hands it to libpcap."""
    flags = 0x80000000 * frame.is_extended_id | 0x40000000 * frame.is_remote_frame
    flags |= 0x20000000 * frame.is_error_frame
    fd = 4 * frame.is_fd | frame.bitrate_switch
    head = struct.pack(order + "IBBxx", frame.arbitration_id | flags, frame.dlc, fd)
    return head + bytes(frame.data).ljust(64 if frame.is_fd else 8, b"\0")


class TestPcap(Conformance):
    reader = pcap.PcapReader
    kinds: ClassVar = {"remote": True, "error": True, "fd": True}
    has_channels = False
    order: ClassVar[str] = "<"
    per_s: ClassVar[int] = 1_000_000
    link: ClassVar[int] = 227

    def packet(self, frame: can.Message) -> bytes:
        return _socketcan(frame)

    def write(self, path: Path, frames: Iterable[can.Message]) -> None:
        magic = 0xA1B2C3D4 if self.per_s == 1_000_000 else 0xA1B23C4D
        out = [struct.pack(self.order + "IHHiIII", magic, 2, 4, 0, 0, 262144, self.link)]
        for frame in frames:
            packet = self.packet(frame)
            seconds, ticks = divmod(round(frame.timestamp * self.per_s), self.per_s)
            size = len(packet)
            out.append(struct.pack(self.order + "IIII", seconds, ticks, size, size) + packet)
        path.write_bytes(b"".join(out))


class TestPcapInNanoseconds(TestPcap):
    order = ">"
    per_s = 1_000_000_000


class TestPcapCooked(TestPcap):
    link = 113

    def packet(self, frame: can.Message) -> bytes:
        protocol = 0x0D if frame.is_fd else 0x0C
        head = struct.pack(">HHH8sH", 0, 280, 0, bytes(8), protocol)
        return head + _socketcan(frame, self.order)


class TestPcapCooked2(TestPcap):
    link = 276
    order = ">"
    has_channels = True

    def packet(self, frame: can.Message) -> bytes:
        protocol = 0x0D if frame.is_fd else 0x0C
        head = struct.pack(">HxxIHBB8s", protocol, frame.channel, 280, 0, 0, bytes(8))
        return head + _socketcan(frame, self.order)


class TestPcapng(Conformance):
    reader = pcap.PcapReader
    kinds: ClassVar = {"remote": True, "error": True, "fd": True}
    order: ClassVar[str] = "<"

    def block(self, kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = struct.pack(self.order + "I", len(body) + 12)
        return struct.pack(self.order + "I", kind) + size + body + size

    def option(self, code: int, value: bytes) -> bytes:
        padded = value + bytes(-len(value) % 4)
        return struct.pack(self.order + "HH", code, len(value)) + padded

    def write(self, path: Path, frames: Iterable[can.Message]) -> None:
        out = [self.block(0x0A0D0D0A, struct.pack(self.order + "IHHq", 0x1A2B3C4D, 1, 0, -1))]
        for name in (b"can0", b"can1"):
            options = self.option(2, name) + self.option(9, b"\x09") + self.option(0, b"")
            out.append(self.block(1, struct.pack(self.order + "HHI", 227, 0, 262144) + options))
        for frame in frames:
            packet = _socketcan(frame)
            time_ns = round(frame.timestamp * 1e9)
            head = struct.pack(
                self.order + "IIIII",
                frame.channel,
                time_ns >> 32,
                time_ns & 0xFFFFFFFF,
                len(packet),
                len(packet),
            )
            out.append(self.block(6, head + packet))
            out.append(self.block(5, bytes(12)))  # statistics of an interface: skipped
        path.write_bytes(b"".join(out))


class TestPcapngBigEndian(TestPcapng):
    order = ">"


@pytest.mark.parametrize("suffix", [".crtd", ".pcap", ".pcapng"])
def test_python_can_finds_our_readers(tmp_path: Path, suffix: str) -> None:
    made = {".crtd": TestCrtd, ".pcap": TestPcap, ".pcapng": TestPcapng}[suffix]()
    path = tmp_path / f"drive{suffix}"
    made.write(path, frames_of())
    packed = tmp_path / f"drive{suffix}.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    for each in (path, packed):
        with can.LogReader(each) as reader:
            assert made.facts(reader) == made.facts(frames_of())


READER = """
import can

from cangauge.bus.readers import LineReader


class MyReader(LineReader):
    name = "my format"

    def prepare(self, head):
        return head[0].startswith("MINE")

    def parse(self, line):
        if line.startswith("MINE"):
            return None
        time, number, data = line.split()
        data = bytes.fromhex(data)
        return can.Message(timestamp=float(time), arbitration_id=int(number), data=data)
"""
READ = """
from pathlib import Path

from cangauge.bus.captures import open_capture

capture = open_capture(Path("mine"))
print([(f.timestamp, f.arbitration_id) for f in capture], capture.info["format"])
"""


def test_other_packages_add_readers(tmp_path: Path) -> None:
    (tmp_path / "mypackage.py").write_text(READER)
    package = tmp_path / "mypackage-1.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Name: mypackage\nVersion: 1\n")
    entry = "[cangauge.capture_readers]\nmine = mypackage:MyReader\n"
    (package / "entry_points.txt").write_text(entry)
    (tmp_path / "mine").write_text("MINE\n1.5 291 aabb\n2.5 292 cc\n")
    done = subprocess.run(
        [sys.executable, "-c", READ], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "[(1.5, 291), (2.5, 292)] my format\n"


def test_pcap_of_a_network_names_the_cure(tmp_path: Path) -> None:
    path = tmp_path / "lan.pcap"
    type("Lan", (TestPcap,), {"link": 1})().write(path, frames_of())
    with pytest.raises(InputError, match=r"none of its 40 packets is a CAN frame; .*tcpdump"):
        list(open_capture(path))


def test_a_cut_pcap_names_the_byte(tmp_path: Path) -> None:
    path = tmp_path / "cut.pcap"
    TestPcap().write(path, frames_of())
    path.write_bytes(path.read_bytes()[:30])
    with pytest.raises(InputError, match=r"cut\.pcap: the PCAP file is damaged .*at byte 30"):
        list(open_capture(path))


def test_a_blf_object_takes_no_more_memory_than_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.blf"
    with can.BLFWriter(path) as writer:
        writer.on_message_received(can.Message(timestamp=1e9, arbitration_id=0x123, data=bytes(8)))
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 144 + 8, 0xD0DC00C2)
    path.write_bytes(data)
    tracemalloc.start()
    try:
        assert len(list(open_capture(path))) == 1
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()


def test_a_blf_with_an_object_of_no_size_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "x.blf"
    with can.BLFWriter(path) as writer:
        writer.on_message_received(can.Message(timestamp=1e9, arbitration_id=0x123, data=bytes(8)))
    inner = struct.pack("<4sHHII", b"LOBJ", 16, 3, 0, 86) + bytes(32)
    outer = struct.pack("<H6xL4x", 0, len(inner)) + inner
    header = struct.pack("<4sHHII", b"LOBJ", 16, 1, 16 + len(outer), 10)
    path.write_bytes(path.read_bytes()[:144] + header + outer)
    with pytest.raises(InputError, match="damaged"):
        list(open_capture(path))
