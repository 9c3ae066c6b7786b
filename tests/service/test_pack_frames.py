"""SOC_HEALTH, SOC_POWER and SOC_CELLS: bits, times, and the same numbers live and offline."""

from __future__ import annotations

import math
from pathlib import Path

import can
import cantools
import crccheck.crc
import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.bus.publish import (
    FrameIds,
    PackReport,
    SocCells,
    SocHealth,
    SocPower,
    SocPublisher,
    SocReader,
)
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.cells import UNKNOWN
from cangauge.estimation.compiled import make_estimator
from cangauge.estimation.offline import samples_of
from cangauge.estimation.power import PackLimits
from cangauge.logs.log import Log
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.config import load_config
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.setup import pipeline_settings
from cangauge.types import CellReport, Estimate, Health, Power, Reason, Status
from cells_bus import ALL_CELLS, CAR, CELLS_DBC, CELLS_ON_BUS, all_cell_frames
from live import collect, leaf_model, quantized, short_log, virtual_port, virtual_service

NAN = math.nan
ESTIMATE = Estimate(0.0, 63.2, 1.5, 62.1, 63.9, 370.0, -0.25, Status.VALID, Reason.NONE, 1)
HEALTH = Health(48.27, 1.13, 1.235, 0.04, -1.31)
POWER = Power(187.0, 21.0, 96.0, 13.0, 11_430.0, 620.0)
CELLS = CellReport(96, 17, 41.3, 2.2, 7.9, -1.27, 0.06, is_sum_wrong=True)
REPORT = PackReport(HEALTH, POWER, CELLS)


def decoded(message: can.Message) -> dict[str, float]:
    database = cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))
    return database.decode_message(message.arbitration_id, message.data, decode_choices=False)


def test_the_dbc_decodes_health_power_and_cells() -> None:
    frames = SocPublisher().report_frames(REPORT)
    assert [each.arbitration_id for each in frames] == [0x5A2, 0x5A3, 0x5A4]
    health, power, cells = map(decoded, frames)
    assert health["capacity_ah"] == pytest.approx(48.27, abs=0.0251)
    assert health["capacity_std_ah"] == pytest.approx(1.13, abs=0.0251)
    assert health["resistance_ratio"] == pytest.approx(1.235, abs=0.00251)
    assert health["resistance_std"] == pytest.approx(0.04, abs=0.00501)
    assert health["current_offset_a"] == pytest.approx(-1.31, abs=0.0101)
    assert power["discharge_a"] == pytest.approx(187.0, abs=1.0)
    assert power["discharge_std_a"] == pytest.approx(21.0, abs=2.0)
    assert power["charge_a"] == pytest.approx(96.0, abs=1.0)
    assert power["energy_kwh"] == pytest.approx(11.43, abs=0.0251)
    assert power["energy_std_kwh"] == pytest.approx(0.62, abs=0.0501)
    assert cells["weakest_cell"] == 17
    assert cells["weakest_soc_pct"] == pytest.approx(41.3, abs=0.051)
    assert cells["weakest_soc_std_pct"] == pytest.approx(2.2, abs=0.101)
    assert cells["cell_spread_pct"] == pytest.approx(7.9, abs=0.101)
    assert cells["sum_error_v"] == pytest.approx(-1.27, abs=0.0101)
    assert cells["sum_check"] == 2


def test_unknown_values_are_not_available() -> None:
    reader = SocReader()
    contents = [reader.read(each) for each in SocPublisher().report_frames(
        PackReport(Health(*(NAN,) * 5), Power(), UNKNOWN)
    )]  # fmt: skip
    kinds = [SocHealth, SocPower, SocCells]
    assert [type(each) for each in contents] == kinds
    for content in contents:
        assert content is not None
        known = {name: value for name, value in content._asdict().items() if not math.isnan(value)}
        assert known == ({"sum_check": 0.0} if isinstance(content, SocCells) else {})


