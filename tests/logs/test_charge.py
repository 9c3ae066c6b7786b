"""Charge against the log's own SoC: capacity with its error, jumps, contradictions, values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.logs.charge import contradiction, implied_capacity, refuse_contradictions
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import difference_from_reference

CAPACITY_AH = 60.0


def drive(seed: int = 0, hours: float = 1.5) -> Log:
    """Return a drive at 1 Hz, whose SoC has steps of 0.5 %."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(3600 * hours), dtype=float)
    current_a = np.repeat(rng.normal(20.0, 30.0, time_s.size // 6 + 1), 6)[: time_s.size]
    out_ah = np.concatenate([[0.0], np.cumsum(0.5 * (current_a[1:] + current_a[:-1]))]) / 3600.0
    soc_pct = np.round(2.0 * (90.0 - 100.0 * out_ah / CAPACITY_AH)) / 2.0
    voltage_v = 380.0 - 0.1 * current_a - out_ah
    return Log(time_s, current_a, voltage_v, np.full(time_s.size, 20.0), soc_pct, name="drive")


def test_a_capacity_has_the_error_of_momentary_currents() -> None:
    errors, shares = [], []
    for seed in range(40):
        found = implied_capacity([drive(seed).rows(slice(None, None, 17))])
        errors.append((found.capacity_ah - CAPACITY_AH) / found.std_ah)
        shares.append(found.std_ah / found.capacity_ah)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.4
    assert 0.04 < np.median(shares) < 0.2
    exact = implied_capacity([drive()])
    assert exact.std_ah < 0.02 * exact.capacity_ah


def test_a_jump_of_the_soc_is_no_charge() -> None:
    log = drive()
    assert log.soc_pct is not None
    corrected = log.soc_pct + np.where(log.time_s < 2000.0, -12.0, 0.0)
    found = implied_capacity([replace(log, soc_pct=corrected)])
    assert found.capacity_ah == pytest.approx(CAPACITY_AH, rel=0.03)


@pytest.mark.parametrize("factor", [0.4, 2.5, 10.0])
def test_a_factor_of_two_is_a_contradiction(factor: float) -> None:
    log = drive()
    wrong = replace(log, current_a=factor * log.current_a)
    assert contradiction(wrong) is None  # consistent in itself
    found = contradiction(wrong, CAPACITY_AH)
    assert found is not None
    assert found.startswith("charge and SoC contradict each other: ")
    with pytest.raises(InputError, match="the pack has 60 Ah"):
        refuse_contradictions([log, wrong], CAPACITY_AH)


def test_parts_of_a_log_contradict_each_other() -> None:
    log = drive(hours=4.0)
    late = log.time_s > 7200.0
    wrong = replace(log, current_a=np.where(late, 0.3 * log.current_a, log.current_a))
    assert "in one part of the log" in (contradiction(wrong) or "")


@pytest.mark.parametrize("seed", range(20))
def test_a_right_log_is_no_contradiction(seed: int) -> None:
    for rows in (slice(None), slice(None, None, 17), slice(None, None, 60)):
        log = drive(seed).rows(rows)
        assert contradiction(log) is None
        for capacity_ah in (0.6 * CAPACITY_AH, CAPACITY_AH, 1.6 * CAPACITY_AH):
            assert contradiction(log, capacity_ah) is None


def written(folder: Path, voltage: list[float], soc: list[float]) -> Path:
    """Write a table with these voltages and SoC."""
    columns = zip(voltage, soc, strict=True)
    rows = [f"{k},{10 * (k % 3)},{u},20,{s}" for k, (u, s) in enumerate(columns)]
    path = folder / "log.csv"
    header = "time_s,current_a,voltage_v,temperature_c,soc_pct"
    path.write_text("\n".join([header, *rows, ""]))
    return path


def test_a_soc_above_full_is_remarked_and_no_start(tmp_path: Path) -> None:
    right = read_log(written(tmp_path, [380.0] * 50, [100.4 - k for k in range(50)]))
    assert right.first_soc() == (0, 100.4)
    assert right.remarks == ()
    wrong = read_log(written(tmp_path, [380.0] * 50, [109.1 - k for k in range(50)]))
    assert wrong.first_soc() is None
    (remark,) = wrong.remarks
    assert remark.startswith("SoC 60.1 … 109.1 % is not within 0–100 % in 9 rows")


def test_rows_without_voltage_are_remarked(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, [0.0] * 3 + [380.0] * 47, [50.0] * 50))
    assert log.remarks == ("0 V in 3 rows (the first is row 1): no voltage was read",)


@pytest.mark.parametrize(
    ("headings", "unit", "counts"),
    [
        ("Consumed Ah", "", lambda out, _: [-out]),
        ("Consumed Ah", " Ah", lambda out, _: [-out]),
        ("CurrTot [mAh]", "", lambda out, _: [1000.0 * (7.0 + out)]),
        ("Charged Ah,Discharged Ah", "", lambda out, used: [used - out + 100.0, 50.0 + used]),
    ],
)
def test_the_capacity_is_that_of_the_logs_own_counter(
    tmp_path: Path, headings: str, unit: str, counts: Callable[..., list[np.ndarray]]
) -> None:
    log = drive()
    assert log.soc_pct is not None
    step_ah = np.diff(log.time_s, prepend=0.0) * log.current_a / 3600.0
    columns = counts(np.cumsum(step_ah), np.cumsum(np.maximum(step_ah, 0.0)))
    table = np.column_stack([log.time_s, log.current_a, log.voltage_v, log.soc_pct, *columns])
    rows = [",".join(f"{value:.4f}" for value in row) + unit for row in table[::17]]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([f"Time [s],Current [A],Voltage [V],SoC [%],{headings}", *rows, ""]))
    read = read_log(path, temperature_c=20.0)
    assert any("counted by" in remark for remark in read.remarks)
    found = implied_capacity([read.rows(slice(3, None))])
    assert found.capacity_ah == pytest.approx(CAPACITY_AH, rel=0.02)
    assert found.std_ah < 0.02 * CAPACITY_AH


