"""Sensors: quantization, jitter, lost samples, rates, assumed initial SoC."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.faults import Fault
from cangauge.extras.validation.twin.pack import TwinPack, draw_pack
from cangauge.extras.validation.twin.recording import record_drive, rms


def with_sensors(pack: TwinPack, **changes: float) -> TwinPack:
    return replace(pack, sensors=replace(pack.sensors, **changes))


def test_values_are_quantized(pack: TwinPack, drive: Drive) -> None:
    coarse = with_sensors(pack, current_step_a=0.5, voltage_step_v=0.25, temperature_step_k=1.0)
    log = record_drive(coarse, drive).log
    for values, step in ((log.current_a, 0.5), (log.voltage_v, 0.25), (log.temperature_c, 1.0)):
        np.testing.assert_allclose(values / step, np.rint(values / step), atol=1e-6)


def test_log_has_the_assumed_initial_soc_only(pack: TwinPack, drive: Drive) -> None:
    log = record_drive(pack, drive).log
    assert log.soc_pct is not None
    assert log.soc_pct[0] == pytest.approx(90.0, abs=0.6)
    assert np.all(np.isnan(log.soc_pct[1:]))


@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 5.0, 10.0])
def test_samples_have_jitter_and_losses(rate_hz: float) -> None:
    rng = np.random.default_rng(4)
    pack = with_sensors(draw_pack(rng, "leaf40"), rate_hz=rate_hz, jitter=0.05, drop_share=0.01)
    drive = draw_drive(rng, pack, hours=0.4)
    log = record_drive(pack, drive).log
    intervals = np.diff(log.time_s)
    assert np.median(intervals) == pytest.approx(1.0 / rate_hz, rel=0.02)
    assert 0.02 < np.std(intervals[intervals < 1.5 / rate_hz]) * rate_hz < 0.1
    expected = log.duration_s * rate_hz
    assert 0.97 * expected < len(log) < 0.9985 * expected


def test_a_healthy_log_differs_by_the_sensors_alone(pack: TwinPack, drive: Drive) -> None:
    recording, sensors = record_drive(pack, drive), pack.sensors
    assert np.all(recording.gap_v == 0.0)
    error_v = recording.log.voltage_v - recording.expected_voltage_v
    wanted_v = np.hypot(sensors.voltage_noise_v, sensors.voltage_step_v / np.sqrt(12.0))
    assert rms(error_v) == pytest.approx(wanted_v, rel=0.05)


def test_log_ends_when_the_lowest_cell_is_empty(pack: TwinPack, drive: Drive) -> None:
    whole = record_drive(pack, drive).log
    short = record_drive(pack, drive, (Fault("capacity", 0.4),)).log
    assert short.duration_s < 0.9 * whole.duration_s
    assert short.voltage_v.min() / pack.cells > 2.0
