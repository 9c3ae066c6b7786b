"""Cases of the withheld check: repeatable, nameless, sealed; recorded logs with faults."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.validation.twin.case import CaseOptions, draw_case, make_case
from cangauge.validation.twin.faults import Fault, fault_kinds
from cangauge.validation.twin.recorded import (
    RecordedSet,
    charge_of,
    inject,
    make_real_case,
    scale_injection,
    scaled_to_pack,
    survey_pack,
    with_start,
)
from cangauge.validation.twin.world import World, draw_world, rms

OPTIONS = CaseOptions(kind="leaf24", hours=0.5, climate="mild")
IDS = [kind.id for kind in (*fault_kinds(), *fault_kinds(outside=True))]


@pytest.fixture(scope="module")
def world() -> World:
    return OPTIONS.draw_world(21)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_same_seed_writes_the_same_bytes(tmp_path: Path, world: World) -> None:
    first = make_case(7, "any", tmp_path / "a", tmp_path / "s", options=OPTIONS, world=world)
    again = make_case(7, "any", tmp_path / "b", tmp_path / "t", options=OPTIONS, world=world)
    other = make_case(8, "any", tmp_path / "c", tmp_path / "u", options=OPTIONS, world=world)
    assert first.truth_sha256 == again.truth_sha256 != other.truth_sha256
    assert digest(first.logs[0]) == digest(again.logs[0]) != digest(other.logs[0])


def test_the_folder_that_is_diagnosed_does_not_tell_the_cause(tmp_path: Path, world: World) -> None:
    case = make_case(5, "hysteresis", tmp_path / "open", tmp_path / "sealed", world=world,
                     options=OPTIONS)  # fmt: skip
    shown = sorted((tmp_path / "open").rglob("*"))
    files = [path for path in shown if path.is_file()]
    assert {path.name for path in files} == {
        "case.json", "training_1.parquet", "reference_1.parquet", "reference_2.parquet",
        "reference_3.parquet", "log_1.parquet",
    }  # fmt: skip
    for path in files:
        content = path.read_bytes().replace(b"capacity_ah", b"")
        assert not any(name.encode() in content for name in IDS), path
    for path in (*case.training, *case.references, *case.logs):
        assert set(pq.read_table(path).column_names) == {
            "time_s", "current_a", "voltage_v", "temperature_c", "soc_pct",
        }  # fmt: skip
        soc = read_log(path).soc_pct
        assert soc is not None
        assert np.isfinite(soc).sum() == 1


def test_the_sealed_file_tells_it(tmp_path: Path, world: World) -> None:
    case = make_case(5, "hysteresis", tmp_path / "open", tmp_path / "sealed", world=world,
                     options=replace(OPTIONS, n_logs=2, floor_v=0.2))  # fmt: skip
    assert digest(case.truth) == case.truth_sha256
    truth = json.loads(case.truth.read_text())
    assert truth["effects"] == ["hysteresis"]
    assert len(case.logs) == len(truth["logs"]) == 2
    wanted = truth["faults"][0]["gap_wanted_v"]
    assert 0.1 <= wanted <= 1.0
    assert truth["gap_v"] == pytest.approx(wanted, rel=0.05)
    for about, path in zip(truth["logs"], case.logs, strict=True):
        sealed = case.truth.parent / about["file"]
        assert digest(sealed) == about["sha256"]
        table, log = pq.read_table(sealed), read_log(path)
        error = log.voltage_v - table["expected_voltage_v"].to_numpy()
        assert rms(error) == pytest.approx(
            np.hypot(about["gap_v"], rms(error - table["gap_v"].to_numpy())), rel=0.15
        )


def test_a_healthy_case_has_no_gap(world: World) -> None:
    drawn = draw_case(3, None, options=OPTIONS, world=world)
    assert drawn.gap_v == 0.0
    assert drawn.scaled == ()


def test_two_effects_are_each_scaled(world: World) -> None:
    drawn = draw_case(4, ("current_offset", "resistance_step"), options=OPTIONS, world=world)
    assert [item.fault.id for item in drawn.scaled] == ["current_offset", "resistance_step"]
    alone = [item.reached_v for item in drawn.scaled]
    assert drawn.gap_v == pytest.approx(np.hypot(*alone), rel=0.4)
    assert all(item.reached_v == pytest.approx(item.wanted_v, rel=0.06) for item in drawn.scaled)


def test_one_outside_is_outside(world: World) -> None:
    drawn = draw_case(9, "outside", options=OPTIONS, world=world)
    assert drawn.scaled[0].fault.kind.family == "outside"


def test_diagnosed_days_lie_within_the_temperatures_of_the_references() -> None:
    wide = draw_world(2, kind="module12", n_reference=3)
    known = [day.ambient_c[0] for day in wide.reference_days]
    assert max(known) - min(known) > 15.0
    days = wide.draw_days(np.random.default_rng(1), 20, hours=0.1)
    ambient = [day.ambient_c[0] for day in days]
    assert min(known) - 2.5 <= min(ambient)
    assert max(ambient) <= max(known) + 2.5


def test_the_training_day_runs_from_full_to_empty(world: World) -> None:
    recording = world.training[0]
    assert recording.true_soc_pct[0] == pytest.approx(100.0)
    assert recording.true_soc_pct[-1] < 5.0


def test_nonsense_is_refused() -> None:
    with pytest.raises(InputError, match="training"):
        draw_world(1, n_training=0)
    with pytest.raises(InputError, match="effect"):
        draw_case(1, "gremlins", options=replace(OPTIONS, hours=0.1))


@pytest.fixture(scope="module")
def trips(shared_data: Path) -> list[Log]:
    return [read_log(shared_data / "bmw_i3" / f"TripA{n:02d}.csv.gz") for n in (2, 4, 8, 10, 12)]


@pytest.mark.real
def test_a_survey_finds_voltage_and_resistance_of_a_real_pack(trips: list[Log]) -> None:
    pack = survey_pack(trips, capacity_ah=61.75, cells=96)
    assert 0.08 < pack.resistance_ohm < 0.16
    for log in trips:
        # Moments without current are within the drive, so what has not relaxed yet is missing.
        rest = np.abs(log.current_a) < 1.0
        soc = charge_of(log, 61.75)[rest]
        missing = np.median(log.voltage_v[rest] - 96.0 * pack.chemistry.ocv(soc))
        assert -0.015 * 360.0 < missing < 0.004 * 360.0


@pytest.mark.real
def test_sensor_faults_change_their_signal_alone(trips: list[Log]) -> None:
    pack = survey_pack(trips, capacity_ah=61.75, cells=96)
    offset = inject(trips[0], (Fault("voltage_offset", 1.5),), pack)
    np.testing.assert_allclose(offset.log.voltage_v - trips[0].voltage_v, 1.5, atol=1e-6)
    assert np.array_equal(offset.log.current_a, trips[0].current_a)
    current = inject(trips[0], (Fault("current_offset", 3.0),), pack)
    np.testing.assert_allclose(current.log.current_a - trips[0].current_a, 3.0, atol=1e-6)
    assert np.array_equal(current.log.voltage_v, trips[0].voltage_v)
    assert np.mean(np.abs(current.gap_v)) > 0.3


@pytest.mark.real
@pytest.mark.parametrize(
    "fault_id",
    ["capacity", "resistance_step", "charge_transfer", "fast_polarization", "slow_diffusion",
     "hysteresis", "resistance_asymmetry", "time_skew", "string_dropout", "contact_flicker"],
)  # fmt: skip
def test_the_gap_in_recorded_logs_is_the_one_asked_for(fault_id: str, trips: list[Log]) -> None:
    pack = survey_pack(trips, capacity_ah=61.75, cells=96)
    scaled = scale_injection(trips[:3], Fault(fault_id, 1.0, seed=1), 0.8, pack)
    assert scaled.reached_v == pytest.approx(0.8, rel=0.06)
    injected = [inject(log, (scaled.fault,), pack) for log in trips[:3]]
    gap = np.concatenate([item.gap_v for item in injected])
    assert rms(gap) == pytest.approx(0.8, rel=0.06)
    # What was recorded in hundredths stays in hundredths.
    assert pack.sensors.voltage_step_v >= 0.01
    hundredths = injected[0].log.voltage_v / 0.01
    np.testing.assert_allclose(hundredths, np.rint(hundredths), atol=1e-4)


@pytest.mark.real
def test_a_real_case_is_sealed_as_a_simulated_one(tmp_path: Path, trips: list[Log]) -> None:
    recorded = RecordedSet("bmw_i3", trips[:1], trips[1:2], trips[2:], 61.75, 96)
    case = make_real_case(
        3, "slow_diffusion", recorded, tmp_path / "open", tmp_path / "sealed", floor_v=0.36,
        n_logs=2,
    )  # fmt: skip
    truth = json.loads(case.truth.read_text())
    assert truth["effects"] == ["slow_diffusion"]
    assert truth["gap_v"] == pytest.approx(truth["faults"][0]["gap_wanted_v"], rel=0.1)
    assert len(case.logs) == 2
    null = make_real_case(
        3, None, recorded, tmp_path / "open", tmp_path / "sealed", floor_v=0.36, n_logs=1,
        name="null",
    )  # fmt: skip
    assert json.loads(null.truth.read_text())["gap_v"] == 0.0
    found = read_log(null.logs[0])
    assert any(np.array_equal(found.voltage_v, log.voltage_v) for log in recorded.held_out)


@pytest.mark.real
def test_a_cell_becomes_a_pack(shared_data: Path) -> None:
    cell = with_start(read_log(shared_data / "lg_hg2" / "25degC__551_US06.parquet"), 100.0)
    log = scaled_to_pack(cell, series=96, parallel=17)
    np.testing.assert_allclose(log.voltage_v, 96 * cell.voltage_v)
    pack = survey_pack([log], capacity_ah=2.75 * 17, cells=96)
    assert pack.resistance_ohm / 96 * 17 == pytest.approx(0.035, abs=0.015)
    with pytest.raises(InputError):
        scaled_to_pack(cell, series=0, parallel=1)
    with pytest.raises(InputError, match="SoC"):
        survey_pack([replace(cell, soc_pct=None)], capacity_ah=3.0, cells=1)
