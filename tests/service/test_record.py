"""Recording: exact reading back, parts, limits, requests, full and hanging disks, kills."""

from __future__ import annotations

import copy
import errno
import os
import signal
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from cangauge.bus.captures import all_parts, open_capture, parts_of_run
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.service import record
from cangauge.service.offline import RecordedEstimate, estimate_capture
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder, check_recording
from cangauge.service.status_client import Snapshot
from cangauge.types import Estimate
from live import LoggedLines, frames_of, in_process, leaf_model, leaf_model_path, short_log, waits

SNAPSHOT = Snapshot(0.0, {})


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a busy machine take its time to complete the recording."""
    monkeypatch.setattr(record, "CLOSE_WITHIN_S", 30.0)


def frames(seconds: float, begin_s: float = 1.7e9, preset: str = "generic") -> list[can.Message]:
    """Return a drive's frames as a kernel stamps them: to the microsecond and below."""
    found = frames_of(short_log(seconds), Vehicle.load(preset), begin_s)
    for number, frame in enumerate(found):
        frame.timestamp += 1.234567e-4 * (number % 7)
        frame.channel = "vcan0"
    return found


def content(path: Path) -> list[tuple[int, int, bytes]]:
    return expected(list(open_capture(path)))


def expected(messages: list[can.Message]) -> list[tuple[int, int, bytes]]:
    return [(round(m.timestamp * 1e6), m.arbitration_id, bytes(m.data)) for m in messages]


def write(recorder: Recorder, messages: list[can.Message]) -> None:
    for number, message in enumerate(messages):
        recorder.on_frame(message)
        if number % 50 == 49:
            recorder.on_snapshot(SNAPSHOT)
    recorder.on_snapshot(SNAPSHOT)


def live_and_recorded(
    path: Path, messages: list[can.Message], pipeline: Pipeline, part_mb: float | None = None
) -> tuple[list[Estimate], Recorder]:
    """Handle frames as the loop does; return the estimates and the closed recorder."""
    live = []
    with closing(Recorder(path, part_mb)) as recorder:
        for number, message in enumerate(messages):
            recorder.on_frame(message)
            if part_mb and number % 100 == 0:
                recorder.on_snapshot(SNAPSHOT)
                assert waits(lambda: recorder.state["frames"] == number + 1)  # noqa: B023
            if pipeline.handle(message):
                live.append(pipeline.latest)
        if pipeline.finish():
            live.append(pipeline.latest)
    return live, recorder


def assert_same(recorded: RecordedEstimate, live: list[Estimate]) -> None:
    """Bit for bit."""
    assert len(live) == recorded.table.soc_pct.size > 0
    for name in ("time_s", "soc_pct", "soc_std_pct", "soc_newton_pct", "residual_v"):
        numbers = np.array([getattr(each, name) for each in live])
        assert np.array_equal(getattr(recorded.table, name), numbers, equal_nan=True), name


@pytest.mark.parametrize(
    ("suffix", "preset", "part_mb"),
    [(".log", "leaf_aze0", None), (".log.gz", "generic", None), (".log.gz", "generic", 0.005)],
)
def test_a_recording_gives_the_live_numbers(
    tmp_path: Path, suffix: str, preset: str, part_mb: float | None
) -> None:
    """With a clock that is set back, voltages that are missing, and a current at the end."""
    messages = frames(90.0, preset=preset)
    for message in messages[len(messages) // 2 :]:
        message.timestamp -= 4000.0
    messages = [m for n, m in enumerate(messages) if m.arbitration_id != 0x401 or n % 3]
    pipeline, sent = Pipeline(Vehicle.load(preset), leaf_model()), expected(messages)
    live, recorder = live_and_recorded(tmp_path / f"x{suffix}", messages, pipeline, part_mb)
    assert (recorder.state["lost_frames"], recorder.state["frames"]) == (0, len(messages))
    if part_mb:
        assert recorder.written == tmp_path / f"x-0001{suffix}"
        assert len(parts_of_run(recorder.written)) >= 3
    assert content(recorder.written) == sent
    recorded = estimate_capture(recorder.written, Vehicle.load(preset), leaf_model())
    assert_same(recorded, live)
    assert np.isnan(recorded.recorded.voltage_v).any() == (preset == "generic")


def test_a_recorded_replay_uses_the_logs_time(tmp_path: Path) -> None:
    """Of two replays in a row each log is estimated separately."""
    messages = list[can.Message]()
    for frame in frames_of(short_log(30.0)) * 2:
        messages += [clock_frame(round(frame.timestamp * 1e6)), copy.copy(frame)]
    for number, message in enumerate(messages):
        message.timestamp = 1.7e9 + 1e-4 * number
    settings = PipelineSettings(time_source="replay-clock")
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model(), settings)
    live, recorder = live_and_recorded(tmp_path / "replayed.log", messages, pipeline)
    recorded = estimate_capture(recorder.written, pipeline.vehicle, leaf_model())
    assert_same(recorded, live)
    assert recorded.time_source == "replay-clock"
    assert recorded.counts is not None
    assert recorded.counts["beginnings"] == 1
    assert recorded.table.time_s[:3].tolist() == [0.0, 0.1, 0.2]


