"""`cangauge estimate --pack`: health, power and cells of logs and captures."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from cangauge._resources import shared_file
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.logs.read import read_cells, read_log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline
from cells_bus import ALL_CELLS, CAR, CELLS_DBC, CELLS_ON_BUS, all_cell_frames

Run = Callable[..., object]
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


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_log_with_cell_columns(run: Run, made: Path, tmp_path: Path, suffix: str) -> None:
    log = read_log(made / "part.csv").rows(slice(0, 100))
    path, pack = tmp_path / f"cells{suffix}", tmp_path / "pack.parquet"
    if suffix == ".csv":
        pa.csv.write_csv(table_with_cells(log), path)
    else:
        pa.parquet.write_table(table_with_cells(log), path)
    ran = run("estimate", path, "-m", made / "model.json", "-o", tmp_path / "soc.csv",
              "--pack", pack, "--json")  # fmt: skip
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert found["pack"] == str(pack)
    assert found["cells"]["weakest"] == 12
    assert found["cells"]["cells"] == CELLS_ON_BUS
    assert found["notices"] == []
    columns = pa.parquet.read_table(pack)
    assert columns.column_names[:14] == ["time_s", *HEALTH, *POWER]
    assert columns["cell_weakest"].to_pylist()[-1] == 12
    # The last row is that of the last second.
    assert columns["capacity_ah"].to_pylist()[-1] == found["health"]["capacity_ah"]
    assert np.diff(columns["time_s"].to_numpy()).min() >= 1.0
    assert columns.num_rows == len(log)


def test_pack_rows_are_those_of_the_estimator(run: Run, made: Path, tmp_path: Path) -> None:
    pack = tmp_path / "pack.csv"
    log = read_log(made / "part.csv").rows(slice(0, 100))
    write_log(log, tmp_path / "part.parquet")
    ran = run("estimate", tmp_path / "part.parquet", "-m", made / "model.json", "-o",
              tmp_path / "soc.csv", "--pack", pack)  # fmt: skip
    assert ran.code == 0, ran.err
    low_pct = Model.load(made / "model.json").voltage_model().soc_range_pct[0]
    assert re.search(rf"energy left .* to {low_pct:.0f} % SoC", ran.out)
    table = pa.csv.read_csv(pack)
    assert table.column_names == ["time_s", *HEALTH, *POWER]
    settings = EstimatorSettings(initial_soc_pct=log.soc_pct[0], temperature_source="room")
    estimator = Estimator(Model.load(made / "model.json"), settings)
    rows = []
    for sample in samples_of(log):
        estimator.update(sample)
        rows.append([*estimator.health, *estimator.power()])
    for place, name in enumerate([*HEALTH, *POWER]):
        expected = np.array([row[place] for row in rows], dtype=float)
        found = np.array(table[name].to_pylist(), dtype=float)
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_capture_with_cells_as_live(run: Run, made: Path, tmp_path: Path) -> None:
    (tmp_path / "cells.dbc").write_text(CELLS_DBC)
    dbc_files = f'["{shared_file("dbc", "generic_pack.dbc")}", "cells.dbc"]'
    map_file = tmp_path / "car.toml"
    map_file.write_text(CAR.replace('"cells.dbc"', dbc_files) + ALL_CELLS)
    car = Vehicle.load(map=map_file)
    log = read_log(made / "part.csv").rows(slice(0, 100))
    encoder, cells, frames = FrameEncoder(car), cells_of(log), []
    for row, sample in enumerate(samples_of(log)):
        stamped = sample._replace(time_s=1.7e9 + sample.time_s)
        frames += all_cell_frames(cells[row].tolist(), stamped.time_s)
        frames += encoder.encode(stamped)
    with can.CanutilsLogWriter(str(tmp_path / "drive.log")) as writer:
        for frame in frames:
            writer.on_message_received(frame)
    pack = tmp_path / "pack.parquet"
    ran = run(
        "estimate", tmp_path / "drive.log", "--map", map_file, "-m",
        made / "model.json", "-o", tmp_path / "soc.csv", "--pack", pack, "--json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    pipeline = Pipeline(car, Model.load(made / "model.json"))
    for message in can.CanutilsLogReader(str(tmp_path / "drive.log")):
        pipeline.handle(message)
    pipeline.finish()
    live = json.loads(json.dumps(pipeline.report().to_dict()))
    found = json.loads(ran.out)
    assert {name: found[name] for name in live} == live
    assert live["cells"]["weakest"] == 12
    columns = pa.parquet.read_table(pack)
    assert columns["cell_soc_pct"].to_pylist()[-1] == live["cells"]["soc_pct"]


def test_a_log_without_cells_has_none(made: Path) -> None:
    assert read_cells(made / "part.csv", read_log(made / "part.csv").time_s) is None
    assert read_cells(made / "full.parquet", np.arange(3.0)) is None


def test_rows_that_the_reader_dropped_do_not_shift_the_cells(made: Path, tmp_path: Path) -> None:
    log = read_log(made / "part.csv")
    doubled = pa.concat_tables([table_with_cells(log).slice(0, 10), table_with_cells(log).slice(9)])
    pa.parquet.write_table(doubled, tmp_path / "doubled.parquet")
    found = read_cells(tmp_path / "doubled.parquet", log.time_s)
    assert found is not None
    assert np.array_equal(found.voltage_v, cells_of(log))
    assert found.first == 1


def test_a_gap_in_the_numbers_is_refused(made: Path, tmp_path: Path) -> None:
    table = table_with_cells(read_log(made / "part.csv")).drop_columns(["cell_05_v"])
    pa.parquet.write_table(table, tmp_path / "gap.parquet")
    with pytest.raises(InputError, match="cell_5_v"):
        read_cells(tmp_path / "gap.parquet", np.arange(3.0))


def test_the_pack_table_needs_a_known_suffix(run: Run, made: Path, tmp_path: Path) -> None:
    ran = run("estimate", made / "part.csv", "-m", made / "model.json", "-o",
              tmp_path / "soc.csv", "--pack", tmp_path / "pack.txt")  # fmt: skip
    assert ran.code == 2
    assert "--pack" in ran.err


def test_rows_of_a_long_log_are_limited_and_reach_its_end(
    run: Run, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cangauge.service.offline.PACK_ROWS", 60)
    options = ("-o", tmp_path / "soc.csv", "--pack", tmp_path / "pack.csv")
    assert run("estimate", made / "part.csv", "-m", made / "model.json", *options).code == 0
    time_s = pa.csv.read_csv(tmp_path / "pack.csv")["time_s"].to_numpy()
    assert 50 <= time_s.size <= 61
    assert time_s[-1] > 0.95 * 0.4 * 3600.0
