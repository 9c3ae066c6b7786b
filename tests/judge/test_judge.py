"""The second opinion on simulated days of one pack."""

from __future__ import annotations

import gzip
import json
import sys
import time
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cangauge
from cangauge.__main__ import main
from cangauge.errors import InputError
from cangauge.extras.judge import explain
from cangauge.extras.judge.judgement import narrowed
from cangauge.extras.judge.linearised import Linearised, Terms
from cangauge.logs.canonical import write_table
from cangauge.logs.read import CellColumns
from cangauge.model.published import leaf_2012_model_file

CASES = Path(__file__).parents[3] / "shared" / "cases"
Pack = tuple[cangauge.Model, list[cangauge.Log]]


def drawn_ah(log: cangauge.Log) -> np.ndarray:
    steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s)
    return np.concatenate(([0.0], np.cumsum(steps))) / 3600.0


@pytest.fixture(scope="module")
def pack() -> Pack:
    """Model and healthy days of a simulated pack."""
    runs = [cangauge.simulate(seed=3, drive=k, hours=0.5, ambient_c=20.0) for k in range(1, 10)]
    logs = [replace(run.log, soc_pct=run.recording.true_soc_pct) for run in runs]
    capacity_ah = runs[0].pack.capacity_ah
    model = cangauge.fit(logs[:4], capacity_ah=capacity_ah, chemistry="oxide").model
    return model, logs[4:]


def shifted(logs: Sequence[cangauge.Log], *errors_pct: float) -> list[cangauge.Log]:
    """Return the logs of a gauge with an error in each log."""
    return [
        replace(log, soc_pct=log.soc_pct + error)
        for log, error in zip(logs, errors_pct, strict=True)
    ]


def with_offset(logs: Sequence[cangauge.Log], model: cangauge.Model, offset_a: float):
    """Return the logs of a gauge that counts an offset."""
    hours, changed = 0.0, []
    for log in logs:
        elapsed = (log.time_s - log.time_s[0]) / 3600.0
        error = 100.0 * offset_a * (hours + elapsed) / model.capacity_ah
        hours += elapsed[-1]
        changed.append(replace(log, soc_pct=log.soc_pct - error))
    return changed


def names(judgement: cangauge.Judgement) -> list[str]:
    return [fault.name for fault in judgement.faults]


def test_a_right_gauge_agrees(pack: Pack) -> None:
    model, logs = pack
    judgement = cangauge.judge(logs, model)
    assert (judgement.verdict, names(judgement)) == ("agrees", [])
    assert abs(judgement.error_pct) < 3.0 * judgement.error_std_pct
    assert judgement.text.startswith("The gauge is right: its error is ")
    assert judgement.next_step == "Nothing to do."


def test_an_offset_is_named_with_its_size(pack: Pack) -> None:
    model, logs = pack
    offset_a = model.capacity_ah / 25.0
    judgement = cangauge.judge(with_offset(logs, model, offset_a), model)
    assert (judgement.verdict, names(judgement)) == ("off", ["current_offset"])
    low, high = judgement.faults[0].interval
    assert low < offset_a < high


def test_an_offset_of_the_sensor_is_taken_out_of_the_corrected_soc(pack: Pack) -> None:
    model, logs = pack
    offset_a = model.capacity_ah / 12.0
    read = [
        replace(log, current_a=log.current_a + offset_a)
        for log in with_offset(logs, model, offset_a)
    ]
    judgement = cangauge.judge(read, model)
    assert names(judgement) == ["current_offset"]
    assert judgement.faults[0].size == pytest.approx(offset_a, rel=0.3)
    for log, soc in zip(logs, judgement.corrected_pct, strict=True):
        moved, truly = np.diff(soc[[0, -1]]), np.diff(log.soc_pct[[0, -1]])
        assert moved == pytest.approx(truly, abs=1.5)  # the count alone: 4 % off


