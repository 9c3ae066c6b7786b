"""Recording: parts, limits, full disks, kills, and exact reading back."""

from __future__ import annotations

import errno
import io
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from cangauge.bus.captures import (
    all_parts,
    is_capture,
    open_capture,
    part_path,
    parts_of_run,
    run_path,
)
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.offline import samples_of
from cangauge.replay.steps import CaptureSource
from cangauge.service import recording
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline
from cangauge.service.recording import RecordBuffer, Recorder, RecordLimits
from live import in_process, leaf_model, leaf_model_path, short_log, waits

FORMATS = [".log", ".csv", ".log.gz", ".blf", ".mf4", ".mcap"]


def frames(seconds: float, begin_s: float = 1.7e9) -> list[can.Message]:
    encoder = FrameEncoder(Vehicle.load("generic"))
    found = []
    for number, sample in enumerate(samples_of(short_log(seconds))):
        for frame in encoder.encode(sample):
            # Stamps to the microsecond and below, as a kernel gives them.
            frame.timestamp = begin_s + sample.time_s + 1.234567e-4 * (number % 7)
            frame.channel = "vcan0"
            found.append(frame)
    return found


def content(path: Path) -> list[tuple[int, int, bytes]]:
    return [
        (round(message.timestamp * 1e6), message.arbitration_id, bytes(message.data))
        for message in open_capture(path)
    ]


def expected(messages: list[can.Message]) -> list[tuple[int, int, bytes]]:
    return [(round(m.timestamp * 1e6), m.arbitration_id, bytes(m.data)) for m in messages]


def hand_over(recorder: Recorder) -> None:
    recorder.tick(recorder._handed_s + 1.0)


def need(suffix: str) -> None:
    if suffix == ".mf4":
        pytest.importorskip("asammdf")


@pytest.mark.parametrize("suffix", FORMATS)
def test_parts_are_one_capture_and_give_the_live_numbers(tmp_path: Path, suffix: str) -> None:
    need(suffix)
    messages = frames(60.0)
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    live = []
    now = [0.0]
    limits = RecordLimits(part_bytes=20_000, part_s=12.0)
    with Recorder(tmp_path / f"drive{suffix}", limits, clock=lambda: now[0]) as recorder:
        for number, message in enumerate(messages):
            now[0] = 0.03 * number
            recorder.write(message)
            recorder.tick(now[0])
            before = pipeline.samples
            pipeline.handle(message)
            if pipeline.samples != before:
                live.append(pipeline.latest)
    assert recorder.state.lost_frames == 0
    assert recorder.path == tmp_path / f"drive-0001{suffix}"
    parts = parts_of_run(recorder.path)
    assert len(parts) >= 3
    assert is_capture(recorder.path)
    assert content(recorder.path) == expected(messages)
    offline = estimate_capture(recorder.path, Vehicle.load("generic"), leaf_model()).table
    for name in ("time_s", "soc_pct", "soc_std_pct", "residual_v"):
        told = np.array([getattr(each, name) for each in live])
        assert np.array_equal(getattr(offline, name), told, equal_nan=True), name
    # And so does replay: as many samples, from the same name.
    source = CaptureSource(recorder.path, Vehicle.load("generic"))
    assert sum(len(step.frames) for step in source.steps(loop=False)) == len(messages)


def test_the_commands_take_the_name_of_a_run(tmp_path: Path) -> None:
    with Recorder(tmp_path / "drive.log", RecordLimits(part_bytes=10_000)) as recorder:
        for message in frames(20.0):
            recorder.write(message)
    arguments = (recorder.path, "--vehicle", "generic", "--json")
    ended = in_process("estimate", *arguments, "-m", leaf_model_path(), "-o", tmp_path / "soc.csv")
    assert (ended.code, ended.json["rows"]) == (0, 200), ended.err
    ended = in_process("inspect", *arguments)
    assert ended.code == 0, ended.err
    ended = in_process("inspect", tmp_path / "drive-0002.log", "--vehicle", "generic")
    assert ended.code == 2
    assert "no such file" in ended.err


@pytest.mark.parametrize("suffix", [".log", ".csv", ".blf", ".mcap"])
def test_a_clock_that_is_set_back_is_kept(tmp_path: Path, suffix: str) -> None:
    messages = frames(5.0) + frames(5.0, begin_s=1.6e9) + frames(5.0, begin_s=12.0)
    with Recorder(tmp_path / f"drive{suffix}") as recorder:
        for message in messages:
            recorder.write(message)
    assert content(recorder.path) == expected(messages)