def test_a_capture_of_another_bus_is_refused(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path / "other.log")) as recorder:
        recorder.on_frame(can.Message(timestamp=1.0, arbitration_id=5, data=b"1"))
    with pytest.raises(InputError, match="no sample"):
        estimate_capture(recorder.written, Vehicle.load("generic"), leaf_model())


def test_a_command_takes_the_name_of_a_run(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path / "drive.log", part_mb=0.002)) as recorder:
        write(recorder, frames(20.0))
    arguments = (recorder.written, "--vehicle", "generic", "--json")
    ended = in_process("estimate", *arguments, "-m", leaf_model_path(), "-o", tmp_path / "soc.csv")
    assert (ended.code, ended.json["rows"]) == (0, 200), ended.err


def test_an_existing_recording_is_never_replaced(tmp_path: Path) -> None:
    names = ("drive.log", "drive-0001.log", "drive-0002.log")
    for number, name in enumerate(names):
        with closing(Recorder(tmp_path / "drive.log")) as recorder:
            write(recorder, frames(1.0, 1.7e9 + 100.0 * number))
        assert recorder.written == tmp_path / name
    for number, name in enumerate(names):
        assert content(tmp_path / name) == expected(frames(1.0, 1.7e9 + 100.0 * number))


def test_the_oldest_parts_are_removed(tmp_path: Path) -> None:
    for _ in range(3):
        with closing(Recorder(tmp_path / "drive.log", 0.004, 0.04)) as recorder:
            write(recorder, frames(30.0))
    parts = all_parts(tmp_path / "drive.log")
    assert {run for run, _, _ in parts} <= {2, 3}
    assert 30_000 < sum(part.stat().st_size for _, _, part in parts) < 40_000 + 3 * 4_500
    assert recorder.written.name == "drive-0003.log"


def test_an_old_part_that_cannot_be_removed_ends_no_start(tmp_path: Path) -> None:
    (tmp_path / "r-0001-000001.log").mkdir()
    (tmp_path / "r-0001-000002.log").write_bytes(bytes(2000))
    with LoggedLines("cangauge.service.record") as logged:
        recorder = Recorder(tmp_path / "r.log", 0.001, 0.001)
        recorder.on_frame(can.Message())
        recorder.close()
    assert recorder.state["lost_frames"] == 1
    assert any("writing is retried" in line for line in logged.lines)


