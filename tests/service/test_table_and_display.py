"""The estimate table and the line on the terminal."""

from __future__ import annotations

import errno
import io
import math
from dataclasses import replace
from pathlib import Path

import pyarrow.csv
import pyarrow.parquet
import pytest
from rich.console import Console
from watched import Watched

from cangauge.cli.run import LiveLine, live_text
from cangauge.errors import InputError
from cangauge.service.estimate_table import EstimateWriter
from cangauge.types import Estimate, Reason, Status
from live import LoggedLines

ROW = Estimate(
    1.5, 63.2, 1.25, math.nan, 64.0, 370.5, -0.1 / 3.0, Status.DEGRADED,
    Reason.CURRENT_GAP | Reason.VOLTAGE_MISSING, 7,
)  # fmt: skip


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_rows_read_back_exactly(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"soc{suffix}"
    with EstimateWriter(path) as writer:
        for number in range(10_000):  # more than one block
            writer.add(0.1 * number, ROW._replace(soc_pct=100.0 / (number + 1.0)))
    read = pyarrow.csv.read_csv if suffix == ".csv" else pyarrow.parquet.read_table
    table = read(path)
    assert table.num_rows == writer.rows == 10_000
    assert table["time_s"].to_pylist() == [0.1 * number for number in range(10_000)]
    assert table["soc_pct"].to_pylist() == [100.0 / (number + 1.0) for number in range(10_000)]
    assert table["residual_v"][0].as_py() == -0.1 / 3.0
    assert table["soc_newton_pct"].null_count == 10_000
    assert table["status"][0].as_py() == "degraded"
    assert table["reasons"][0].as_py() == "current gap; voltage missing"


def test_nothing_half_written_is_left(tmp_path: Path) -> None:
    path = tmp_path / "soc.csv"
    path.write_text("what stood there before")

    def break_off() -> None:
        with EstimateWriter(path) as writer:
            writer.add(0.0, ROW)
            raise RuntimeError("the bus is gone")

    with pytest.raises(RuntimeError, match="bus"):
        break_off()
    assert path.read_text() == "what stood there before"
    assert [each.name for each in tmp_path.iterdir()] == ["soc.csv"]


def test_without_a_sample_the_table_is_empty_but_whole(tmp_path: Path) -> None:
    for name in ("soc.csv", "soc.parquet"):
        with EstimateWriter(tmp_path / name):
            pass
    assert (tmp_path / "soc.csv").read_text().count("\n") == 1
    assert pyarrow.parquet.read_table(tmp_path / "soc.parquet").num_rows == 0


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.csv or \.parquet"):
        EstimateWriter(tmp_path / "soc.xlsx")


def test_the_line_has_soc_status_and_rate() -> None:
    watched = Watched()
    text = live_text(watched.monitor.latest).plain
    assert "SoC – ± –  initialising (no initial soc; input stale)" in text
    watched.drive(90.0)
    watched.turn()
    snapshot = replace(watched.monitor.latest, samples_per_s=10.0)
    latest, sample = watched.pipeline.latest, watched.pipeline.latest_sample
    text = live_text(snapshot).plain
    assert f"SoC {latest.soc_pct:.2f} ± {latest.soc_std_pct:.2f} %  valid" in text
    assert sample is not None
    assert f"{sample.voltage_v:.2f} V" in text
    assert text.endswith("10 samples/s")


def test_the_line_shows_bus_errors() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=120)
    with LiveLine(console) as line:
        line.show(replace(Watched().monitor.latest, bus_trouble="bus away for 12 s"))
    assert "bus away for 12 s" in out.getvalue()


def test_a_snapshot_is_made_a_few_times_a_second_at_most() -> None:
    watched = Watched()
    assert sum(watched.monitor.turn(200.0 + 1e-3 * ms) for ms in range(1000)) <= 5


def test_a_full_disk_abandons_the_table_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "soc.parquet"

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with LoggedLines("cangauge.service.estimate_table") as logged, EstimateWriter(path) as table:
        monkeypatch.setattr(table, "_write", full)
        for number in range(10_000):
            table.add(0.1 * number, ROW)
    assert table.failed
    assert len(logged.lines) == 1
    assert "soc.parquet: cannot be written" in logged.lines[0]
    assert list(tmp_path.iterdir()) == []