@pytest.mark.parametrize(("before", "since_log"), [(5, 5), (3, 4)])
def test_an_offset_is_dated_among_the_last_eight_logs(
    pack: Pack, before: int, since_log: int
) -> None:
    model, logs = pack
    days = [
        replace(log, time_s=log.time_s + 86400.0 * day, voltage_v=log.voltage_v + 1e-3 * day)
        for day, log in enumerate([*logs, *logs[::-1], *logs[:2]])  # no two alike
    ]
    offset_a = model.capacity_ah / 15.0
    changed = [*days[:before], *with_offset(days[before:], model, offset_a)]
    found = {fault.name: fault for fault in cangauge.judge(changed, model).faults}
    assert found["current_offset"].since[0] == since_log


def test_a_wrong_start_is_named_and_the_corrected_soc_follows_the_truth(pack: Pack) -> None:
    model, logs = pack
    judgement = cangauge.judge(shifted(logs, *[-12.0] * 5), model)
    assert (judgement.verdict, names(judgement)) == ("off", ["start_or_reset"])
    for log, soc, std in zip(
        logs, judgement.corrected_pct, judgement.corrected_std_pct, strict=True
    ):
        assert np.max(np.abs(soc - log.soc_pct) / std) < 3.0


def test_a_wrong_scale_is_named(pack: Pack) -> None:
    model, logs = pack
    scaled = [replace(log, soc_pct=1.1 * log.soc_pct - 10.0) for log in logs]
    judgement = cangauge.judge(scaled, model)
    assert (judgement.verdict, names(judgement)) == ("off", ["count_scale"])
    assert judgement.faults[0].size == pytest.approx(10.0, abs=2.0)


@pytest.mark.parametrize("step_pct", [0.1, 1.0])
@pytest.mark.parametrize(("before", "after"), [(-12.0, 0.0), (7.0, 0.0), (0.0, -12.0)])
def test_of_two_levels_none_is_taken_for_right(
    pack: Pack, step_pct: float, before: float, after: float
) -> None:
    model, logs = pack
    changed, at_s = shifted(logs, *[before] * 2, *[after] * 3), 0.0
    for number in (2,):
        late = np.arange(len(logs[number])) > 0.6 * len(logs[number])
        soc = logs[number].soc_pct + np.where(late, after, before)
        changed[number] = replace(logs[number], soc_pct=soc)
        at_s = sum(log.duration_s for log in logs[:number]) + 0.6 * logs[number].duration_s
    shown = [
        replace(log, soc_pct=np.clip(np.round(log.soc_pct / step_pct) * step_pct, 0.0, 100.0))
        for log in changed
    ]
    judgement = cangauge.judge(shown, model)
    assert judgement.error_pct == pytest.approx(after, abs=3.0 * judgement.error_std_pct)
    assert judgement.verdict == ("off" if after else "agrees")
    first, second = judgement.pieces
    assert first.error_pct == pytest.approx(before, abs=3.0 * first.std_pct)
    assert second.error_pct - first.error_pct == pytest.approx(after - before, abs=1.0)
    assert judgement.since_first_s(first.end) == pytest.approx(at_s, abs=60.0)
    assert ("when it set itself" in judgement.text) == (before != 0.0)


def test_the_level_that_holds_now_is_one_fault(pack: Pack) -> None:
    model, logs = pack
    changed = shifted(logs, -6.0, -6.0, -6.0, -14.0, -14.0)
    late = np.arange(len(logs[2])) > 0.6 * len(logs[2])
    changed[2] = replace(logs[2], soc_pct=logs[2].soc_pct - np.where(late, 14.0, 6.0))
    faults = cangauge.judge(changed, model).faults
    assert {fault.name for fault in faults} == {"start_or_reset"}
    now = min(faults, key=lambda fault: fault.size)
    assert now.size == pytest.approx(-14.0, abs=3.0 * now.std)
    assert now.std < 2.0


def test_a_gauge_that_was_set_between_two_logs_is_right_after(pack: Pack) -> None:
    model, logs = pack
    judgement = cangauge.judge(shifted(logs, -12.0, -12.0, 0.0, 0.0, 0.0), model)
    assert judgement.verdict == "agrees"
    assert [round(piece.error_pct / 12.0) for piece in judgement.pieces] == [-1, 0]