def test_impossible_recordings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="record_part_mb"):
        check_recording(tmp_path / "drive.log", None, 1.0)
    with pytest.raises(InputError, match="does not exist"):
        check_recording(tmp_path / "no" / "drive.log", None, None)
    for name in ("drive.asc", "drive.csv", "drive", "drive.gz"):
        with pytest.raises(InputError, match="candump"):
            check_recording(tmp_path / name, None, None)
    os.mkfifo(tmp_path / "pipe.log")
    (tmp_path / "null.log").symlink_to(os.devnull)
    for name in ("pipe.log", "null.log"):
        with pytest.raises(InputError, match="a device or a pipe"):
            check_recording(tmp_path / name, None, None)
    with closing(Recorder(tmp_path / "private.log")):
        pass
    assert (tmp_path / "private.log").stat().st_mode & 0o777 == 0o640 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_full_disk_costs_frames_of_the_recording_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    is_full = threading.Event()
    real = os.write

    def half(descriptor: int, data: Any) -> int:
        done = real(descriptor, bytes(data)[: max(len(data) // 2, 1)])
        if is_full.is_set():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return done

    monkeypatch.setattr(record.os, "write", half)
    messages = frames(60.0)
    with closing(Recorder(tmp_path / "drive.log")) as recorder:
        write(recorder, messages[:400])
        assert waits(lambda: recorder.state["frames"] == 400)
        is_full.set()
        write(recorder, messages[400:800])
        assert waits(lambda: recorder.state["frames"] == 800)
        assert recorder.state is not None
        assert recorder.state["problem"] == "No space left on device"
        is_full.clear()
        write(recorder, messages[800:])
        assert waits(lambda: recorder.state["frames"] == len(messages))
        assert (recorder.state["problem"], recorder.state["lost_frames"]) == (None, 400)
        is_full.set()
        write(recorder, messages[:100])
    assert recorder.state["lost_frames"] == 500
    # The file is whole lines: a part in the middle is missing, and nothing else.
    assert content(recorder.written) == expected(messages[:400] + messages[800:])
    events = [getattr(each, "event", "") for each in caplog.records]
    assert {"record.failed", "record.resumed"} <= set(events)


def test_a_hanging_disk_delays_neither_loop_nor_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = threading.Event()
    monkeypatch.setattr(record, "CLOSE_WITHIN_S", 0.1)
    monkeypatch.setattr(record, "BATCHES_WAITING", 5)
    monkeypatch.setattr(record.os, "write", lambda *_: free.wait(300.0))
    recorder = Recorder(tmp_path / "drive.log")
    ended = threading.Event()

    def record_all() -> None:
        write(recorder, frames(120.0))
        recorder.close()
        ended.set()

    threading.Thread(target=record_all, daemon=True).start()
    assert ended.wait(120.0)  # the disk hangs for 300 s
    free.set()


def test_a_folder_that_goes_and_comes_back(tmp_path: Path) -> None:
    folder = tmp_path / "stick"
    folder.mkdir()
    messages = frames(20.0)
    with closing(Recorder(folder / "drive.log", part_mb=0.002)) as recorder:
        write(recorder, messages[:100])
        assert waits(lambda: recorder.state["frames"] == 100)
        folder.rename(tmp_path / "gone")
        write(recorder, messages[100:200])
        assert waits(lambda: recorder.state["frames"] == 200)
        assert recorder.state is not None
        assert recorder.state["problem"] == "No such file or directory"
        (tmp_path / "gone").rename(folder)
        write(recorder, messages[200:])
    assert recorder.state["problem"] is None
    assert 0 < recorder.state["lost_frames"] <= 100
    assert len(content(recorder.written)) == len(messages) - recorder.state["lost_frames"]


CHILD = """
import sys, time, can
from contextlib import closing
from cangauge.service.record import Recorder
from cangauge.service.status_client import Snapshot
with closing(Recorder(sys.argv[1])) as recorder:
    for number in range(100_000):
        recorder.on_frame(can.Message(
            timestamp=1.7e9 + 0.001 * number, arbitration_id=0x123, data=number.to_bytes(8, "big")
        ))
        if number % 50 == 49:
            recorder.on_snapshot(Snapshot(0.0, {}))
            while recorder.state["frames"] <= number:
                time.sleep(0.001)
            print(number, flush=True)
"""


def test_a_kill_loses_only_what_was_not_handed_over(tmp_path: Path) -> None:
    path = tmp_path / "drive.log.gz"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE)
    assert child.stdout is not None
    lines = [int(child.stdout.readline()) for _ in range(20)]
    child.send_signal(signal.SIGKILL)
    child.wait()
    numbers = [int.from_bytes(data, "big") for _, _, data in content(path)]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) > lines[-1]
