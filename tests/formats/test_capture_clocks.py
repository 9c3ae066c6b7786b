"""Captures whose clocks start again, begin in the middle, or are of several sessions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.captures import Capture, open_capture
from live import in_process, succeeds

STEP_S = 0.1
SECONDS = 150
TIMES_S = STEP_S * np.arange(SECONDS * 10)
AMPS = np.repeat(np.random.default_rng(2).uniform(-60.0, 120.0, SECONDS), 10)
DATA = [
    (round(3700 - amps) & 0xFFFF).to_bytes(2, "little")
    + (round(10 * amps) & 0xFFFF).to_bytes(2, "little")
    + bytes([62, round(2 * soc), k % 256, 0])
    for k, (amps, soc) in enumerate(zip(AMPS, np.linspace(80.0, 75.0, len(AMPS)), strict=True))
]
NET_AH = float((AMPS[1:] + AMPS[:-1]).sum() / 2.0 * STEP_S / 3600.0)

Line = Callable[[float, str], str]


def clock(stamp_s: float, last: str = ":") -> str:
    ms = round(1000.0 * stamp_s)
    of_day = f"{ms // 3_600_000 % 24}:{ms // 60_000 % 60:02d}:{ms // 1000 % 60:02d}"
    return f"{of_day}{last}{ms % 1000:03d}"


def carbus(stamp_s: float, data: str) -> str:
    us = round(1e6 * stamp_s) % 60_000_000
    return f"{us // 1_000_000:02d},{us % 1_000_000:06d}\t1\t00000004\t356\t8\t{data}\t00000000\t \t"


def gvret(stamp_s: float, data: str) -> str:
    return f"{round(1e6 * stamp_s)},00000356,false,Rx,0,8,{data.replace(' ', ',')},"


def asc(stamp_s: float, data: str) -> str:
    return f"{stamp_s:.6f} 1 356 Rx d 8 {data}"


def asc_fd(stamp_s: float, data: str) -> str:
    return f"   {stamp_s:.6f} CANFD  1 Rx        356   1 0 8 08 {data.lower()} 0 0 3000 0 0 0 0 0"


def asc_dec(stamp_s: float, data: str) -> str:
    values = " ".join(str(int(each, 16)) for each in data.split())
    return f"{stamp_s:.6f} 1 854 Rx d 8 {values}"


def usb_can(stamp_s: float, data: str) -> str:
    where = "Receive      {}      Data frame      Standard frame      00000356"
    return f"7      {where.format(clock(stamp_s))}      8      {data.lower()}       "


def slcan(stamp_s: float, data: str) -> str:
    return f"t3568{data.replace(' ', '')}{round(1000.0 * stamp_s) % 60_000:04X}"


HEADS = {
    carbus: "@ TEXT @ 3 @ 64 @ 0 @ 6000 @ 600000 @ 00:10:00.000 @\n",
    gvret: "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n",
    asc: "date Mon Dec 6 11:21:13 am 2021\nbase hex  no internal events logged\n// version 7.1.0\n",
    asc_fd: "date Thu May 16 06:16:50.884 pm 2024\nbase hex  timestamps absolute\n"
    "internal events logged\n// version 8.2.0\nBegin Triggerblock Thu May 16 06:16:50 pm 2024\n"
    "   0.000000 Start der Messung\n",
    asc_dec: "date Do Mai 16 18:16:50.884 2024\nbase dec  timestamps absolute\n",
    usb_can: "NO    Direction  Time Scale        Frame Type      Frame Format        Frame ID\n",
    slcan: "",
}
DBC = (
    'VERSION ""\nNS_ :\nBS_:\nBU_: BMS\nBO_ 854 PACK: 8 BMS\n'
    ' SG_ U : 0|16@1+ (0.1,0) [0|0] "V" BMS\n SG_ I : 16|16@1- (0.1,0) [0|0] "A" BMS\n'
    ' SG_ T : 32|8@1+ (1,-40) [0|0] "degC" BMS\n SG_ S : 40|8@1+ (0.5,0) [0|0] "%" BMS\n'
)


def write(folder: Path, line: Line, stamps_s: Sequence[float], name: str = "drive.txt") -> Path:
    lines = (line(each, DATA[k].hex(" ").upper()) for k, each in enumerate(stamps_s))
    (folder / name).write_text(HEADS[line] + "".join(f"{each}\n" for each in lines))
    (folder / "pack.dbc").write_text(DBC)
    (folder / "map.toml").write_text(
        'dbc = "pack.dbc"\ncurrent = "I"\nvoltage = "U"\ntemperature = "T"\nsoc = "S"\n'
    )
    return folder / name


def read(path: Path) -> tuple[list[can.Message], Capture]:
    capture = open_capture(path)
    return list(capture), capture


KINDS: dict[str, tuple[Line, np.ndarray]] = {
    "carbus, seconds of a minute": (carbus, 39.6 + TIMES_S),
    "gvret of slcan": (gvret, (17.3 + TIMES_S) % 60.0),
    "gvret, fractions of a second": (gvret, TIMES_S % 1.0),
    "gvret, 32 bits of microseconds": (gvret, (4290.0 + TIMES_S) % (2**32 / 1e6)),
    "gvret, negative": (gvret, TIMES_S - 1769872318.0),
    "asc, negative": (asc, TIMES_S - 30.0),
    "asc, no trigger block": (asc, TIMES_S + 40874.8082),
    "asc, canfd": (asc_fd, TIMES_S + 594680.670773),
    "asc, decimal": (asc_dec, TIMES_S),
    "usb-can, past midnight": (usb_can, TIMES_S + 86350.0),
    "slcan": (slcan, TIMES_S + 12.0),
}


@pytest.mark.parametrize("name", list(KINDS))
def test_every_frame_is_read_at_its_time(tmp_path: Path, name: str) -> None:
    line, stamps_s = KINDS[name]
    path = write(tmp_path, line, stamps_s.tolist())
    frames, capture = read(path)
    times_s = np.array([each.timestamp for each in frames])
    assert (capture.info["frames"], capture.info["malformed"]) == (len(TIMES_S), 0)
    assert np.diff(times_s) == pytest.approx(STEP_S, abs=2e-3)
    assert frames[0].timestamp == pytest.approx(stamps_s[0], abs=1e-3)
    found = succeeds("inspect", path, "--map", tmp_path / "map.toml", "--json").json
    assert found["log"]["rows"] == len(TIMES_S)
    assert found["log"]["charge"]["net_ah"] == pytest.approx(NET_AH, abs=1e-3)
    turns = round(times_s[-1] - times_s[0] - (stamps_s[-1] - stamps_s[0]))
    is_said = any("the clock starts again every" in each for each in capture.info["remarks"])
    assert is_said == (turns > 0 or line in {carbus, slcan, usb_can})


def test_sessions_pasted_together_follow_each_other(tmp_path: Path) -> None:
    stamps_s = np.concatenate([TIMES_S[:700] + 3.0, TIMES_S[:800]])
    path = write(tmp_path, gvret, stamps_s.tolist())
    found = succeeds("inspect", path, "--map", tmp_path / "map.toml", "--json").json
    assert "2 sessions in one file" in " ".join(found["remarks"])
    assert found["log"]["rows"] == 1500
    apart_ah = (AMPS[699] + AMPS[700]) / 2.0 * STEP_S / 3600.0
    assert found["log"]["charge"]["net_ah"] == pytest.approx(NET_AH - apart_ah, abs=1e-3)
    assert found["time_reversals"] == 0


@pytest.mark.parametrize("before_s", [101.6, -1.7e9])
def test_stale_rows_at_the_head_are_left_out_and_said(tmp_path: Path, before_s: float) -> None:
    stamps_s = TIMES_S.copy()
    stamps_s[:4] += before_s
    frames, capture = read(write(tmp_path, gvret, stamps_s.tolist()))
    assert [each.timestamp for each in frames] == pytest.approx(TIMES_S[4:])
    assert "4 frames at the head left out, with stamps of another time" in capture.info["remarks"]


def test_two_adapters_with_two_clocks_are_two_times(tmp_path: Path) -> None:
    with can.CanutilsLogWriter(tmp_path / "x.log") as log:
        for k, time_s in enumerate(TIMES_S):
            stamp_s = time_s + (5000.0 if k % 2 else 0.0)
            log(can.Message(stamp_s, 0x100, data=b"a", channel=f"can{k % 2}", is_extended_id=False))
    frames, capture = read(tmp_path / "x.log")
    assert [each.timestamp for each in frames[::2]] == pytest.approx(TIMES_S[::2])
    assert [each.timestamp for each in frames[1::2]] == pytest.approx(TIMES_S[1::2] + 5000.0)
    assert capture.info["remarks"] == ()


def test_a_late_frame_at_the_turn_of_a_minute_stays_before_it(tmp_path: Path) -> None:
    stamps_s = [59.8, 59.9, 60.02, 59.99, *(60.1 + TIMES_S[:50])]
    frames, capture = read(write(tmp_path, carbus, stamps_s))
    assert [each.timestamp for each in frames] == pytest.approx(stamps_s)
    assert capture.info["remarks"] == ("the clock starts again every 60 s (1 times): time goes on",)


def test_time_that_runs_backwards_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, gvret, (1769872318.0 - TIMES_S).tolist())
    done = in_process("inspect", path, "--map", tmp_path / "map.toml")
    assert done.code == 2
    assert "time runs backwards" in done.err


@pytest.mark.parametrize("line", [asc, asc_fd, asc_dec, usb_can, slcan], ids=lambda f: f.__name__)
def test_lines_that_are_no_frames_are_counted(tmp_path: Path, line: Line) -> None:
    path = write(tmp_path, line, TIMES_S[:50].tolist())
    lines = path.read_text().splitlines()
    lines[-20] = line(3.0, "00 11 2")  # a byte too few
    lines[-10] = "!!! buffer overrun"
    path.write_text("\n".join([*lines, ""]))
    frames, capture = read(path)
    assert (len(frames), capture.info["malformed"]) == (48, 2)
    assert "2 malformed lines skipped" in " ".join(capture.info["remarks"])


TRC = (
    ";$FILEVERSION=1.1\n;$STARTTIME=43008.9206018519\n"
    "      1)       1.0  Rx         0356  2  01 02\n"
    "      2)       2.0  Warng  FFFFFFFF  4  00 00 00 04  BUSLIGHT\n"
    "      3)       3.0  Rx         0356  2  01 02\n"
    "      4)       4.0  Error      0040  2  01 02\n"
    "      5)       5.0  Rx         0356  2  01 02\n"
)


def test_lines_that_python_can_leaves_out_are_said(tmp_path: Path) -> None:
    (tmp_path / "x.trc").write_text(TRC)
    frames, capture = read(tmp_path / "x.trc")
    assert len(frames) == 3
    assert "2 lines left out, which python-can does not read" in capture.info["remarks"]


CSV = (
    "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.0,0x356,0,0,0,2,AQI=\n"
    "2.0,0x3Z6,0,0,0,2,AQI=\n3.0,0x356,0,0,0,2,AQI=\n4.0,0x356,0\n5.0,0x356,0,0,0,2,AQI=\n"
)


@pytest.mark.parametrize("text", [TRC.replace("0040", "00").replace("Error      ", "Rx  x"), CSV])
def test_a_malformed_line_does_not_end_what_python_can_reads(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.csv").write_text(text)
    frames, capture = read(tmp_path / "x.csv")
    assert len(frames) == 3
    assert not capture.info["cut_off"]
    said = [int(remark.split()[0]) for remark in capture.info["remarks"]]
    assert sum(said) == 2