def test_two_faults_are_both_named(pack: Pack) -> None:
    model, logs = pack
    both = [replace(log, soc_pct=0.88 * log.soc_pct + 12.0 + 9.0) for log in logs]
    judgement = cangauge.judge(both, model)
    assert set(names(judgement)) == {"start_or_reset", "count_scale"}
    true_pct = both[-1].soc_pct[-1] - logs[-1].soc_pct[-1]
    assert judgement.error_pct == pytest.approx(true_pct, abs=3.0 * judgement.error_std_pct)


def test_a_late_gauge_is_late_and_not_an_offset(pack: Pack) -> None:
    model, logs = pack
    late = [
        replace(log, soc_pct=np.interp(log.time_s - 120.0, log.time_s, log.soc_pct)).rows(
            log.time_s >= log.time_s[0] + 120.0
        )
        for log in logs
    ]
    judgement = cangauge.judge(late, model)
    assert names(judgement) == ["late"]
    assert judgement.faults[0].size == pytest.approx(120.0, abs=40.0)


def test_a_gauge_that_reads_the_voltage_under_load_has_no_other_fault(pack: Pack) -> None:
    model, logs = pack
    width = np.ones(30) / 30.0
    smooth_c = [np.convolve(log.current_a, width)[: len(log)] / model.capacity_ah for log in logs]
    shown = [
        replace(log, soc_pct=np.clip(np.round(log.soc_pct - 20.0 * rate_c, 1), 0.0, 100.0))
        for log, rate_c in zip(logs, smooth_c, strict=True)
    ]
    judgement = cangauge.judge(shown, model)
    assert names(judgement) == ["voltage_table"]
    assert "set itself" not in judgement.text
    low, high = judgement.faults[0].interval
    assert 0.0 < low < high


def stuck(log: cangauge.Log, step_pct: float, from_row: int) -> cangauge.Log:
    """Return the log of a gauge that shows steps, and stands still from a row on."""
    shown = np.round(log.soc_pct / step_pct) * step_pct
    shown[from_row:] = shown[from_row]
    return replace(log, soc_pct=shown)


