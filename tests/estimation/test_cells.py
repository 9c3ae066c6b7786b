"""The weakest cell by number, on simulated and on real cells, and the sum of the cells."""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import cangauge
from cangauge.estimation.cells import CellEstimator
from cangauge.estimation.compiled import make_estimator
from cangauge.logs.log import Log
from cangauge.model.delay_line import delayed_currents
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH, leaf_2012_model, leaf_2012_model_file
from cangauge.types import CellReport, Sample
from synthetic import drive_current

PACK = leaf_2012_model()
CELLS = 96


def follow(
    model: Model, rows: Iterator[Sample], cells_v: np.ndarray, first: int = 1
) -> tuple[list[CellReport], np.ndarray]:
    """Return the reports of each minute and the cells' SoC at the end [%]."""
    estimator = make_estimator(model)
    cells = CellEstimator(estimator.voltage_model, cells_v.shape[1], first)
    found = []
    for number, sample in enumerate(rows):
        estimator.update(sample)
        if cells.is_due(sample.time_s):
            volts = cells_v[number].tolist()
            cells.update(estimator.pack_tick(sample), volts, [0.0] * len(volts))
        if number % 60 == 59:
            found.append(cells.report)
    distances_pct = np.where(cells._is_seen, cells._x[:, 0], np.nan)
    return found, estimator.estimate.soc_pct + distances_pct


def simulated_pack(
    *, weak: int = 16, capacity: float = 0.8, sensor: float = 1.0, minutes: int = 75
) -> tuple[list[Sample], np.ndarray, np.ndarray]:
    """Return samples, cell voltages [V] and SoC [%] of a drive from 95 %, with one weak cell."""
    rng = np.random.default_rng(4)
    time_s = np.arange(60.0 * minutes)
    current_a = drive_current(time_s, 30.0, 9)
    used_pct = 100.0 * np.cumsum(current_a) / 3600.0 / CAPACITY_AH
    capacities = 1.0 + 0.02 * rng.normal(size=CELLS)
    capacities[weak] = capacity
    soc_pct = 95.0 + 0.5 * rng.normal(size=CELLS) - used_pct[:, None] / capacities
    resistances = 1.0 + 0.05 * rng.normal(size=CELLS)
    drop_v = (
        delayed_currents(time_s, current_a, PACK.loads.delays_s, time_s) @ PACK.loads.resistance_ohm
    )
    volts = PACK.pseudo_ocv(soc_pct.ravel(), 23.0).reshape(soc_pct.shape)
    volts = (volts + drop_v[:, None] * resistances) / CELLS
    pack_v = sensor * volts.sum(axis=1)
    cells_v = volts + 1e-3 * rng.normal(size=volts.shape) + 1e-3 * rng.normal(size=CELLS)
    rows = zip(time_s.tolist(), current_a.tolist(), pack_v.tolist(), strict=True)
    return [Sample(*row, 23.0) for row in rows], np.round(cells_v, 3), soc_pct


def test_the_weak_cell_of_96_is_found_with_its_soc() -> None:
    samples, cells_v, soc_pct = simulated_pack()
    reports, found_pct = follow(leaf_2012_model_file(), iter(samples), cells_v)
    assert all(report.weakest == 17 for report in reports[15:])
    last = reports[-1]
    assert last.cells == CELLS
    assert abs(last.soc_pct - soc_pct[-1, 16]) < 2.0 * last.soc_std_pct
    assert last.soc_pct == pytest.approx(soc_pct[-1, 16], abs=3.0)
    spread_pct = soc_pct[-1].max() - soc_pct[-1].min()
    assert last.spread_pct == pytest.approx(spread_pct, abs=3.0)
    others = np.delete(found_pct - soc_pct[-1], 16)
    assert np.std(others) < 1.0


def test_numbers_begin_at_the_stated_first() -> None:
    samples, cells_v, _ = simulated_pack(minutes=40)
    reports, _ = follow(leaf_2012_model_file(), iter(samples), cells_v, first=0)
    assert reports[-1].weakest == 16


@pytest.mark.parametrize(("sensor", "is_wrong"), [(1.0, False), (1.003, False), (0.99, True)])
def test_the_sum_of_cells_checks_the_pack_voltage(sensor: float, is_wrong: bool) -> None:
    samples, cells_v, _ = simulated_pack(sensor=sensor, minutes=10)
    reports, _ = follow(leaf_2012_model_file(), iter(samples), cells_v)
    last = reports[-1]
    error_v = np.mean([each.voltage_v for each in samples]) * (1.0 - 1.0 / sensor)
    assert last.sum_error_v == pytest.approx(error_v, abs=0.1)
    assert abs(last.sum_error_v - error_v) < 3.0 * last.sum_std_v
    assert last.is_sum_wrong is is_wrong