def test_without_limits_a_run_keeps_the_previous_file(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    for number, name in enumerate(("drive.log", "drive-0001.log", "drive-0002.log")):
        begin_s = 1.7e9 + 100.0 * number
        with Recorder(path) as recorder:
            for message in frames(1.0, begin_s):
                recorder.write(message)
        assert recorder.path == tmp_path / name
    for number, name in enumerate(("drive.log", "drive-0001.log", "drive-0002.log")):
        assert content(tmp_path / name) == expected(frames(1.0, 1.7e9 + 100.0 * number))
    with Recorder(tmp_path / "none.csv"):
        pass
    assert (tmp_path / "none.csv").exists()


def test_runs_are_numbered_and_the_oldest_parts_are_removed(tmp_path: Path) -> None:
    limits = RecordLimits(part_bytes=4_000, keep_bytes=40_000)
    for _ in range(3):
        with Recorder(tmp_path / "drive.log", limits) as recorder:
            for message in frames(30.0):
                recorder.write(message)
    parts = all_parts(tmp_path / "drive.log")
    assert {part.run for part in parts} <= {2, 3}
    assert parts[-1].run == 3
    total = sum(part.path.stat().st_size for part in parts)
    assert 30_000 < total < 40_000 + 2 * 4_500
    # What others put there is left alone.
    assert recorder.path.name == "drive-0003.log"


def test_names() -> None:
    base = Path("a/drive.log.gz")
    assert part_path(base, 3, 12) == Path("a/drive-0003-000012.log.gz")
    assert run_path(base, 3) == Path("a/drive-0003.log.gz")
    assert all_parts(Path("/nowhere/drive.log")) == []
    assert parts_of_run(Path("/nowhere/drive.log")) == []


def test_a_file_of_that_name_is_itself(tmp_path: Path) -> None:
    with Recorder(tmp_path / "drive.log", RecordLimits(part_bytes=1_000)) as recorder:
        for message in frames(3.0):
            recorder.write(message)
    with Recorder(recorder.path) as single:
        single.write(frames(1.0)[0])
    assert len(content(recorder.path)) == 1


@pytest.mark.parametrize("suffix", [".log", ".csv", ".blf"])
@pytest.mark.parametrize("damage", ["empty", "absent", "cut"])
def test_a_part_that_is_damaged_costs_itself(tmp_path: Path, suffix: str, damage: str) -> None:
    with Recorder(tmp_path / f"drive{suffix}", RecordLimits(part_bytes=6_000)) as recorder:
        for number, message in enumerate(frames(30.0)):
            recorder.write(message)
            if number % 100 == 0:
                hand_over(recorder)
    parts = parts_of_run(recorder.path)
    whole = content(recorder.path)
    broken = parts[-1] if damage == "cut" else parts[0]
    if damage == "absent":
        broken.unlink()
    else:
        broken.write_bytes(broken.read_bytes()[: 300 if damage == "cut" else 0])
    left = content(recorder.path)
    assert 0 < len(left) < len(whole)
    assert left == (whole[: len(left)] if damage == "cut" else whole[-len(left) :])


def test_limits_that_make_no_sense(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="record_part_mb"):
        RecordLimits(keep_bytes=1)
    with pytest.raises(InputError, match="does not exist"):
        Recorder(tmp_path / "no" / "drive.log")
    (tmp_path / "folder.log").mkdir()
    with pytest.raises(InputError, match="this is a folder"):
        Recorder(tmp_path / "folder.log")


class FailingFile(io.FileIO):
    """A file on a disk that is full now and then, and takes half of what it is given."""

    is_full = False

    def write(self, data: Any, /) -> int:
        if FailingFile.is_full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(bytes(data)[: max(len(data) // 2, 1)])


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> type[FailingFile]:
    monkeypatch.setattr(recording.io, "FileIO", FailingFile)
    monkeypatch.setattr(recording, "RETRY_S", 0.02)
    monkeypatch.setattr(FailingFile, "is_full", False)
    return FailingFile


@pytest.mark.parametrize("suffix", [".log", ".blf"])
def test_a_full_disk_costs_frames_of_the_recording_only(
    tmp_path: Path,
    failing: type[FailingFile],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    suffix: str,
) -> None:
    monkeypatch.setattr(recording, "WAITING_BYTES", 4_000)
    messages = frames(60.0)
    with Recorder(tmp_path / f"drive{suffix}") as recorder:
        for number, message in enumerate(messages):
            failing.is_full = 400 <= number < 800
            began = time.perf_counter()
            recorder.write(message)
            if number % 20 == 0:
                hand_over(recorder)
                time.sleep(0.002)
            assert time.perf_counter() - began < 0.5
            if number == 799:
                assert waits(lambda: recorder.state.problem is not None)
                assert recorder.state.problem == "No space left on device"
                failing.is_full = False
                recorder._disk.writer.max_waiting_bytes = 1 << 20
                assert waits(lambda: recorder.state.problem is None)
    state = recorder.state
    assert state.problem is None
    assert state.frames == len(messages)
    assert 0 < state.lost_frames <= 400
    # What is there is whole: a part in the middle is missing, and nothing else.
    kept, all_of_them = content(recorder.path), expected(messages)
    assert len(kept) == len(messages) - state.lost_frames
    assert kept[:300] == all_of_them[:300]
    assert kept[-300:] == all_of_them[-300:]
    assert set(kept) <= set(all_of_them)
    events = [getattr(record, "event", "") for record in caplog.records]
    assert "record.failed" in events
    assert "record.resumed" in events


def test_a_disk_that_is_full_for_good(tmp_path: Path) -> None:
    """The real thing: every write to /dev/full fails."""
    path = tmp_path / "drive.log"
    path.symlink_to("/dev/full")
    began = time.monotonic()
    with Recorder(path) as recorder:
        for message in frames(30.0):
            recorder.write(message)
        hand_over(recorder)
        assert waits(lambda: recorder.state.problem is not None)
    assert time.monotonic() - began < 3.0
    assert recorder.state.lost_frames == recorder.frames == len(frames(30.0))


def test_a_folder_that_goes_and_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "RETRY_S", 0.02)
    folder = tmp_path / "stick"
    folder.mkdir()
    messages = frames(20.0)
    with Recorder(folder / "drive.log", RecordLimits(part_bytes=5_000)) as recorder:
        for message in messages[:100]:
            recorder.write(message)
        hand_over(recorder)
        assert waits(lambda: recorder.state.written_bytes > 1000)
        folder.rename(tmp_path / "gone")
        for message in messages[100:]:
            recorder.write(message)
        hand_over(recorder)
        assert waits(lambda: recorder.state.problem is not None)
        (tmp_path / "gone").rename(folder)
        assert waits(lambda: recorder.state.problem is None)
    assert recorder.state.lost_frames == 0
    assert content(recorder.path) == expected(messages)


def test_a_hanging_disk_delays_neither_loop_nor_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hang = threading.Event()

    class Hanging(io.FileIO):
        def write(self, data: Any, /) -> int:
            hang.wait(20.0)
            return super().write(data)

    monkeypatch.setattr(recording.io, "FileIO", Hanging)
    began = time.monotonic()
    with Recorder(tmp_path / "drive.log") as recorder:
        for message in frames(30.0):
            recorder.write(message)
            hand_over(recorder)
    assert time.monotonic() - began < 2.0
    assert recorder.state.lost_frames > 0
    hang.set()


CHILD = """
import sys, time, can
from cangauge.service.recording import Recorder
with Recorder(sys.argv[1]) as recorder:
    for number in range(100_000):
        recorder.write(can.Message(
            timestamp=1.7e9 + 0.001 * number, arbitration_id=0x123, data=number.to_bytes(8, "big")
        ))
        recorder.tick(time.monotonic())
        if number % 50 == 0:
            print(number, flush=True)
            time.sleep(0.05)
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".log", ".csv", ".log.gz", ".blf"])
def test_a_kill_loses_no_more_than_the_last_half_second(tmp_path: Path, suffix: str) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(tmp_path / f"drive{suffix}")], stdout=subprocess.PIPE
    )
    assert child.stdout is not None
    stamps = []
    for line in child.stdout:
        stamps.append((time.monotonic(), int(line)))
        if stamps[-1][0] - stamps[0][0] > 2.0:
            break
    killed_s = time.monotonic()
    child.send_signal(signal.SIGKILL)
    child.wait()
    name = tmp_path / (f"drive-0001{suffix}" if suffix == ".blf" else f"drive{suffix}")
    numbers = [int.from_bytes(data, "big") for _, _, data in content(name)]
    assert numbers == list(range(len(numbers)))
    # Handed over every 0.5 s; as much again for a machine that is busy.
    safe = max(number for said_s, number in stamps if said_s < killed_s - 1.0)
    assert len(numbers) > safe > 0
    if suffix == ".blf":  # stamps count from the header, which is right from the beginning
        assert content(name)[0][0] == 1_700_000_000_000_000


def test_a_file_in_memory_is_one_file() -> None:
    written: list[tuple[bytes, int, int | None]] = []

    file = RecordBuffer(lambda *piece: written.append(piece))
    file.write(b"headxx")
    file.seek(4)
    file.write(b"er")
    file.hand_over(0)
    file.write(b"body")
    end = file.tell()
    file.seek(0)
    file.write(b"HEAD")
    file.seek(end)
    file.write(b"!")
    assert file.waiting == 5
    file.hand_over(3)
    assert written == [(b"header", 0, None), (b"body!", 3, None), (b"HEAD", 0, 0)]
    assert file.seek(0, io.SEEK_END) == 11
    assert file.seek(-1, io.SEEK_CUR) == 10