@pytest.mark.parametrize(
    "change",
    [
        lambda logs: [stuck(logs[3], 1.0, 0)],
        lambda logs: [stuck(log, 1.0, 0) for log in logs],
        lambda logs: [*logs[:4], stuck(logs[4], 1.0, len(logs[4]) // 3)],
        lambda logs: [stuck(logs[1], 0.1, len(logs[1]) // 3)],
        lambda logs: [*logs[:4], replace(logs[4], soc_pct=np.full(len(logs[4]), 100.0))],
    ],
    ids=["one", "all", "part", "fine", "full"],
)
def test_a_gauge_that_stands_still_never_agrees(pack: Pack, change) -> None:
    model, logs = pack
    judgement = cangauge.judge(change(logs), model)
    assert (judgement.verdict, "stands_still" in names(judgement)) == ("off", True)
    assert "stands still at" in judgement.text


def test_a_gauge_that_may_stand_still_does_not_agree(pack: Pack) -> None:
    model, logs = pack
    left_pct = 100.0 * (drawn_ah(logs[4])[-1] - drawn_ah(logs[4])) / model.capacity_ah
    row = int(np.flatnonzero(left_pct > 1.6)[-1])
    judgement = cangauge.judge([*logs[:4], stuck(logs[4], 0.1, row)], model)
    assert (judgement.verdict, names(judgement)) == ("cannot_tell", [])
    assert cangauge.judge([*logs[:4], stuck(logs[4], 0.1, -20)], model).verdict == "agrees"


def test_a_stand_is_seen_by_charge_in_either_direction() -> None:
    hours = np.arange(0.0, 24.0, 1.0 / 60.0)
    amps = 15.0 * np.sin(2.0 * np.pi * hours / 24.0)  # net zero over the day
    log = cangauge.Log(3600.0 * hours, amps, np.full(hours.size, 53.0), np.full(hours.size, 20.0))
    soc = 80.0 - drawn_ah(log)
    model = cangauge.Model.prior("lfp", 16, 100.0)
    volts = model.predict(log, initial_soc_pct=80.0).voltage_v
    log = replace(log, voltage_v=volts, soc_pct=np.where(hours < 0.5, soc, soc[30]))
    judgement = cangauge.judge([log], chemistry="lfp", cells=16, capacity_ah=100.0)
    assert names(judgement)[0] == "stands_still" or "stands_still" in names(judgement)
    assert judgement.verdict == "off"


def test_a_gauge_at_its_limit_is_compared_at_the_end(pack: Pack) -> None:
    model, logs = pack
    empty = replace(logs[4], soc_pct=np.where(np.arange(len(logs[4])) < 900, logs[4].soc_pct, 0.0))
    judgement = cangauge.judge([*logs[:4], empty], model)
    assert judgement.verdict == "off"
    assert judgement.error_pct == pytest.approx(-logs[4].soc_pct[-1], abs=4.0)
    assert "stands_still" not in names(judgement)  # the charge flows towards the limit


def test_day_one_without_a_model_cannot_tell_and_asks_for_one(pack: Pack) -> None:
    model, logs = pack
    cells = round(float(logs[0].voltage_v.mean()) / 3.7)
    judgement = cangauge.judge(
        logs[:1], chemistry="oxide", cells=cells, capacity_ah=model.capacity_ah
    )
    assert judgement.verdict == "cannot_tell"
    assert judgement.error_std_pct > 3.0
    assert "Fit a model" in judgement.next_step


def test_command_prints_schema_2_and_writes_all_files(
    pack: Pack, tmp_path: Path, capsys, monkeypatch
) -> None:
    model, logs = pack
    paths = []
    for number, log in enumerate(logs[:2]):
        paths.append(str(tmp_path / f"day{number}.csv"))
        columns = ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct")
        write_table({name: getattr(log, name) for name in columns}, paths[-1])
    model.save(tmp_path / "m.json")
    outputs = {name: str(tmp_path / name) for name in ("page.html", "soc.csv", "narrow.json")}
    arguments = [*paths, "-m", str(tmp_path / "m.json"), "--json", "-o", outputs["narrow.json"]]
    arguments += ["--report", outputs["page.html"], "--corrected", outputs["soc.csv"]]
    monkeypatch.setattr(sys, "argv", ["cangauge", "judge", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    result = json.loads(capsys.readouterr().out)
    assert result["schema"] == 2
    assert result["now"].keys() == {"error_pct", "sigma_pct", "verdict"}
    (piece,) = result["pieces"]
    assert piece.keys() >= {"from_s", "until_s", "error_pct", "sigma_pct"}
    assert piece["error_pct"] == result["now"]["error_pct"]
    assert result["text"].splitlines()[-1] == result["next_step"]
    rows = (tmp_path / "soc.csv").read_text().splitlines()
    assert rows[0] == "log,time_s,published_pct,corrected_pct,corrected_std_pct"
    assert len(rows) == 1 + len(logs[0]) + len(logs[1])
    assert result["text"].splitlines()[0] in (tmp_path / "page.html").read_text()
    narrow = cangauge.Model.load(tmp_path / "narrow.json")
    assert narrow.capacity_ah == model.capacity_ah


@pytest.mark.parametrize("lack_pct", [0.0, 8.0, 14.0])
def test_a_weak_cell_is_named_and_the_pack_is_as_empty_as_it(pack: Pack, lack_pct: float) -> None:
    model, logs = pack
    rng = np.random.default_rng(1)
    lack, balance = rng.normal(0.0, 0.5, (2, 12))
    lack[7] = lack_pct
    curve, cells = model.voltage_model().pseudo_ocv, []
    for log in logs[:2]:
        theirs = 100.0 + balance - (100.0 - log.soc_pct[:, None]) / (1.0 - lack / 100.0)
        change = curve(theirs.ravel()).reshape(theirs.shape) - curve(log.soc_pct)[:, None]
        volts = (log.voltage_v[:, None] + change) / 12.0
        cells.append(CellColumns(1, volts + rng.normal(0.0, 0.002, volts.shape)))
    judgement = cangauge.judge(logs[:2], model, cell_voltages=cells)
    if not lack_pct:
        assert names(judgement) == []
        return
    assert names(judgement) == ["weak_cell"]
    assert judgement.faults[0].cell == 8
    assert "cell 8 lacks" in judgement.text
    low, high = judgement.faults[0].interval
    assert low < lack_pct < high
    behind = lack_pct * (100.0 - logs[1].soc_pct[-1]) / (100.0 - lack_pct)
    assert judgement.error_pct == pytest.approx(behind, abs=3.0 * judgement.error_std_pct)


def test_cell_voltages_stay_with_their_logs(pack: Pack) -> None:
    model, logs = pack
    dated, cells = [], []
    for day, log in enumerate(logs[:2]):
        dated.append(replace(log, time_s=log.time_s + 1.7e9 + 86400.0 * day))
        lack = np.r_[12.0, np.zeros(11)] / 100.0
        theirs = 100.0 - (100.0 - log.soc_pct[:, None]) / (1.0 - lack)
        curve = model.voltage_model().pseudo_ocv
        change = curve(theirs.ravel()).reshape(theirs.shape) - curve(log.soc_pct)[:, None]
        cells.append(CellColumns(1, (log.voltage_v[:, None] + change) / 12.0))
    found = cangauge.judge(dated, model, cell_voltages=cells).to_dict()
    turned = cangauge.judge(dated[::-1], model, cell_voltages=cells[::-1]).to_dict()
    assert found["faults"][0]["fault"] == "weak_cell"
    assert turned == found


def test_a_weak_cell_is_not_read_below_its_empty(pack: Pack) -> None:
    model, _ = pack
    rng = np.random.default_rng(2)
    time_s, soc = np.arange(0.0, 12000.0, 30.0), np.linspace(100.0, 0.0, 400)
    amps = np.full(soc.size, 36.0 * model.capacity_ah / 120.0)
    log = cangauge.Log(time_s, amps, np.full(soc.size, 300.0), np.full(soc.size, 20.0), soc_pct=soc)
    log = replace(log, voltage_v=model.predict(log).voltage_v)
    curve = model.voltage_model().pseudo_ocv
    lack = np.r_[18.0, rng.normal(0.0, 0.5, 11)]
    theirs = np.maximum(100.0 - (100.0 - soc[:, None]) / (1.0 - lack / 100.0), -5.0)
    change = curve(theirs.ravel()).reshape(theirs.shape) - curve(soc)[:, None]
    volts = (log.voltage_v[:, None] + change) / 12.0 + rng.normal(0.0, 0.002, theirs.shape)
    (found,) = cangauge.judge([log], model, cell_voltages=[CellColumns(1, volts)]).faults
    assert (found.name, found.cell) == ("weak_cell", 1)
    assert abs(found.size - 18.0) < 2.0 * found.std


def test_the_gauges_own_count_gives_the_capacity(pack: Pack) -> None:
    model, logs = pack
    judgement = cangauge.judge(logs[:1], chemistry="oxide", cells=96)
    assert judgement.model.capacity_ah == pytest.approx(model.capacity_ah, rel=1e-3)
    level = replace(logs[0], soc_pct=np.full(len(logs[0]), 50.0))
    with pytest.raises(cangauge.InputError, match="moves by 5 %"):
        cangauge.judge([level], chemistry="oxide", cells=96)
    charges = replace(logs[0], current_a=-logs[0].current_a)
    with pytest.raises(cangauge.InputError, match="the SoC rises as charge is drawn"):
        cangauge.judge([charges], chemistry="oxide", cells=96)


def test_logs_that_show_nothing_are_refused(pack: Pack) -> None:
    model, (log, *_) = pack
    with pytest.raises(cangauge.InputError, match="publishes"):
        cangauge.judge([replace(log, soc_pct=None)], model)
    with pytest.raises(cangauge.InputError, match="at least 4 minutes"):
        cangauge.judge([log.rows(log.time_s < log.time_s[0] + 239.0)], model)
    with pytest.raises(cangauge.InputError, match="neither a model"):
        cangauge.judge([log], cells=96)
    with pytest.raises(cangauge.InputError, match="count twice"):
        cangauge.judge([log, log], model)


@pytest.mark.parametrize(("chemistry", "cells"), [("lfp", 97), ("oxide", 130), ("oxide", 75)])
def test_a_pack_of_other_cells_is_refused_without_a_model(pack: Pack, chemistry, cells) -> None:
    _, logs = pack
    with pytest.raises(cangauge.InputError, match="V per cell") as refused:
        cangauge.judge(logs[:2], chemistry=chemistry, cells=cells)
    assert "check --chemistry and --cells" in str(refused.value)


def full_charge(error_pct: float, sensor_a: float = 0.0) -> cangauge.Log:
    """Return a charge of 16 LFP cells until full, then an hour at constant voltage."""
    model = cangauge.Model.prior("lfp", 16, 100.0)
    time_s = np.arange(0.0, 12600.0, 5.0)
    amps = np.where(time_s < 3600.0, -33.0, -33.0 * np.exp(-(time_s - 3600.0) / 900.0))
    log = cangauge.Log(time_s, amps, np.full(time_s.size, 50.0), np.full(time_s.size, 25.0))
    soc = 100.0 - drawn_ah(log) + drawn_ah(log)[-1]
    volts = model.predict(log, initial_soc_pct=float(soc[0])).voltage_v
    held = np.where(time_s < 3600.0, np.minimum(volts, 55.9), 56.0)
    return replace(log, voltage_v=held, soc_pct=soc + error_pct, current_a=amps + sensor_a)


@pytest.mark.parametrize(("error_pct", "verdict"), [(-0.5, "agrees"), (-12.0, "off")])
@pytest.mark.parametrize("sensor_a", [0.0, 0.3])
def test_the_end_of_a_full_charge_settles_an_lfp_pack(
    error_pct: float, verdict: str, sensor_a: float
) -> None:
    log = full_charge(error_pct, sensor_a)
    judgement = cangauge.judge([log], chemistry="lfp", cells=16, capacity_ah=100.0)
    assert judgement.verdict == verdict
    assert judgement.error_pct == pytest.approx(error_pct, abs=4.0)


def test_the_flat_part_of_an_lfp_pack_cannot_be_told() -> None:
    log = full_charge(0.0)
    drive = log.rows(log.time_s < 2400.0)
    judgement = cangauge.judge([drive], chemistry="lfp", cells=16, capacity_ah=100.0)
    assert judgement.verdict == "cannot_tell"
    assert "one full charge" in judgement.next_step


def test_a_charge_in_a_pause_of_a_log_needs_not_be_known(pack: Pack) -> None:
    model, logs = pack
    columns = ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct")
    later = replace(logs[2], time_s=logs[2].time_s - logs[2].time_s[0] + logs[1].time_s[-1] + 700.0)
    both = {name: np.r_[getattr(logs[1], name), getattr(later, name)] for name in columns}
    log = cangauge.Log(**both)
    assert abs(logs[2].soc_pct[0] - logs[1].soc_pct[-1]) > 10.0
    judgement = cangauge.judge([log], model)
    assert judgement.verdict == "agrees"
    error = judgement.corrected_pct[0] - log.soc_pct
    assert np.max(np.abs(error) / judgement.corrected_std_pct[0]) < 3.0


def test_days_are_sorted_by_their_stamps(pack: Pack) -> None:
    model, logs = pack
    dated = [
        replace(log, time_s=log.time_s + 1.7e9 - 86400.0 * day) for day, log in enumerate(logs)
    ]
    judgement = cangauge.judge(dated[::-1], model)
    assert [log.time_s[0] for log in judgement.logs] == sorted(log.time_s[0] for log in dated)


def test_a_log_of_days_is_as_one_for_each_day() -> None:
    step_s, days = 120.0, 3
    hours = np.arange(0.0, 24.0 * days, step_s / 3600.0)
    amps = 14.0 * np.sin(2.0 * np.pi * hours / 24.0)
    log = cangauge.Log(3600.0 * hours, amps, np.full(hours.size, 53.0), np.full(hours.size, 20.0))
    model = cangauge.Model.prior("lfp", 16, 100.0)
    volts = model.predict(log, initial_soc_pct=96.0).voltage_v
    log = replace(log, voltage_v=volts, soc_pct=96.0 - drawn_ah(log))
    one = cangauge.judge([log], chemistry="lfp", cells=16, capacity_ah=100.0)
    for soc, true in zip(one.corrected_pct, [log.soc_pct], strict=True):
        at_joint = np.flatnonzero(np.diff(log.time_s // 86400.0) > 0.0)
        assert np.diff(soc - true)[at_joint] == pytest.approx(0.0, abs=0.5)


def case(name: str, tmp_path: Path) -> dict[str, Path]:
    """Return the files of a shared case, unpacked."""
    if not (CASES / name).is_dir():
        pytest.skip(f"{name}: not there")
    for packed in (CASES / name).glob("*.gz"):
        (tmp_path / packed.stem).write_bytes(gzip.decompress(packed.read_bytes()))
    return {path.name: path for path in tmp_path.iterdir()}


@pytest.mark.parametrize("days", [["R_d2.csv"], ["R_d1.csv", "R_d2.csv", "R_d3.csv"]])
def test_a_gauge_that_repaired_itself_is_right(days: list[str], tmp_path: Path) -> None:
    files = case("reset-mid-log", tmp_path)
    judgement = cangauge.judge([files[day] for day in days], files["nmc.json"])
    assert judgement.verdict == "agrees"
    assert judgement.pieces[0].error_pct == pytest.approx(-12.0, abs=2.0)
    assert "too low until 40.0 min into R_d2, when it set itself" in judgement.text


def test_a_wrong_divisor_is_a_scale_and_no_start(tmp_path: Path) -> None:
    files = case("soc-wrong-divisor", tmp_path) | case("reset-mid-log", tmp_path)
    judgement = cangauge.judge([files["log.csv"]], files["nmc.json"])
    assert names(judgement) == ["count_scale"]
    assert judgement.faults[0].size == pytest.approx(12.5, abs=1.0)
    assert judgement.error_pct == pytest.approx(5.4, abs=2.0)
    assert "published up to 109.1 %" in judgement.text


def test_full_charges_are_seen_whatever_the_sensor_reads(tmp_path: Path) -> None:
    files = case("full-without-taper", tmp_path)
    days = [files[f"d{number}.csv"] for number in range(1, 5)]
    judgement = cangauge.judge(days, chemistry="lfp", cells=16, capacity_ah=280.0)
    assert (judgement.verdict, names(judgement)) == ("off", ["current_offset"])
    assert judgement.faults[0].size == pytest.approx(0.3, abs=0.1)
    assert judgement.error_pct == pytest.approx(-10.3, abs=2.0)


def test_a_current_that_wraps_is_refused(pack: Pack) -> None:
    model, logs = pack
    wrapped = np.where(logs[0].current_a > 0.0, 655.36 - logs[0].current_a, -logs[0].current_a)
    with pytest.raises(cangauge.InputError, match="charge and SoC contradict each other"):
        cangauge.judge([replace(logs[0], current_a=wrapped)], model)


@pytest.mark.parametrize("seed", [1, 3, 4, 5])
def test_the_last_digit_does_not_move_the_answer(pack: Pack, seed: int) -> None:
    model, _ = pack
    rng = np.random.default_rng(seed)
    time_s, minute = np.arange(0.0, 900.0), np.arange(900) // 60
    amps = np.full(900, model.capacity_ah / rng.uniform(2.0, 6.0))
    volts = float(model.voltage_model().pseudo_ocv([rng.uniform(3.0, 60.0)])[0])
    volts *= 1.0 + rng.uniform(0.003, 0.02) * rng.choice([-1.0, 1.0], 15)[minute]
    log = cangauge.Log(time_s, amps, volts, np.full(900, 25.0))
    shown = rng.uniform(20.0, 100.0) - rng.uniform(0.5, 2.0) * 100.0 * drawn_ah(log) / (
        model.capacity_ah
    )
    log = replace(log, soc_pct=shown)
    answers = []
    for shift_v in (0.0, 1e-9, -1e-9):
        try:
            answers.append(cangauge.judge([replace(log, voltage_v=volts + shift_v)], model))
        except InputError:  # the log contradicts itself
            continue
    assert len(answers) in (0, 3)
    for each in answers[1:]:
        apart_pct = each.error_pct - answers[0].error_pct
        assert abs(apart_pct) < 0.1 * answers[0].error_std_pct


def test_a_fault_whose_probability_is_zero_is_left_out(pack: Pack) -> None:
    model, logs = pack
    # The gauge counts 1.9 times the charge: some sets of faults are less probable than any double.
    counts = [
        replace(log, soc_pct=log.soc_pct[0] + 1.9 * (log.soc_pct - log.soc_pct[0])) for log in logs
    ]
    judgement = cangauge.judge(counts, model)
    assert min(fit.share for fit in judgement.fits) == 0.0
    assert judgement.verdict == "off"


def linearised(pack: Pack, monkeypatch, *stds: float) -> Linearised:
    """Return the model of a log whose only faults are offsets of the current, of one shape."""
    seen = []
    monkeypatch.setattr(
        "cangauge.extras.judge.judgement.explain",
        lambda *given: seen.append(given) or explain.explain(*given),
    )
    cangauge.judge(pack[1][:1], pack[0])
    terms = Terms(*seen[0])
    offset = next(each for each in terms.columns if each.fault == "current_offset")
    alike = [replace(offset, std=std) for std in stds]
    monkeypatch.setattr("cangauge.extras.judge.linearised.faults", lambda _: alike)
    terms = Terms(*seen[0])
    return Linearised(terms, np.zeros(len(terms.columns)))


def test_what_no_log_tells_apart_keeps_its_prior(pack: Pack, monkeypatch) -> None:
    at = linearised(pack, monkeypatch, 1e4, 1e4)
    covariance = at.fitted([0, 1], 0).posterior.covariance[:2, :2]
    assert np.array([1, -1]) @ covariance @ np.array([1, -1]) == pytest.approx(2e8, rel=1e-3)


def test_a_set_of_all_faults_has_a_weight(pack: Pack, monkeypatch) -> None:
    found = linearised(pack, monkeypatch, 1.0).neighbourhood(frozenset([0]))
    assert set(found) == {frozenset(), frozenset([0])}


def unbroken(days: int, every_h: float = 1.0 / 15.0) -> cangauge.Log:
    """Return one log of days of a home storage."""
    hours = np.arange(0.0, 24.0 * days, every_h)
    amps = 14.0 * np.sin(2.0 * np.pi * hours / 24.0)
    log = cangauge.Log(3600.0 * hours, amps, np.full(hours.size, 53.0), np.full(hours.size, 20.0))
    volts = cangauge.Model.prior("lfp", 16, 100.0).predict(log, initial_soc_pct=96.0).voltage_v
    return replace(log, voltage_v=volts, soc_pct=97.0 - drawn_ah(log))


def cpu_s(days: int) -> float:
    """Return the least time of two judgements of daily logs."""
    log = unbroken(days, every_h=0.2)
    day = log.time_s // 86400.0
    logs = [log.rows(day == k) for k in range(days)]
    times = []
    for _ in range(2):
        begun_s = time.thread_time()
        cangauge.judge(logs, chemistry="lfp", cells=16, capacity_ah=100.0)
        times.append(time.thread_time() - begun_s)
    return min(times)


def test_time_grows_with_the_number_of_logs() -> None:
    cpu_s(2)  # what is loaded once
    assert cpu_s(40) < 3.0 * cpu_s(20)


def peak_bytes(log: cangauge.Log) -> int:
    tracemalloc.start()
    try:
        cangauge.judge([log], chemistry="lfp", cells=16, capacity_ah=100.0)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_grows_with_the_rows() -> None:
    peak_bytes(unbroken(days=2))  # what is loaded once
    assert peak_bytes(unbroken(days=40)) < 5.0 * peak_bytes(unbroken(days=10))


def test_a_model_without_errors_of_its_curve_cannot_be_narrowed(pack: Pack) -> None:
    judgement = cangauge.judge(pack[1][:1], leaf_2012_model_file())
    with pytest.raises(InputError, match="no error of its curve that logs could narrow"):
        narrowed(judgement)