def test_a_column_in_ah_that_counts_something_else_is_no_counter(tmp_path: Path) -> None:
    log = drive()
    assert log.soc_pct is not None
    table = np.column_stack([log.time_s, log.current_a, log.voltage_v, log.soc_pct])
    rows = [",".join(f"{value:.4f}" for value in row) + ",50.1" for row in table]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["Time [s],Current [A],Voltage [V],SoC [%],AHr", *rows, ""]))
    assert read_log(path, temperature_c=20.0).counted_ah is None


def test_columns_in_ah_that_all_miss_are_said(tmp_path: Path) -> None:
    log = drive()
    assert log.soc_pct is not None
    halved_ah = 0.5 * np.cumsum(np.diff(log.time_s, prepend=0.0) * log.current_a) / 3600.0
    table = np.column_stack([log.time_s, log.current_a, log.voltage_v, log.soc_pct, halved_ah])
    rows = [",".join(f"{value:.4f}" for value in row) for row in table]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["Time [s],Current [A],Voltage [V],SoC [%],Ah out", *rows, ""]))
    read = read_log(path, temperature_c=20.0)
    assert read.counted_ah is None
    assert [
        text for text in read.remarks if "no column in Ah counts this current: the near" in text
    ]


def test_an_offset_over_months_contradicts_no_charge() -> None:
    days, soc_pct, current_a = 60, 50.0, []
    soc = []
    for minute in range(days * 1440):
        amps = 12.0 if minute % 1440 < 720 else -12.0
        soc_pct -= (amps - 0.3) / 60.0
        soc_pct = 90.0 if soc_pct > 100.0 else soc_pct  # corrected by its gauge
        current_a.append(amps)
        soc.append(soc_pct)
    minutes = np.arange(days * 1440.0)
    log = Log(60.0 * minutes, current_a, 52.0 + 0.0 * minutes, 20.0 + 0.0 * minutes, soc)
    assert contradiction(log, 100.0) is None
    assert contradiction(log) is None
    assert implied_capacity([log]).capacity_ah == pytest.approx(100.0, rel=0.05)
    assert difference_from_reference(log, 100.0) is None


@pytest.mark.parametrize("off_pct", [10.0, 22.0, 30.0])
def test_a_gauge_that_stands_at_its_end_is_off_and_no_contradiction(off_pct: float) -> None:
    log = drive(hours=2.0)
    assert log.soc_pct is not None
    stands_pct = np.minimum(log.soc_pct + 10.0 + off_pct, 100.0)
    too_high = replace(log, soc_pct=stands_pct)
    assert contradiction(too_high, CAPACITY_AH) is None
    too_low = replace(log, current_a=-log.current_a, soc_pct=100.0 - stands_pct)
    assert contradiction(too_low, CAPACITY_AH) is None
