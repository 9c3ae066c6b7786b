"""The shipped reconstruction of the 2012 Leaf test agrees with the published facts."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from cangauge._resources import shared_file
from cangauge.bus.recording import read_log
from cangauge.identify.rows import FitRows, decimate, fit_rows
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log
from cangauge.model import published
from synthetic import voltage_of

VARIANTS = ("white", "correlated")
FILES = tuple(f"leaf2012_reconstruction_{name}.parquet" for name in (*VARIANTS, "10min"))
MODEL = published.leaf_2012_model()


@cache
def shipped(variant: str) -> Log:
    return read_log(shared_file("replay", f"leaf2012_reconstruction_{variant}.parquet"))


@cache
def rows_of(variant: str) -> FitRows:
    return fit_rows(shipped(variant), published.CAPACITY_AH, low_pass_s=())


def error_of(rows: FitRows) -> np.ndarray:
    truth = voltage_of(MODEL, rows.soc_pct, rows.temperature_c, rows.current_columns_a)
    return np.asarray(rows.voltage_v - truth)


@pytest.mark.parametrize("variant", VARIANTS)
def test_rate_and_duration(variant: str) -> None:
    log = shipped(variant)
    np.testing.assert_allclose(np.diff(log.time_s), 0.1, atol=1e-9)
    assert log.duration_s == pytest.approx(2.5 * 3600.0, rel=0.05)
    assert decimate(log.time_s, 1.0).size == pytest.approx(9000, rel=0.05)


@pytest.mark.parametrize("variant", VARIANTS)
def test_charge_runs_from_full_to_empty(variant: str) -> None:
    log = shipped(variant)
    out = discharged_ah(log.time_s, log.current_a)
    assert out[-1] == pytest.approx(published.CAPACITY_AH, abs=0.005)
    assert log.soc_pct is not None
    assert log.soc_pct[0] == 100.0
    assert log.soc_pct[-1] == pytest.approx(0.0, abs=0.01)
    # The stored reference is the trapezoidal charge, to its three decimals.
    np.testing.assert_allclose(
        log.soc_pct, 100.0 * (1.0 - out / published.CAPACITY_AH), atol=0.00051
    )


@pytest.mark.parametrize("variant", VARIANTS)
def test_currents(variant: str) -> None:
    log = shipped(variant)
    first_hour = log.current_a[log.time_s < 3600.0]
    later = log.current_a[log.time_s >= 3600.0]
    # Read off the published figure: about −50 … +100 A, then peaks near +200 A.
    assert first_hour.min() == pytest.approx(-50.0, rel=0.15)
    assert first_hour.max() == pytest.approx(100.0, rel=0.15)
    assert later.max() == pytest.approx(200.0, rel=0.10)
    assert later.min() > -75.0


@pytest.mark.parametrize("variant", VARIANTS)
def test_room_temperature_spans_the_published_range(variant: str) -> None:
    log = shipped(variant)
    assert log.temperature_source == "room"
    assert log.temperature_c.min() == pytest.approx(20.0, abs=0.5)
    assert log.temperature_c.max() == pytest.approx(26.0, abs=0.5)
    assert log.temperature_c.min() >= 20.0
    assert log.temperature_c.max() <= 26.0
    # kt would not be separable from the pseudo-OCV if temperature followed SoC.
    assert abs(np.corrcoef(log.temperature_c, log.soc_pct)[0, 1]) < 0.2


@pytest.mark.parametrize("variant", VARIANTS)
def test_voltage_error_has_the_published_mae(variant: str) -> None:
    rows = rows_of(variant)
    mae_pct = 100.0 * np.mean(np.abs(error_of(rows)) / rows.voltage_v)
    assert mae_pct == pytest.approx(published.VOLTAGE_MAE_PCT, abs=0.002)


def autocorrelation(variant: str, lag_s: float) -> float:
    """Autocorrelation of the error over pairs of 1 Hz rows `lag_s` apart."""
    rows = rows_of(variant)
    error = error_of(rows)
    later = np.searchsorted(rows.time_s, rows.time_s + lag_s - 1e-6)
    found = later < len(rows)
    here, there = np.flatnonzero(found), later[found]
    apart = np.abs(rows.time_s[there] - rows.time_s[here] - lag_s) < 1e-3
    return float(np.corrcoef(error[here[apart]], error[there[apart]])[0, 1])


def test_white_error_is_white() -> None:
    # 4 standard errors of a correlation over 8,900 pairs.
    for lag_s in (1.0, 10.0, 60.0, 300.0):
        assert abs(autocorrelation("white", lag_s)) < 0.042


def test_correlated_error_lasts_minutes() -> None:
    def expected(lag_s: float) -> float:
        return float(np.mean(np.exp(-lag_s / np.array([60.0, 120.0, 300.0]))))

    assert autocorrelation("correlated", 1.0) == pytest.approx(expected(1.0), abs=0.01)
    # Three standard deviations over logs of this length (0.065 and 0.12, over 120 other seeds),
    # each with about fifty independent pieces. This seed is a low draw, 0.44 for 0.60.
    assert autocorrelation("correlated", 60.0) == pytest.approx(expected(60.0), abs=0.195)
    assert abs(autocorrelation("correlated", 1500.0)) < 0.36


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_fit_excludes_rows_with_an_open_contactor(
    variant: str,
) -> None:
    log = shipped(variant)
    down = log.voltage_v < 50.0
    stops = np.count_nonzero(np.diff(down.astype(int)) == 1)
    assert stops == 8
    assert np.all(log.current_a[down] == 0.0)
    rows = rows_of(variant)
    assert rows.removed["start_up_or_shut_down"] > 200
    # Five standard deviations of the error: no row of a shut-down or pre-charge is left.
    assert np.max(np.abs(error_of(rows))) < 5.0 * 1.17
    assert len(rows) > 8500


def test_ten_minutes_are_a_cut_of_the_white_log() -> None:
    short, whole = shipped("10min"), shipped("white")
    assert short.duration_s == pytest.approx(600.0, abs=0.2)
    assert short.time_s[0] == 0.0
    assert short.soc_pct is not None
    assert np.isfinite(short.soc_pct[0])
    assert short.current_a.max() > 180.0
    assert whole.soc_pct is not None
    first = int(np.argmin(np.abs(whole.soc_pct - short.soc_pct[0])))
    starts = [
        k
        for k in range(first - 800, first + 800)
        if np.array_equal(whole.voltage_v[k : k + len(short)], short.voltage_v)
    ]
    assert len(starts) == 1


@pytest.mark.parametrize("name", FILES)
def test_the_file_is_marked_as_reconstruction_and_small(name: str) -> None:
    path = shared_file("replay", name)
    metadata = pq.read_schema(path).metadata
    assert metadata[b"notice"].startswith(b"A RECONSTRUCTION, not the measured log")
    assert b"reconstruction" in metadata[b"title"]
    assert "reconstruction" in read_log(path).name
    assert path.stat().st_size < (100_000 if "10min" in name else 1_000_000)


@pytest.mark.real
@pytest.mark.nightly
def test_the_script_reproduces_the_shipped_files(
    project: Path, shared_data: Path, tmp_path: Path
) -> None:
    script = project / "replay" / "make_leaf_reconstruction.py"
    subprocess.run(
        [sys.executable, script, "--schedules", shared_data / "drive_schedules", "-o", tmp_path],
        check=True,
        capture_output=True,
    )
    for name in FILES:
        again, there = pq.read_table(tmp_path / name), pq.read_table(shared_file("replay", name))
        assert again.schema.equals(there.schema, check_metadata=True)
        assert again.equals(there)


def test_the_script_names_a_missing_schedule(project: Path, tmp_path: Path) -> None:
    script = project / "replay" / "make_leaf_reconstruction.py"
    done = subprocess.run(
        [sys.executable, script, "--schedules", tmp_path, "-o", tmp_path],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "udds.csv" in done.stderr or "us06.csv" in done.stderr or "hwfet.csv" in done.stderr
    assert "fastsim" in done.stderr
    assert list(tmp_path.iterdir()) == []
