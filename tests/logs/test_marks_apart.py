"""Marks in the times of a table with a row per value tell nothing of its values."""

from __future__ import annotations

from pathlib import Path

from cangauge.bus.recording import read_log


def test_points_in_the_times_do_not_make_commas_of_values_thousands(tmp_path: Path) -> None:
    row = "{k}.1;HV current;1{a},125;A\n{k}.2;HV voltage;360,250;V\n{k}.3;HV temperature;25;C\n"
    path = tmp_path / "t.csv"
    rows = "".join(row.format(k=k, a=k % 7) for k in range(600))
    path.write_text(f"SECONDS;PID;VALUE;UNITS\n{rows}")
    assert read_log(path).voltage_v[5] == 360.25


def test_commas_in_the_times_make_points_of_values_thousands(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    rows = "".join(f"{k},5;{20 + k % 7}.500;360;25\n" for k in range(600))
    path.write_text(f"t [s];I [mA];U [V];T [°C]\n{rows}")
    assert read_log(path).current_a[0] == 20.5
