"""The estimate table and the line on the terminal."""

from __future__ import annotations

import errno
import io
import math
from pathlib import Path

import pyarrow.csv
import pyarrow.parquet
import pytest
from rich.console import Console

from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.vehicle import load_vehicle
from cangauge.errors import InputError
from cangauge.estimate.offline import samples_of
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Estimate, Reason, Status
from cangauge.service.estimate_table import EstimateWriter
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.run import LiveLine, live_text
from live import leaf_model, short_log

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


def test_the_line_tells_soc_status_and_rate() -> None:
    vehicle = load_vehicle("generic")
    gauge = Pipeline(vehicle, leaf_model(), PipelineSettings(EstimatorSettings(valid_std_pct=5.0)))
    assert "SoC – ± –  initialising (no initial soc; input stale)" in live_text(gauge, 0.0).plain
    encoder = FrameEncoder(vehicle)
    for sample in samples_of(short_log(90.0)):
        for frame in encoder.encode(sample):
            gauge.handle(frame)
    text = live_text(gauge, 10.0).plain
    latest = gauge.latest
    assert f"SoC {latest.soc_pct:.2f} ± {latest.soc_std_pct:.2f} %  valid" in text
    assert f"{gauge.latest_sample.voltage_v:.2f} V" in text  # type: ignore[union-attr] # there is one
    assert text.endswith("10 samples/s")


def test_it_is_drawn_a_few_times_a_second_at_most() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100)
    with LiveLine(console, Pipeline(load_vehicle("generic"), leaf_model())) as line:
        before = out.getvalue().count("samples/s")
        for millisecond in range(1000):
            line.show(50.0 + 1e-3 * millisecond)
        assert out.getvalue().count("samples/s") - before <= 5


def test_what_is_wrong_with_the_bus_is_on_the_line() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=120)
    gauge = Pipeline(load_vehicle("generic"), leaf_model())
    with LiveLine(console, gauge, lambda: "bus away for 12 s") as line:
        line.show(50.0)
    assert "bus away for 12 s" in out.getvalue()


def test_a_table_whose_disk_is_full_is_given_up_and_the_service_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    path = tmp_path / "soc.parquet"

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with EstimateWriter(path, said.append) as table:
        monkeypatch.setattr(table, "_write", full)
        for number in range(10_000):
            table.add(0.1 * number, ROW)
    assert table.failed
    assert len(said) == 1
    assert "soc.parquet: cannot be written" in said[0]
    assert list(tmp_path.iterdir()) == []
