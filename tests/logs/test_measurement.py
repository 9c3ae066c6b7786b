"""MF4 with signals on several rasters, and MCAP with samples or messages of other tools."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from random import Random

import can
import numpy as np
import pytest

from cangauge._mcap import ESTIMATE, SAMPLE, SCHEMAS, McapTopics
from cangauge.bus.captures.capture import Capture
from cangauge.bus.captures.mcap import McapWriter
from cangauge.bus.recording import open_recording, read_recording
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.logs.read import read_log

SECONDS = 60.0


def current_a(time_s: np.ndarray) -> np.ndarray:
    return np.where(time_s % 10.0 < 5.0, 40.0, -10.0)


def voltage_v(time_s: np.ndarray) -> np.ndarray:
    return 380.0 - 0.1 * current_a(time_s)


def raster(step_s: float) -> np.ndarray:
    return np.arange(0.0, SECONDS + step_s / 2, step_s)


# --- MF4


@pytest.fixture(scope="module")
def mf4(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As a calibration tool writes it: rasters of 10 ms, 100 ms and 1 s, and a word."""
    asammdf = pytest.importorskip("asammdf")
    fast, middle, slow = raster(0.01), raster(0.1), raster(1.0)
    signal = asammdf.Signal
    with asammdf.MDF(version="4.10") as file:
        file.append(
            [
                signal(current_a(fast), fast, unit="A", name="BMS_PackCurrent"),
                signal(np.arange(fast.size) % 16, fast, name="BMS_AliveCounter"),
            ],
            acq_name="10ms",
        )
        file.append(
            [
                signal(voltage_v(middle), middle, unit="V", name="BMS_PackVoltage"),
                signal(middle * 0.0 + 12.6, middle, unit="V", name="LowVoltage_12V"),
            ],
            acq_name="100ms",
        )
        file.append(
            [
                signal(np.full(slow.size, 22.5), slow, unit="°C", name="BMS_PackTemp"),
                signal(80.0 - slow / 60.0, slow, unit="%", name="BMS_Soc"),
                signal(np.array([b"drive"] * slow.size), slow, name="BMS_State", encoding="utf-8"),
            ],
            acq_name="1s",
        )
        path = tmp_path_factory.mktemp("mf4") / "measurement.mf4"
        file.save(path, overwrite=True)
    return path


def test_signals_of_several_rasters_become_a_log(mf4: Path) -> None:
    log = read_log(mf4)
    assert np.array_equal(log.time_s, raster(0.01))
    assert np.array_equal(log.current_a, current_a(log.time_s))
    at_raster = np.isclose(log.time_s * 10.0, np.round(log.time_s * 10.0))
    np.testing.assert_allclose(log.voltage_v[at_raster], voltage_v(raster(0.1)))
    assert np.all(log.temperature_c == 22.5)
    assert log.soc_pct is not None
    assert (log.soc_pct[0], log.soc_pct[150]) == (80.0, 80.0 - 1.0 / 60.0)
    assert log.remarks[0] == "MF4 with 7 channels"
    assert 'voltage = "BMS_PackVoltage [V]" [V]' in log.assumed
    assert "BMS_PackVoltage [V]: interpolated between its 601 values" in log.remarks


def test_channels_can_be_chosen_by_name(mf4: Path, tmp_path: Path) -> None:
    packed = tmp_path / "measurement.mf4.gz"
    packed.write_bytes(gzip.compress(mf4.read_bytes()))
    log = read_log(packed, columns="voltage=LowVoltage_12V,soc=BMS_Soc")
    assert set(log.voltage_v) == {12.6}
    with pytest.raises(InputError, match="BMS_Voltag"):
        read_log(mf4, columns="voltage=BMS_Voltag")


