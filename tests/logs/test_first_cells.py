"""What the first cells of a column hold decides nothing of the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.errors import InputError


def test_a_first_cell_without_a_value_hides_no_decimal_comma(tmp_path: Path) -> None:
    path = tmp_path / "cell.csv"
    rows = [f"{k};{15 + k % 3}.500;{'--' if k == 0 else f'3,{70 + k % 9}'};25" for k in range(900)]
    path.write_text("\n".join(["time [s];current [mA];voltage [V];temperature [°C]", *rows, ""]))
    assert np.allclose(np.unique(read_log(path).current_a), [15.5, 16.5, 17.5])


def test_a_word_as_first_value_loses_no_decimals(tmp_path: Path) -> None:
    path = tmp_path / "values.csv"
    lines = ['"SECONDS";"PID";"VALUE";"UNITS"', '"0,0";"Charging";"Yes";""']
    for k in range(900):
        lines += [f'"{k},0";"HV Battery Current";"{k % 7},5";"A"']
        lines += [f'"{k},1";"HV Battery Voltage";"35{k % 5},25";"V"']
        lines += [f'"{k},2";"HV Battery Temperature";"25,5";"°C"']
    path.write_text("\n".join([*lines, ""]))
    log = read_log(path)
    assert len(log.time_s) > 800
    assert np.allclose(np.unique(log.current_a), np.arange(7) + 0.5)


@pytest.mark.parametrize(
    ("early", "late", "expected"),
    [("20.500", "3,5", 20_500.0), ("20.500", "3.5", 20.5), ("20", "20.500", 20.5)],
)
def test_rows_below_the_beginning_tell_what_a_mark_means(
    tmp_path: Path, early: str, late: str, expected: float
) -> None:
    """As many rows as one reads at once hold no number of the last column, or no mark."""
    path = tmp_path / "late.csv"
    rows = [f"{k};{early};380;21;--" for k in range(8000)]
    rows += [f"{8000 + k};20.500;380;21;{late}" for k in range(100)]
    path.write_text("\n".join(["t [s];I [mA];U [V];T1 [°C];T2 [°C]", *rows, ""]))
    columns = "temperature=T1 [°C]+T2 [°C]"
    assert read_log(path, columns=columns).current_a[-1] == pytest.approx(expected / 1e3)


def test_numbers_of_a_row_per_value_have_thousands_below_words(tmp_path: Path) -> None:
    path = tmp_path / "values.csv"
    lines = ["SECONDS;PID;VALUE;UNITS", "0.0;Charging;Yes;"]
    for k in range(900):
        lines += [f"{k}.0;HV Battery Current;{k % 7}.5;A", f"{k}.1;HV Battery Voltage;360,800;mV"]
        lines += [f"{k}.2;HV Battery Temperature;25;°C"]
    path.write_text("\n".join([*lines, ""]))
    assert read_log(path).voltage_v[5] == pytest.approx(360.8)


@pytest.mark.parametrize("points", [",", "."])
def test_thousands_that_may_be_decimals_are_refused(tmp_path: Path, points: str) -> None:
    path = tmp_path / "whole.csv"
    rows = [f"{k};{1000 * (k % 20) + 500:,};380;21".replace(",", points) for k in range(9000)]
    path.write_text("\n".join(["t [s];I [mA];U [V];T [°C]", *rows, ""]))
    with pytest.raises(InputError, match=r"I \[mA\]: it may be 1\.500 or 1500"):
        read_log(path)


def test_steps_in_a_pattern_are_no_other_unit(tmp_path: Path) -> None:
    path = tmp_path / "pattern.csv"
    time_s = np.cumsum(np.tile([0.5, 0.0003, 0.5], 8000))
    rows = [f"{t:.4f},{5 + 4 * np.sin(t):.3f},{360 - 0.1 * np.sin(t):.3f},25" for t in time_s]
    path.write_text("\n".join(["time,current,voltage,temperature", *rows, ""]))
    assert np.isclose(read_log(path).time_s[-1] - read_log(path).time_s[0], np.ptp(time_s), atol=1)
