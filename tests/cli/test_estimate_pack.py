"""`cangauge estimate --pack`: health, power and cells of logs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from cangauge.bus.recording import read_log
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cells_bus import CELLS_ON_BUS
from live import succeeds

HEALTH = [
    "capacity_ah", "capacity_std_ah", "resistance_ratio", "resistance_std", "offset_a",
    "offset_std_a",
]  # fmt: skip
POWER = [
    "discharge_a", "discharge_std_a", "charge_a", "charge_std_a", "energy_wh", "energy_std_wh",
    "energy_to_soc_pct",
]  # fmt: skip


def cells_of(log: Log) -> np.ndarray:
    """Return 96 cell voltages [V], the 12th of them 30 mV lower, at every row."""
    cells = np.repeat(log.voltage_v[:, None] / CELLS_ON_BUS, CELLS_ON_BUS, axis=1)
    cells[:, 11] -= 0.030
    return cells.round(3)


def table_with_cells(log: Log) -> pa.Table:
    table = log.to_arrow()
    for number, column in enumerate(cells_of(log).T, start=1):
        table = table.append_column(f"cell_{number:02d}_v", pa.array(column))
    return table


@pytest.fixture
def minutes(made: Path) -> Log:
    """The first 100 rows of a log."""
    return read_log(made / "part.csv").rows(slice(0, 100))


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_log_with_cell_columns(made: Path, minutes: Log, tmp_path: Path, suffix: str) -> None:
    path, pack = tmp_path / f"cells{suffix}", tmp_path / "pack.parquet"
    write = pa.csv.write_csv if suffix == ".csv" else pa.parquet.write_table
    write(table_with_cells(minutes), path)
    options = ("-m", made / "model.json", "-o", tmp_path / "soc.csv", "--pack", pack, "--json")
    found = succeeds("estimate", path, *options).json
    assert found["pack"] == str(pack)
    assert (found["cells"]["weakest"], found["cells"]["cells"]) == (12, CELLS_ON_BUS)
    assert found["notices"] == []
    columns = pa.parquet.read_table(pack)
    assert columns.column_names[:14] == ["time_s", *HEALTH, *POWER]
    assert columns["cell_weakest"].to_pylist()[-1] == 12
    # The last row is that of the last second.
    assert columns["capacity_ah"].to_pylist()[-1] == found["health"]["capacity_ah"]
    assert np.diff(columns["time_s"].to_numpy()).min() >= 1.0
    assert columns.num_rows == len(minutes)


def test_pack_rows_are_those_of_the_estimator(made: Path, minutes: Log, tmp_path: Path) -> None:
    pack = tmp_path / "pack.csv"
    write_log(minutes, tmp_path / "part.parquet")
    options = ("-m", made / "model.json", "-o", tmp_path / "soc.csv", "--pack", pack)
    low_pct = Model.load(made / "model.json").voltage_model().range.soc_pct[0]
    out = succeeds("estimate", tmp_path / "part.parquet", *options).out
    assert re.search(rf"energy left .* to {low_pct:.0f} % SoC", out)
    table = pa.csv.read_csv(pack)
    assert table.column_names == ["time_s", *HEALTH, *POWER]
    assert minutes.soc_pct is not None
    settings = EstimatorSettings(initial_soc_pct=minutes.soc_pct[0], temperature_source="room")
    estimator = Estimator(Model.load(made / "model.json"), settings)
    rows = []
    for sample in samples_of(minutes):
        estimator.update(sample)
        rows.append([*estimator.health, *estimator.power()])
    found = np.array([table[name].to_pylist() for name in [*HEALTH, *POWER]], dtype=float)
    np.testing.assert_allclose(found.T, np.array(rows, dtype=float), rtol=1e-9)


def test_rows_of_a_long_log_are_limited_and_reach_its_end(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cangauge.service.offline.PACK_ROWS", 60)
    options = ("-o", tmp_path / "soc.csv", "--pack", tmp_path / "pack.csv")
    succeeds("estimate", made / "part.csv", "-m", made / "model.json", *options)
    time_s = pa.csv.read_csv(tmp_path / "pack.csv")["time_s"].to_numpy()
    assert 50 <= time_s.size <= 61
    assert time_s[-1] > 0.95 * 0.4 * 3600.0