def test_a_missing_quantity_names_the_channels(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    times = raster(1.0)
    with asammdf.MDF() as file:
        file.append([asammdf.Signal(current_a(times), times, unit="A", name="PackCurrent")])
        file.save(tmp_path / "x.mf4")
    with pytest.raises(InputError, match=r"x\.mf4: no plain heading of voltage .*PackCurrent"):
        read_log(tmp_path / "x.mf4")


def test_damaged_mf4_is_refused_or_read(mf4: Path, tmp_path: Path) -> None:
    data = mf4.read_bytes()
    random = Random(1)  # noqa: S311 - repeatable damage
    for number in range(4):
        mutant = bytearray(data[: len(data) // 2] if number == 0 else data)
        for _ in range(20):
            mutant[random.randrange(64, 4096)] = random.randrange(256)
        path = tmp_path / "damaged.mf4"
        path.write_bytes(mutant)
        try:
            assert len(read_log(path)) > 0
        except InputError:
            continue


def test_mf4_with_frames_is_a_capture(tmp_path: Path, mf4: Path) -> None:
    path = tmp_path / "bus.mf4"
    with can.MF4Writer(path) as writer:
        writer.on_message_received(can.Message(timestamp=1.0, arbitration_id=1, data=b"a"))
    assert isinstance(open_recording(path), Capture)
    assert not isinstance(open_recording(mf4), Capture)


# --- MCAP


def write_samples(path: Path) -> None:
    with path.open("wb") as file:
        topics = McapTopics(file, path)
        for k, time_s in enumerate(raster(0.1)):
            fields = {"time_s": time_s, "current_a": float(current_a(time_s)), "soc_pct": 80.0}
            if k % 2 == 0:
                fields["voltage_v"] = float(voltage_v(time_s))
            if k % 10 == 5:
                fields["temperature_c"] = 21.0
            topics.write_numbers("/sample", SAMPLE, 1.7e9 + time_s, fields)
            topics.write_numbers("/soc_estimate", ESTIMATE, 1.7e9 + time_s, {"soc_pct": 79.0})
        topics.finish()


def test_samples_of_an_mcap_are_a_log(tmp_path: Path) -> None:
    path = tmp_path / "soc.mcap"
    write_samples(path)
    log = read_log(path)
    assert np.array_equal(log.time_s, raster(0.1))
    assert np.array_equal(log.current_a, current_a(log.time_s))
    np.testing.assert_allclose(log.voltage_v[::2], voltage_v(log.time_s)[::2])
    assert set(log.temperature_c) == {21.0}
    assert log.soc_pct is not None
    assert set(log.soc_pct) == {80.0}


def test_numbers_of_other_tools_are_channels(tmp_path: Path) -> None:
    writer_module = pytest.importorskip("mcap.writer")
    path = tmp_path / "robot.mcap"
    with path.open("wb") as file:
        writer = writer_module.Writer(file)
        writer.start()
        schema = writer.register_schema("Battery", "jsonschema", b'{"type":"object"}')
        channel = writer.register_channel("/battery", "json", schema)
        for time_s in raster(0.5):
            fields = {
                "pack": {"current_A": float(current_a(time_s)), "voltage_V": 380.0},
                "temperature_C": 20.0,
                "state": "drive",
            }
            time_ns = round(1e9 * time_s)
            writer.add_message(channel, time_ns, json.dumps(fields).encode(), time_ns)
        writer.finish()
    log = read_log(path, columns="current=/battery pack.current_A,voltage=/battery pack.voltage_V")
    assert np.array_equal(log.time_s, raster(0.5))
    assert np.array_equal(log.current_a, current_a(log.time_s))
    assert log.temperature_c[0] == 20.0


def test_mcap_with_frames_is_a_capture(tmp_path: Path) -> None:
    path = tmp_path / "bus.mcap"
    with McapWriter(path) as writer:
        for k in range(5):
            writer.on_message_received(
                can.Message(timestamp=k, arbitration_id=k, data=bytes([k]), channel="can0")
            )
    recording = open_recording(path)
    assert isinstance(recording, Capture)
    assert [message.channel for message in recording] == ["can0"] * 5
    with pytest.raises(InputError, match="this is a CAN capture"):
        read_recording(path)


def test_cut_and_damaged_mcap(tmp_path: Path) -> None:
    path = tmp_path / "soc.mcap"
    write_samples(path)
    data = path.read_bytes()
    whole = read_log(path)
    random = Random(1)  # noqa: S311 - repeatable damage
    found = 0
    for number in range(200):
        mutant = bytearray(data[: random.randrange(9, len(data))] if number % 2 else data)
        for _ in range(number % 3):
            mutant[random.randrange(8, len(mutant))] = random.randrange(256)
        (tmp_path / "x.mcap").write_bytes(mutant)
        try:
            log = read_log(tmp_path / "x.mcap")
        except InputError:
            continue
        found += 1
        assert len(log) <= len(whole)
    assert found


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_every_compression_is_read(tmp_path: Path, compression: str) -> None:
    module = pytest.importorskip("mcap.writer")
    path = tmp_path / "soc.mcap"
    with path.open("wb") as file:
        writer = module.Writer(file, compression=module.CompressionType[compression])
        writer.start()
        schema = writer.register_schema(SAMPLE, "jsonschema", b"{}")
        channel = writer.register_channel("/sample", "json", schema)
        for k in range(3000):
            row = {"time_s": k, "current_a": 1.0, "voltage_v": 380.0, "temperature_c": 20.0}
            writer.add_message(channel, k * 10**9, json.dumps(row).encode(), k * 10**9)
        writer.finish()
    assert len(read_log(path)) == 3000


def test_a_compression_bomb_is_refused(tmp_path: Path) -> None:
    zstandard = pytest.importorskip("zstandard")
    records = pytest.importorskip("mcap.records")
    builder = pytest.importorskip("mcap.data_stream").RecordBuilder()
    content = zstandard.compress(bytes(300 << 20), 19)
    records.Header(profile="", library="").write(builder)
    records.Chunk(
        compression="zstd",
        data=content,
        message_start_time=0,
        message_end_time=0,
        uncompressed_crc=0,
        uncompressed_size=300 << 20,
    ).write(builder)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + builder.end())
    with pytest.raises(InputError, match="unpacks to more than"):
        read_log(path)


def test_the_schemas_name_every_field_of_a_message(tmp_path: Path) -> None:
    path = tmp_path / "soc.mcap"
    write_samples(path)
    reader_module = pytest.importorskip("mcap.reader")
    with path.open("rb") as file:
        reader = reader_module.make_reader(file)  # needs the index: the file is complete
        topics = {}
        for schema, channel, message in reader.iter_messages():
            assert channel.message_encoding == "json"
            assert set(json.loads(message.data)) <= set(SCHEMAS[schema.name])
            assert json.loads(schema.data)["properties"] == SCHEMAS[schema.name]
            topics[channel.topic] = schema.name
    assert topics == {"/sample": SAMPLE, "/soc_estimate": ESTIMATE}


def test_estimates_written_as_mcap_are_a_log_again(tmp_path: Path) -> None:
    from cangauge.extras.formats.estimate_mcap import write_estimates_mcap  # noqa: PLC0415

    times = raster(1.0)
    log = Log(times, current_a(times), voltage_v(times), np.full(times.size, 21.0))
    numbers = {name: np.full(times.size, 50.0) for name in ESTIMATE_NUMBERS}
    flags = {name: np.zeros(times.size, np.int64) for name in ("status", "reasons")}
    from cangauge.estimation.offline import EstimateTable  # noqa: PLC0415

    table = EstimateTable(time_s=times, **numbers, **flags)
    write_estimates_mcap(tmp_path / "soc.mcap", log, table)
    again = read_log(tmp_path / "soc.mcap")
    for field in ("time_s", "current_a", "voltage_v", "temperature_c"):
        assert np.array_equal(getattr(again, field), getattr(log, field)), field


ESTIMATE_NUMBERS = (
    "soc_pct",
    "soc_std_pct",
    "soc_newton_pct",
    "soc_coulomb_pct",
    "voltage_model_v",
    "residual_v",
)
