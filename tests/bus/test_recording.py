"""Recordings: log or capture; captures decoded by a vehicle into samples and logs."""

from __future__ import annotations

import gzip
from copy import copy
from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.readers import PAUSE_S
from cangauge.bus.recording import capture_samples, capture_to_log, open_recording, read_log
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.logs.canonical import write_log
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.log import Log
from cangauge.logs.read import LogFile
from cangauge.model.published import leaf_2012_model_file
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.offline import estimate_capture
from cangauge.settings import REPLAY_CLOCK_ID
from cangauge.types import Sample

CURRENT_ID, VOLTAGE_ID, TEMPERATURE_ID = 0x400, 0x401, 0x402


@pytest.fixture(scope="module")
def generic() -> Vehicle:
    return Vehicle.load("generic")


def drive(vehicle: Vehicle, seconds: float = 20.0, start_s: float = 1000.0) -> list[can.Message]:
    """A drive at 10 Hz with steps of current, as frames."""
    encoder, frames = FrameEncoder(vehicle), []
    for n in range(round(10 * seconds)):
        current_a = 40.0 * (n // 20 % 2)
        sample = Sample(start_s + n / 10.0, current_a, 380.0 - 0.1 * current_a, 20.0 + n / 1000.0)
        for frame in encoder.encode(sample, 80.0 - n / 100.0):
            frame.channel = "can0"
            frames.append(frame)
    return frames


def record(path: Path, frames: list[can.Message]) -> Path:
    with can.CanutilsLogWriter(path) as writer:
        for frame in frames:
            writer.on_message_received(frame)
    return path


def test_content_decides_between_log_and_capture(tmp_path: Path, generic: Vehicle) -> None:
    capture = record(tmp_path / "drive.log", drive(generic)).rename(tmp_path / "drive.csv")
    write_log(capture_to_log(capture, generic), tmp_path / "drive.parquet")
    log = (tmp_path / "drive.parquet").rename(tmp_path / "drive.blf")
    assert isinstance(open_recording(log), LogFile)
    assert not isinstance(open_recording(capture), LogFile)
    by_capture, by_log = read_log(capture, generic), read_log(log)
    for channel in ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct"):
        np.testing.assert_array_equal(getattr(by_capture, channel), getattr(by_log, channel))


def test_columns_of_a_map_are_not_those_of_a_canonical_log(tmp_path: Path) -> None:
    mapped = ColumnMap.of("current=I,voltage=U")
    write_log(Log([0, 1], [10, 30], [380, 378], [21, 21]), tmp_path / "log.csv")
    (tmp_path / "table.csv").write_text("Time,Current,I,U,Temp\n0,1,10,380,21\n1,3,30,378,21\n")
    for name in ("log.csv", "table.csv"):
        found = open_recording(tmp_path / name, mapped=mapped)
        assert isinstance(found, LogFile)
        assert found.read().current_a.tolist() == [10.0, 30.0]


def test_a_log_needs_no_vehicle(tmp_path: Path, generic: Vehicle) -> None:
    write_log(Log([0, 1], [10, 30], [380, 378], [21, 21]), tmp_path / "drive.csv")
    log = read_log(tmp_path / "drive.csv", generic)
    assert log.remarks == ("a log, not a capture: no vehicle is needed",)
    notes = tmp_path / "notes.txt"
    notes.write_text("hello\nworld\n")
    with pytest.raises(InputError, match=r"first line: not a known kind of log, nor") as caught:
        read_log(notes)
    assert caught.value.value == "hello"
    assert "candump" in str(caught.value.cure)


@pytest.mark.parametrize("kind", ["log", "capture"])
def test_temperature_and_its_source_can_be_given(
    tmp_path: Path, generic: Vehicle, kind: str
) -> None:
    path = record(tmp_path / "drive.log", drive(generic))
    if kind == "log":
        path = tmp_path / "drive.csv"
        write_log(Log([0, 1], [10, 30], [380, 378], [21, 21], temperature_source="pack"), path)
    log = read_log(path, generic, temperature_c=7.0, temperature_source="room")
    assert set(log.temperature_c) == {7.0}
    assert log.temperature_source == "room"
    assert read_log(path, generic, temperature_c=7.0).temperature_source == "unknown"
    for value_c in (500.0, float("nan")):
        with pytest.raises(
            InputError, match=r"^--temperature: must lie within -60 … 120 °C"
        ) as caught:
            read_log(path, generic, temperature_c=value_c)
        assert caught.value.source is None
    with pytest.raises(InputError, match="not a known temperature source"):
        read_log(path, generic, temperature_source="oven")  # type: ignore[arg-type]


def test_a_packed_capture_that_is_cut_off_is_read(tmp_path: Path, generic: Vehicle) -> None:
    whole = record(tmp_path / "drive.log", drive(generic)).read_bytes()
    path = tmp_path / "drive.log.gz"
    path.write_bytes(gzip.compress(whole)[:-200])
    log = read_log(path, generic)
    assert 100 < len(log) < 200
    assert any("cut off" in remark for remark in log.remarks)


def test_a_recorded_drive_becomes_a_log(tmp_path: Path, generic: Vehicle) -> None:
    log = capture_to_log(record(tmp_path / "drive.log", drive(generic)), generic)
    assert len(log) == 200
    assert log.time_s[0] == 1000.0  # bus time as recorded
    assert log.duration_s == pytest.approx(19.9)
    assert set(log.current_a) == {0.0, 40.0}
    assert set(log.voltage_v) == {380.0, 376.0}
    assert log.temperature_c == pytest.approx(20.0 + np.arange(200) / 1000.0, abs=0.005001)
    assert log.soc_pct == pytest.approx(80.0 - np.arange(200) / 100.0, abs=0.002501)
    assert log.name == "drive"
    assert log.remarks == ()


def replayed(vehicle: Vehicle, at_s: float) -> list[can.Message]:
    """Return a drive as replayed ten times faster, with its log's time, from a stamp on [s]."""
    frames = []
    for frame in drive(vehicle, start_s=-10.0):
        tick = clock_frame(round(frame.timestamp * 1e6))
        frame.timestamp = at_s + frame.timestamp / 10.0
        tick.timestamp, tick.channel = frame.timestamp, "can0"
        frames += [tick, frame]
    return frames


def test_the_replay_clock_gives_the_logs_own_time(tmp_path: Path, generic: Vehicle) -> None:
    path = record(tmp_path / "replay.log", replayed(generic, 5000.0))
    log = capture_to_log(path, generic)
    assert log.time_s.tolist() == [round(-10e6 + n * 1e5) / 1e6 for n in range(200)]
    assert log.remarks == ("a recorded replay: time is its log's (REPLAY_CLOCK)",)


def test_consecutive_replays_in_a_capture_are_said(tmp_path: Path, generic: Vehicle) -> None:
    frames = [*replayed(generic, 5000.0), *replayed(generic, 6000.0)]
    log = capture_to_log(record(tmp_path / "replays.log", frames), generic)
    assert "2 logs were replayed: cut it into one each" in log.remarks
    assert "200 samples dropped whose time does not advance" in log.remarks


def test_a_cars_own_message_may_have_the_replay_clocks_id(tmp_path: Path, generic: Vehicle) -> None:
    frames = []
    for number, frame in enumerate(drive(generic)):
        data = bytes([number % 256, 0, 0, 0, 0, 0, 0, 1])
        own = can.Message(
            timestamp=frame.timestamp, arbitration_id=REPLAY_CLOCK_ID, is_extended_id=False,
            data=data, channel="can0",
        )  # fmt: skip
        frames += [own, frame]
    path = record(tmp_path / "car.log", frames)
    assert len(capture_to_log(path, generic)) == 200
    assert len(estimate_capture(path, generic, leaf_2012_model_file()).table.soc_pct) == 200


def test_missing_voltage_is_interpolated_or_dropped(tmp_path: Path, generic: Vehicle) -> None:
    def kept(frame: can.Message) -> bool:
        time_s = frame.timestamp - 1000.0
        missing = time_s < 0.25 or 2.05 < time_s < 2.45 or 10.05 < time_s < 14.05 or time_s > 19.85
        return not (frame.arbitration_id == VOLTAGE_ID and missing)

    path = record(tmp_path / "x.log", [frame for frame in drive(generic) if kept(frame)])
    samples = capture_samples(path, generic)
    assert len(samples) == 200  # charge is complete
    log = capture_to_log(path, generic)
    assert len(log) == 200 - 3 - 40 - 1
    assert "4 samples without voltage: interpolated" in log.remarks
    assert "44 samples without voltage dropped" in log.remarks
    assert set(log.voltage_v[(log.time_s > 1002.05) & (log.time_s < 1002.45)]) == {376.0}
    assert log.voltage_v[0] == 380.0
    assert log.time_s[0] == pytest.approx(1000.3)


def test_temperature_before_the_first_is_the_first(tmp_path: Path, generic: Vehicle) -> None:
    frames = [f for f in drive(generic) if f.arbitration_id != TEMPERATURE_ID or f.timestamp > 1005]
    log = capture_to_log(record(tmp_path / "x.log", frames), generic)
    assert log.temperature_c[0] == pytest.approx(20.05, abs=0.011)
    assert any("without temperature: the nearest is used" in remark for remark in log.remarks)
    frames = [frame for frame in frames if frame.arbitration_id != TEMPERATURE_ID]
    path = record(tmp_path / "y.log", frames)
    with pytest.raises(InputError, match="no temperature") as caught:
        capture_to_log(path, generic)
    assert "--temperature" in str(caught.value.cure)
    log = capture_to_log(path, Vehicle.load("generic", temperature_c=7.0))
    assert set(log.temperature_c) == {7.0}


def test_losses_refusals_and_late_stamps_are_remarks(tmp_path: Path, generic: Vehicle) -> None:
    frames = drive(generic)
    currents = [frame for frame in frames if frame.arbitration_id == CURRENT_ID]
    currents[50].data[0] ^= 1
    frames = [frame for frame in frames if frame is not currents[100]]
    log = capture_to_log(record(tmp_path / "x.log", frames), generic)
    assert "1 frames refused: wrong CRC" in log.remarks
    assert "1 counter jumps: at least 1 frames lost" in log.remarks
    assert len(log) == 198
    frames = drive(generic)
    for frame in frames:
        if 1010.0 <= frame.timestamp < 1010.45:
            frame.timestamp -= 0.5  # five samples arrive late
    log = capture_to_log(record(tmp_path / "x.log", frames), generic)
    assert "5 samples dropped whose time does not advance" in log.remarks
    assert len(log) == 195
    for frame in frames:
        frame.timestamp = 5.0
    with pytest.raises(InputError, match="does not advance"):
        capture_to_log(record(tmp_path / "x.log", frames), generic)


def test_sessions_pasted_together_are_said_and_kept_apart(tmp_path: Path, generic: Vehicle) -> None:
    (tmp_path / "x.log").write_bytes(b"".join(dated(generic, start) for start in (5000, 1000)))
    log = capture_to_log(tmp_path / "x.log", generic)
    assert "the stamps start again: 2 sessions in one file" in log.remarks
    assert len(log) == 400
    assert np.diff(log.time_s).max() == pytest.approx(PAUSE_S, abs=0.2)
    estimated = estimate_capture(tmp_path / "x.log", generic, leaf_2012_model_file())
    assert any(
        "2 sessions in one file, estimated as one" in each for each in estimated.recorded.remarks
    )


def dated(vehicle: Vehicle, start_s: float) -> bytes:
    """Return a candump log of a drive; python-can writes no stamp that steps back."""
    lines = (
        f"({frame.timestamp:.6f}) can0 {frame.arbitration_id:03X}#{bytes(frame.data).hex()}\n"
        for frame in drive(vehicle, start_s=1.7e9 + start_s)
    )
    return "".join(lines).encode()


def test_of_several_buses_the_one_with_most_samples_is_taken(
    tmp_path: Path, generic: Vehicle
) -> None:
    frames = drive(generic)
    twice = []
    for n, frame in enumerate(frames):
        twice.append(frame)
        if n < 100:  # a gateway repeats some of them on the other bus
            other = copy(frame)
            other.timestamp, other.channel = frame.timestamp + 0.001, "can1"
            twice.append(other)
    log = capture_to_log(record(tmp_path / "x.log", twice), generic)
    assert len(log) == 200
    assert any("bus can0 is used" in remark for remark in log.remarks)
    assert not any("refused" in remark for remark in log.remarks)


def test_a_wrong_sign_or_scale_in_the_map_is_seen_in_the_data(
    tmp_path: Path, generic: Vehicle
) -> None:
    path = record(tmp_path / "x.log", drive(generic, seconds=600))
    text = 'current.signal = "current_a"\nvoltage.signal = "voltage_v"\ntemperature.fixed_c = 20\n'
    (tmp_path / "turned.toml").write_text(text + "current.sign = -1\n")
    turned = Vehicle.load(dbc=generic.dbc_files[0], map=tmp_path / "turned.toml")
    assert any("current looks inverted" in each for each in capture_to_log(path, turned).remarks)
    (tmp_path / "milli.toml").write_text(text + "voltage.scale = 1000\n")
    vehicle = Vehicle.load(dbc=generic.dbc_files[0], map=tmp_path / "milli.toml")
    with pytest.raises(InputError, match="millivolts") as caught:
        capture_to_log(path, vehicle)
    assert caught.value.field == "voltage_v"
