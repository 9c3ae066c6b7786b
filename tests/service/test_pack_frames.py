"""Health, power and cells: the same numbers live and offline, and what is published."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.bus.publish import (
    PackReport,
    SocReader,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.cells import UNKNOWN
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.offline import samples_of
from cangauge.logs.log import Log
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.settings import FrameIds
from cangauge.types import CellReport, Health, Power
from cells_bus import ALL_CELLS, CAR, CELLS_DBC, CELLS_ON_BUS, all_cell_frames
from live import leaf_model, quantized, short_log

HEALTH = Health(48.27, 1.13, 1.235, 0.04, -1.31)
POWER = Power(187.0, 21.0, 96.0, 13.0, 11_430.0, 620.0)
CELLS = CellReport(96, 17, 41.3, 2.2, 7.9, -1.27, 0.06, is_sum_wrong=True)
REPORT = PackReport(HEALTH, POWER, CELLS)


def car_with_cells(folder: Path) -> Vehicle:
    (folder / "cells.dbc").write_text(CELLS_DBC)
    (folder / "car.toml").write_text(CAR + ALL_CELLS)
    return Vehicle.load(dbc=shared_file("dbc", "generic_pack.dbc"), map=folder / "car.toml")


def cells_of(log: Log, row: int) -> list[float]:
    """Return 96 cell voltages of a log's row, the 40th lower [V]."""
    volts = np.full(CELLS_ON_BUS, log.voltage_v[row] / CELLS_ON_BUS)
    volts[39] -= 0.030
    return volts.round(3).tolist()


def test_live_health_power_and_cells_equal_offline_ones(tmp_path: Path) -> None:
    log, car = short_log(120.0, rate_hz=1.0), car_with_cells(tmp_path)
    log = quantized(car, log)
    pipeline = Pipeline(car, leaf_model(), PipelineSettings())
    offline = make_estimator(leaf_model())
    encoder, reports = FrameEncoder(car), []
    for row, sample in enumerate(samples_of(log)):
        frames = [*all_cell_frames(cells_of(log, row), sample.time_s), *encoder.encode(sample)]
        reports += [pipeline.report() for frame in frames if pipeline.handle(frame)]
        offline.update(sample)
        # To the last bit.
        assert reports[-1].health == offline.health
        assert np.array_equal(reports[-1].power, offline.power(), equal_nan=True)
    last = reports[-1].cells
    assert last is not None
    assert (last.cells, last.weakest) == (CELLS_ON_BUS, 40)
    assert last.soc_pct < offline.estimate.soc_pct - 3.0
    assert last.sum_error_v == pytest.approx(0.03, abs=0.03)
    contents = [SocReader().read(each) for each in pipeline.heartbeat()]
    assert any(name == "soc_cells" and each["weakest_cell"] == 40 for name, each in contents)


def test_cells_follow_a_reloaded_model(tmp_path: Path) -> None:
    model = leaf_model()
    pipeline = Pipeline(car_with_cells(tmp_path), model, PipelineSettings())
    before = pipeline.cells
    pipeline.reconfigure(pipeline.vehicle, model, PipelineSettings())
    assert pipeline.cells is before
    other = model.model_copy(update={"name": "other"})
    pipeline.reconfigure(pipeline.vehicle, other, PipelineSettings())
    assert pipeline.cells is not before


def test_no_cell_frame_without_cell_signals() -> None:
    frames = Pipeline(Vehicle.load("generic"), leaf_model()).heartbeat()
    kinds = {SocReader().read(each)[0] for each in frames}
    assert kinds == {"soc_estimate", "soc_detail", "soc_health", "soc_power"}


def test_a_cell_message_with_a_published_id_is_refused(tmp_path: Path) -> None:
    settings = PipelineSettings(ids=FrameIds(soc_power=0x442))
    with pytest.raises(InputError, match=r"ids\.soc_power"):
        Pipeline(car_with_cells(tmp_path), leaf_model(), settings)


def test_a_wrong_sum_is_a_notice_with_its_size() -> None:
    assert "-1.27 V" in REPORT.notices[0]
    assert REPORT.to_dict()["notices"] == REPORT.notices
    agrees = REPORT._replace(cells=CELLS._replace(is_sum_wrong=False))
    assert agrees.notices == []
    assert agrees.to_dict()["cells"]["weakest"] == 17
    unknown = PackReport(HEALTH, Power(), UNKNOWN).to_dict()
    assert unknown["power"]["discharge_a"] is None
    assert unknown["cells"]["weakest"] is None
    assert PackReport(HEALTH, POWER).to_dict()["cells"] is None