def test_values_beyond_the_range_are_clipped_not_wrapped() -> None:
    wide = PackReport(
        Health(5000.0, 900.0, 70.0, 9.0, -400.0),
        Power(9e3, 9e3, 9e3, 9e3, 9e9, 9e9),
        CellReport(900, 1022, 130.0, 99.0, 500.0, 4e3, 1.0, is_sum_wrong=False),
    )
    health, power, cells = (SocReader().read(each) for each in SocPublisher().report_frames(wide))
    assert isinstance(health, SocHealth)
    assert isinstance(power, SocPower)
    assert isinstance(cells, SocCells)
    # One step below the code of "not available".
    assert health == pytest.approx((819.1, 51.1, 5.11, 1.26, -20.46))
    assert power == pytest.approx((2044.0, 248.0, 2044.0, 248.0, 409.5, 12.6))
    assert cells == pytest.approx((1022, 102.2, 25.2, 102.0, 40.94, 1.0))


def test_pack_frames_are_protected_like_the_others() -> None:
    database = cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))
    publisher, reader = SocPublisher(), SocReader()
    lists = set()
    for count in range(18):
        for message in publisher.report_frames(REPORT):
            attributes = database.get_message_by_frame_id(message.arbitration_id).dbc.attributes
            data_ids = bytes.fromhex(attributes["E2EDataIdList"].value)
            lists.add(data_ids)
            assert message.data[1] & 15 == count % 16
            covered = bytes([*message.data[1:], data_ids[count % 16]])
            assert crccheck.crc.Crc8Autosar.calc(covered) == message.data[0]
    assert len(lists) == 3
    assert all(len(set(each)) == 16 for each in lists)
    for message in publisher.report_frames(REPORT):
        for bit in range(64):
            broken = can.Message(
                arbitration_id=message.arbitration_id, is_extended_id=False, data=message.data
            )
            broken.data[bit // 8] ^= 1 << bit % 8
            assert reader.read(broken) is None


def test_pack_frames_are_sent_every_second_by_both_clocks() -> None:
    publisher = SocPublisher()
    asked = []

    def report() -> PackReport:
        asked.append(1)
        return REPORT._replace(cells=None)

    beats = [publisher.beat(ESTIMATE, beat, 0.0, report) for beat in range(30)]
    assert [len(frames) for frames in beats] == ([4] + [1] * 9) * 3
    assert len(asked) == 3
    replayed = [
        len([each for each in publisher.publish(ESTIMATE._replace(time_s=0.1 * step), step, report)
             if each.arbitration_id == 0x5A2])
        for step in range(40)
    ]  # fmt: skip
    assert sum(replayed) == 4


def test_ids_of_pack_frames_are_configured(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text('model = "m"\n[ids]\nsoc_health = 0x10\nsoc_power = 0x11\nsoc_cells = 0x12\n')
    ids = pipeline_settings(load_config(file)).ids
    frames = SocPublisher(ids).report_frames(REPORT)
    assert [each.arbitration_id for each in frames] == [0x10, 0x11, 0x12]
    with pytest.raises(InputError, match=r"ids\.soc_health"):
        FrameIds(soc_health=0x5A0)


def test_limits_are_configured(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text('model = "m"\n[limits]\nmin_voltage_v = 300\nmax_charge_a = 40\n')
    limits = pipeline_settings(load_config(file)).estimator.limits
    assert limits == PackLimits(min_voltage_v=300.0, max_charge_a=40.0)
    file.write_text('model = "m"\n[limits]\nmin_voltage_v = -3\n')
    with pytest.raises(InputError, match=r"limits\.min_voltage_v"):
        load_config(file)


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
    log, car = short_log(120.0, rate_hz=2.0), car_with_cells(tmp_path)
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
    assert any(isinstance(each, SocCells) and each.weakest_cell == 40 for each in contents)


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
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    kinds = {type(SocReader().read(each)) for each in pipeline.heartbeat()}
    assert SocHealth in kinds
    assert SocPower in kinds
    assert SocCells not in kinds


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


def test_a_running_service_sends_them_every_second() -> None:
    with virtual_port("pack") as port, virtual_service("pack"):
        frames = collect(port, 1.4)
    kinds = [type(SocReader().read(each)) for each in frames]
    assert 1 <= kinds.count(SocHealth) <= 2
    assert kinds.count(SocPower) == kinds.count(SocHealth)
    assert SocCells not in kinds