def test_missing_cells_are_not_counted_and_no_sum_is_made() -> None:
    samples, cells_v, _ = simulated_pack(minutes=5)
    cells_v[:, 40:] = math.nan
    reports, found_pct = follow(leaf_2012_model_file(), iter(samples), cells_v)
    assert reports[-1].cells == 40
    assert math.isnan(reports[-1].sum_error_v)
    assert not reports[-1].is_sum_wrong
    assert np.isnan(found_pct[40:]).all()


def test_nothing_is_known_before_the_first_voltages() -> None:
    cells = CellEstimator(PACK, 4)
    assert cells.report.weakest == -1
    assert math.isnan(cells.report.soc_pct)


# --- real cells: six in series, in a module of a Leaf


def module_rows(folder: Path, name: str) -> np.ndarray:
    """Return time [s], current [A], temperature [°C] and six cell voltages [V] at 1 Hz."""
    rows = []
    path = folder / "leaf_module_ornl" / f"module123-irdischarge-65ah-{name}.csv.gz"
    with gzip.open(path, "rt", encoding="latin-1") as file:
        for line in file:
            cells = line.split(",")
            try:
                numbers = [float(cells[at]) for at in (0, 7, 26, 20, 21, 22, 23, 24, 25)]
            except (ValueError, IndexError):
                continue
            rows.append(numbers)
    table = np.array(rows)
    table = table[np.concatenate(([True], np.diff(table[:, 0]) > 0.0))]
    table[:, 1] *= -1.0
    time_s = np.arange(math.ceil(table[0, 0]), table[-1, 0])
    return np.column_stack([time_s, *(np.interp(time_s, table[:, 0], c) for c in table.T[1:])])


def weakened(table: np.ndarray, cell: int, capacity: float) -> np.ndarray:
    """Return a cell's voltage if its capacity were smaller: its own curve, passed faster [V].

    The current is constant, so the polarisation along the curve is the same.
    """
    used_ah = np.cumsum(table[:, 1]) / 3600.0
    return np.interp(used_ah / capacity, used_ah, table[:, 3 + cell], right=math.nan)


def rows_of(table: np.ndarray, pack_v: np.ndarray) -> Iterator[Sample]:
    columns = (table[:, 0], table[:, 1], pack_v, table[:, 2])
    for row in zip(*(each.tolist() for each in columns), strict=True):
        yield Sample(*row)


def module_model(folder: Path, times: int = 1) -> Model:
    """Return the model of the module from its other discharges, with `times` as many cells."""
    logs = []
    for name in ("0_3c", "2_0c"):
        table = module_rows(folder, name)
        soc_pct = 100.0 - 100.0 * np.cumsum(table[:, 1]) / 3600.0 / 65.0
        volts = times * table[:, 3:].sum(axis=1)
        logs.append(Log(table[:, 0], table[:, 1], volts, table[:, 2], soc_pct, name=name))
    return cangauge.fit(logs, capacity_ah=65.0).model


@pytest.mark.nightly
@pytest.mark.real
def test_weakest_cells_of_a_real_module(shared_data: Path) -> None:
    model, table = module_model(shared_data), module_rows(shared_data, "1_0c")
    reports, soc_pct = follow(model, rows_of(table, table[:, 3:].sum(axis=1)), table[:, 3:])
    # Cells 1 and 4 of this module are lower from the start, and the first to be empty.
    assert {each.weakest for each in reports} == {1}
    assert sorted(np.argsort(soc_pct)[:2].tolist()) == [0, 3]
    weak = table.copy()
    weak[:, 3 + 4] = weakened(table, 4, 0.8)
    weak = weak[np.isfinite(weak[:, 3 + 4])]
    reports, _ = follow(model, rows_of(weak, weak[:, 3:].sum(axis=1)), weak[:, 3:])
    assert reports[-1].weakest == 5
    used_pct = 100.0 * weak[:, 1].sum() / 3600.0 / 65.0
    # It has 20 % less of what the same cell had given.
    assert reports[-1].soc_pct == pytest.approx(100.0 - used_pct / 0.8, abs=6.0)
