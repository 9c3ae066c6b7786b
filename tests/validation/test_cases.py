"""Drawn cases: repeatable, scaled to a gap; faults in recorded logs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.extras.validation.cases import (
    CaseOptions,
    Scenario,
    draw_case,
    draw_recorded_case,
    draw_scenario,
)
from cangauge.extras.validation.twin.faults import Fault
from cangauge.extras.validation.twin.injection import (
    fit_surrogate_pack,
    inject,
    scale_injection,
    scaled_to_pack,
    soc_of,
    with_initial_soc,
)
from cangauge.extras.validation.twin.pack import Pack
from cangauge.extras.validation.twin.recording import rms
from cangauge.logs.log import Log
from cangauge.logs.read import read_log

OPTIONS = CaseOptions(kind="leaf24", hours=0.5, climate="mild")


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return OPTIONS.draw_scenario(21)


def test_seed_determines_the_case(scenario: Scenario) -> None:
    first, again, other = (
        draw_case(seed, ("hysteresis",), scenario, OPTIONS) for seed in (7, 7, 8)
    )
    assert json.dumps(first.truth) == json.dumps(again.truth) != json.dumps(other.truth)
    assert np.array_equal(first.logs[0].voltage_v, again.logs[0].voltage_v)
    assert first.logs[0].voltage_v[0] != other.logs[0].voltage_v[0]


def test_log_has_one_soc_value(scenario: Scenario) -> None:
    drawn = draw_case(5, ("hysteresis",), scenario, OPTIONS)
    healthy = [recording.log for recording in (*scenario.training, *scenario.references)]
    for log in (*healthy, *drawn.logs):
        assert log.soc_pct is not None
        assert np.isfinite(log.soc_pct).sum() == 1


def test_truth_describes_fault_and_gap(scenario: Scenario) -> None:
    drawn = draw_case(5, ("hysteresis",), scenario, replace(OPTIONS, n_logs=2, floor_v=0.2))
    truth = drawn.truth
    assert truth["effects"] == ["hysteresis"]
    assert len(drawn.logs) == len(truth["logs"]) == 2
    target_v = truth["faults"][0]["gap_wanted_v"]
    assert 0.1 <= target_v <= 1.0
    assert truth["gap_v"] == pytest.approx(target_v, rel=0.05)
    for about, recording in zip(truth["logs"], drawn.recordings, strict=True):
        error = recording.log.voltage_v - recording.expected_voltage_v
        assert rms(error) == pytest.approx(
            np.hypot(about["gap_v"], rms(error - recording.gap_v)), rel=0.15
        )


def test_healthy_case_has_no_gap(scenario: Scenario) -> None:
    drawn = draw_case(3, (), scenario, OPTIONS)
    assert drawn.gap_v == 0.0
    assert drawn.faults == ()
    assert np.array_equal(drawn.logs[0].voltage_v, drawn.healthy_logs[0].voltage_v)


def test_two_effects_are_each_scaled(scenario: Scenario) -> None:
    drawn = draw_case(4, ("current_offset", "resistance_step"), scenario, OPTIONS)
    assert [item.fault.id for item in drawn.faults] == ["current_offset", "resistance_step"]
    alone = [item.reached_v for item in drawn.faults]
    assert drawn.gap_v == pytest.approx(np.hypot(*alone), rel=0.4)
    assert all(item.reached_v == pytest.approx(item.target_v, rel=0.06) for item in drawn.faults)


def test_drives_stay_in_the_ambient_range_of_references() -> None:
    wide = draw_scenario(2, kind="module12", n_reference=3)
    known = [drive.ambient_c[0] for drive in wide.reference_drives]
    assert max(known) - min(known) > 15.0
    drives = wide.draw_drives(np.random.default_rng(1), 20, hours=0.1)
    ambient = [drive.ambient_c[0] for drive in drives]
    assert min(known) - 2.5 <= min(ambient)
    assert max(ambient) <= max(known) + 2.5


def test_training_runs_from_full_to_empty(scenario: Scenario) -> None:
    recording = scenario.training[0]
    assert recording.true_soc_pct[0] == pytest.approx(100.0)
    assert recording.true_soc_pct[-1] < 5.0


def test_invalid_arguments_are_refused(scenario: Scenario) -> None:
    with pytest.raises(InputError, match="training"):
        draw_scenario(1, n_training=0)
    with pytest.raises(InputError, match="effect"):
        draw_case(1, ("gremlins",), scenario, OPTIONS)


@pytest.fixture(scope="module")
def trips(shared_data: Path) -> list[Log]:
    return [read_log(shared_data / "bmw_i3" / f"TripA{n:02d}.csv.gz") for n in (2, 4, 8, 10, 12)]


@pytest.fixture(scope="module")
def i3_pack(trips: list[Log]) -> Pack:
    return fit_surrogate_pack(trips, capacity_ah=61.75, cells=96)


@pytest.mark.real
def test_surrogate_has_voltage_and_resistance(trips: list[Log], i3_pack: Pack) -> None:
    assert 0.08 < i3_pack.resistance_ohm < 0.16
    for log in trips:
        # Moments without current are within the drive: the voltage has not relaxed.
        rest = np.abs(log.current_a) < 1.0
        soc = soc_of(log, 61.75)[rest]
        missing = np.median(log.voltage_v[rest] - 96.0 * i3_pack.chemistry.ocv(soc))
        assert -0.015 * 360.0 < missing < 0.004 * 360.0


@pytest.mark.real
def test_sensor_fault_changes_only_its_signal(trips: list[Log], i3_pack: Pack) -> None:
    offset = inject(trips[0], (Fault("voltage_offset", 1.5),), i3_pack)
    np.testing.assert_allclose(offset.log.voltage_v - trips[0].voltage_v, 1.5, atol=1e-6)
    assert np.array_equal(offset.log.current_a, trips[0].current_a)
    current = inject(trips[0], (Fault("current_offset", 3.0),), i3_pack)
    np.testing.assert_allclose(current.log.current_a - trips[0].current_a, 3.0, atol=1e-6)
    assert np.array_equal(current.log.voltage_v, trips[0].voltage_v)
    assert np.mean(np.abs(current.gap_v)) > 0.3


@pytest.mark.real
@pytest.mark.parametrize(
    "fault_id",
    ["capacity", "resistance_step", "charge_transfer", "fast_polarization", "slow_diffusion",
     "hysteresis", "resistance_asymmetry", "time_skew", "string_dropout", "contact_flicker"],
)  # fmt: skip
def test_injection_is_scaled_to_the_gap(fault_id: str, trips: list[Log], i3_pack: Pack) -> None:
    scaled = scale_injection(trips[:3], Fault(fault_id, 1.0, seed=1), 0.8, i3_pack)
    assert scaled.reached_v == pytest.approx(0.8, rel=0.06)
    injected = [inject(log, (scaled.fault,), i3_pack) for log in trips[:3]]
    gap = np.concatenate([item.gap_v for item in injected])
    assert rms(gap) == pytest.approx(0.8, rel=0.06)
    # The resolution of the recorded voltage is kept.
    assert i3_pack.sensors.voltage_step_v >= 0.01
    hundredths = injected[0].log.voltage_v / 0.01
    np.testing.assert_allclose(hundredths, np.rint(hundredths), atol=1e-4)


@pytest.mark.real
def test_recorded_case_has_its_fault(trips: list[Log], i3_pack: Pack) -> None:
    held_out = trips[2:]
    drawn = draw_recorded_case(3, ("slow_diffusion",), held_out, i3_pack, floor_v=0.36, n_logs=2)
    assert drawn.truth["effects"] == ["slow_diffusion"]
    assert drawn.gap_v == pytest.approx(drawn.truth["faults"][0]["gap_wanted_v"], rel=0.1)
    assert len(drawn.logs) == 2
    healthy = draw_recorded_case(3, (), held_out, i3_pack, floor_v=0.36, n_logs=1)
    assert healthy.gap_v == 0.0
    assert any(np.array_equal(healthy.logs[0].voltage_v, log.voltage_v) for log in held_out)


@pytest.mark.real
def test_cell_log_scales_to_a_pack(shared_data: Path) -> None:
    cell = with_initial_soc(read_log(shared_data / "lg_hg2" / "25degC__551_US06.parquet"), 100.0)
    log = scaled_to_pack(cell, series=96, parallel=17)
    np.testing.assert_allclose(log.voltage_v, 96 * cell.voltage_v)
    pack = fit_surrogate_pack([log], capacity_ah=2.75 * 17, cells=96)
    assert pack.resistance_ohm / 96 * 17 == pytest.approx(0.035, abs=0.015)
    with pytest.raises(InputError):
        scaled_to_pack(cell, series=0, parallel=1)
    with pytest.raises(InputError, match="SoC"):
        fit_surrogate_pack([replace(cell, soc_pct=None)], capacity_ah=3.0, cells=1)
