"""`cangauge gap` with a simulator in the model's place: column, function, files, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.cli.gap import load_function
from cangauge.logs.canonical import write_table
from cangauge.model.published import CAPACITY_AH
from live import in_process, refused, succeeds
from synthetic import synthetic_log

SIMULATOR = f"""
import numpy as np

def simulate(time_s, current_a, temperature_c, initial_soc_pct):
    out_ah = np.cumsum(current_a * np.diff(time_s, prepend=time_s[0])) / 3600.0
    soc = initial_soc_pct - 100.0 * out_ah / {CAPACITY_AH}
    return 330.0 + 0.2 * soc + 0.003 * soc**2 - 0.12 * current_a

def broken(time_s, current_a, temperature_c, initial_soc_pct):
    raise ValueError("no such cell")

def leaves(time_s, current_a, temperature_c, initial_soc_pct):
    raise SystemExit(0)
"""


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives that the simulator explains, and one with 5 V too many."""
    folder = tmp_path_factory.mktemp("drives")
    (folder / "cell.py").write_text(SIMULATOR, encoding="utf-8")
    simulate = load_function(f"{folder / 'cell.py'}:simulate")
    for seed, extra_v in ((11, 0.0), (12, 0.0), (13, 0.0), (21, 5.0)):
        log = synthetic_log(hours=0.6, start_pct=85.0, end_pct=65.0, seed=seed)
        simulated_v = simulate(log.time_s, log.current_a, log.temperature_c, 85.0)
        noise_v = np.random.default_rng(seed).normal(0.0, 0.3, len(log))
        log = replace(log, voltage_v=simulated_v + noise_v + extra_v)
        name = "trip" if extra_v else f"good{seed}"
        columns = {
            "Time [s]": log.time_s, "Current [A]": log.current_a, "Voltage [V]": log.voltage_v,
            "Temperature [°C]": log.temperature_c, "SoC [%]": log.soc_pct,
            "U model [V]": simulated_v,
        }  # fmt: skip
        write_table(columns, folder / f"{name}.csv")
    return folder


@pytest.fixture
def given(drives: Path) -> list[object]:
    """`gap` on the drive with the fault, beside the others."""
    references = sorted(drives.glob("good*.csv"))
    words = ["gap", drives / "trip.csv", "--capacity-ah", CAPACITY_AH, "--sign", "discharge"]
    return words + [word for path in references for word in ("--reference", path)]


def test_a_column_is_diagnosed_as_the_function_that_gave_it(
    given: list[object], drives: Path
) -> None:
    by_column = succeeds(*given, "--simulated", "U model [V]", "--json")
    assert "ignored: U model" not in by_column.err
    answer, gap = by_column.json["answer"], by_column.json["gap"]
    assert "voltage_reading" in answer["stated"]
    assert gap["baseline_rmse_v"] == pytest.approx(5.0, abs=0.3)
    assert gap["extended_rmse_v"] < 0.5
    function = succeeds(*given, "--simulator", f"{drives / 'cell.py'}:simulate", "--json").json
    assert function["answer"]["stated"] == answer["stated"]
    assert function["gap"]["baseline_rmse_v"] == pytest.approx(gap["baseline_rmse_v"], rel=1e-3)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ([], "--model"),
        (["--simulated", "U modell"], "no column has this heading"),
        (["--simulated", "U model [V]", "--simulator", "a:b"], "two simulators"),
        (["--simulator", "nowhere_at_all:simulate"], "cannot be imported"),
        (["--simulator", "cell.py:other"], "--simulator: cell.py has no function other"),
        (["--simulator", "cell.py:broken"], "no such cell"),
        (["--simulator", "cell.py:leaves"], "SystemExit"),
        (["--simulator", "leaves.py:simulate"], "SystemExit"),
        (["--extended", "trip.csv"], "--extended"),
        (["--simulator", "cell.py"], "MODULE:FUNCTION"),
    ],
)
def test_what_cannot_be_simulated_is_refused(
    given: list[object],
    drives: Path,
    words: list[str],
    problem: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(drives)
    (drives / "leaves.py").write_text("raise SystemExit(0)\n", encoding="utf-8")
    refused(in_process(*given, *words), problem)


def test_a_start_that_is_not_the_logs_own_is_told(
    given: list[object], drives: Path, made: Path
) -> None:
    simulator = ("--simulator", f"{drives / 'cell.py'}:broken")
    ran = in_process(*given, "-m", made / "model.json", *simulator, "--initial-soc", "0.85")
    assert "trip: the initial SoC is 0.85 % as given; its own SoC is 85.0 %" in ran.err
    assert "as 85" in ran.err
