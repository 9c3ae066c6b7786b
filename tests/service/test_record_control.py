"""A recording that begins and ends while the service runs."""

from __future__ import annotations

import time
from pathlib import Path

import can
import pytest

from cangauge.bus.captures import all_parts, open_capture
from cangauge.service.record_control import RecordControl
from cangauge.service.recording import RecordLimits
from live import waits


def frame(number: int) -> can.Message:
    return can.Message(
        timestamp=1.7e9 + number, arbitration_id=0x123, data=[number], is_extended_id=False
    )


def turned(control: RecordControl, *, active: bool, problem: bool = False) -> bool:
    """Return whether the recording begins or ends, as the loop turns."""

    def is_so() -> bool:
        control.tick(time.monotonic())
        state = control.state
        return state is not None and (state.is_active, bool(state.problem)) == (active, problem)

    return waits(is_so)


def numbers(path: Path) -> list[int]:
    return [message.data[0] for message in open_capture(path)]


def test_frames_between_the_requests_are_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with RecordControl(None, RecordLimits()) as control:
        control.write(frame(1))
        assert control.state is None
        assert control.written == ()
        control.request(active=True)
        assert turned(control, active=True)
        control.write(frame(2))
        control.write(frame(3))
        control.request(active=False)
        assert turned(control, active=False)
        control.write(frame(4))
        [path] = tmp_path.glob("cangauge-*Z.log")
        assert waits(lambda: path.stat().st_size > 0)
        assert control.state is not None
        assert (control.state.path, control.state.frames) == (str(path), 2)
    assert control.written == (path,)
    assert numbers(path) == [2, 3]


def test_each_request_is_a_run_of_the_named_file(tmp_path: Path) -> None:
    path = tmp_path / "drive.log"
    with RecordControl(path, RecordLimits()) as control:
        control.write(frame(1))
        control.request(active=False)
        assert turned(control, active=False)
        control.request(active=True)
        assert turned(control, active=True)
        control.write(frame(2))
    assert numbers(path) == [1]
    assert control.written == (path, tmp_path / "drive-0001.log")
    assert numbers(control.written[1]) == [2]
    assert len(all_parts(path)) == 1


def test_a_refused_recording_can_be_asked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setattr(Path, "cwd", lambda: folder)
    folder.rmdir()
    with RecordControl(None, RecordLimits()) as control:
        control.request(active=True)
        assert turned(control, active=False, problem=True)
        control.write(frame(1))
        folder.mkdir()
        control.request(active=True)
        assert turned(control, active=True)
        control.write(frame(2))
    [written] = control.written
    assert numbers(written) == [2]


def test_a_hanging_disk_does_not_hold_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(*_: object) -> None:
        time.sleep(0.3)
        raise OSError(5, "Input/output error")

    control = RecordControl(tmp_path / "drive.log", RecordLimits())
    monkeypatch.setattr("cangauge.service.record_control.Recorder.__init__", slow)
    longest_s = 0.0
    with control:
        for active in (False, True):
            control.request(active=active)
            for turn in range(60):
                began = time.perf_counter()
                control.write(frame(turn))
                control.tick(time.monotonic())
                longest_s = max(longest_s, time.perf_counter() - began)
                time.sleep(0.005)
        assert turned(control, active=False, problem=True)
    assert longest_s < 0.1


@pytest.mark.parametrize(
    ("limit", "words"), [("REQUESTED_BYTES", "record_keep_mb"), ("FREE_BYTES", "GB free")]
)
def test_a_requested_recording_ends_at_its_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, words: str
) -> None:
    path = tmp_path / "drive.log"
    monkeypatch.setattr("cangauge.service.record_control.CHECK_S", 0.0)
    with RecordControl(path, RecordLimits()) as control:
        assert turned(control, active=True)
        control.request(active=False)
        assert turned(control, active=False)
        control.request(active=True)
        assert turned(control, active=True)
        control.write(frame(2))
        monkeypatch.setattr(
            f"cangauge.service.record_control.{limit}", 1 if limit == "REQUESTED_BYTES" else 1 << 60
        )
        assert turned(control, active=False, problem=True)
        control.write(frame(3))
        assert control.state is not None
        assert words in str(control.state.problem)
    assert numbers(control.written[-1]) == [2]


def test_a_full_disk_refuses_a_requested_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cangauge.service.record_control.FREE_BYTES", 1 << 60)
    with RecordControl(None, RecordLimits()) as control:
        control.request(active=True)
        assert turned(control, active=False, problem=True)
    assert control.written == ()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("limits", [RecordLimits(), RecordLimits(part_s=60.0, keep_bytes=1 << 40)])
def test_what_the_configuration_states_is_not_cut_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limits: RecordLimits
) -> None:
    monkeypatch.setattr("cangauge.service.record_control.CHECK_S", 0.0)
    monkeypatch.setattr("cangauge.service.record_control.FREE_BYTES", 1 << 60)
    with RecordControl(tmp_path / "drive.log", limits) as control:
        for number in range(20):
            control.write(frame(number))
            control.tick(time.monotonic())
            time.sleep(0.01)
        assert control.state is not None
        assert (control.state.is_active, control.state.frames) == (True, 20)
