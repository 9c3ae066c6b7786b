"""The second opinion on simulated days of one pack."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cangauge
from cangauge.__main__ import main
from cangauge.extras.judge.causes import signatures_of
from cangauge.extras.judge.chain import ERROR, FUNCTIONS, OFFSET, Chain
from cangauge.extras.judge.judgement import Judgement
from cangauge.logs.canonical import write_table
from cangauge.logs.read import CellColumns

DAYS = 5
CAPACITY_AH = 60.0


def drawn_ah(log: cangauge.Log) -> np.ndarray:
    steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s)
    return np.concatenate(([0.0], np.cumsum(steps))) / 3600.0


@pytest.fixture(scope="module")
def pack() -> tuple[cangauge.Model, list[cangauge.Log]]:
    """Model and healthy days of a simulated pack."""
    runs = [cangauge.simulate(seed=3, drive=k, hours=0.5, ambient_c=20.0) for k in range(1, 10)]
    logs = [replace(run.log, soc_pct=run.recording.true_soc_pct) for run in runs]
    capacity_ah = runs[0].plant.pack.capacity_ah
    model = cangauge.fit(logs[:4], capacity_ah=capacity_ah, chemistry="oxide").model
    return model, logs[4:]


def with_offset(logs: Sequence[cangauge.Log], model: cangauge.Model, offset_a: float, first: int):
    """Return the logs of a gauge that counts an offset from log `first` on."""
    hours, changed = 0.0, []
    for number, log in enumerate(logs):
        elapsed = (log.time_s - log.time_s[0]) / 3600.0
        error = 100.0 * offset_a * (hours + elapsed) / model.capacity_ah
        if number >= first:
            hours += elapsed[-1]
            log = replace(log, soc_pct=log.soc_pct - error)  # noqa: PLW2901
        changed.append(log)
    return changed


def test_a_right_gauge_agrees(pack) -> None:
    model, logs = pack
    judgement = cangauge.judge(logs, model)
    assert judgement.verdict == "agrees"
    assert judgement.cause.verdict == "none"
    assert abs(judgement.error_pct) < 3.0 * judgement.error_std_pct


def test_an_offset_is_named_with_size_and_moment(pack) -> None:
    model, logs = pack
    offset_a = model.capacity_ah / 25.0
    judgement = cangauge.judge(with_offset(logs, model, offset_a, 2), model)
    assert judgement.verdict == "off"
    assert judgement.cause.verdict == "current_offset"
    assert judgement.cause.size is not None
    low, high = judgement.cause.size.ci
    assert low < offset_a < high
    assert judgement.since_s == pytest.approx(sum(log.duration_s for log in logs[:2]), abs=120.0)


def test_an_offset_that_goes_on_has_grown_by_the_next_log() -> None:
    hours, starts = np.array([1.0, 2.0, 1.0]), np.full(3, 80.0)
    sensor, *_ = signatures_of("current_offset", hours, starts, FUNCTIONS + 1, 50.0)
    assert sensor.columns[:, OFFSET].tolist() == [1.0, 1.0, 1.0]
    assert sensor.columns[:, ERROR].tolist() == [0.0, -2.0, -6.0]


@pytest.mark.parametrize(
    ("cause", "size", "change"),
    [
        ("voltage_sensor", 2.0, lambda log: {"voltage_v": 1.02 * log.voltage_v}),
        (
            "count_scale",
            10.0,
            lambda log: {"soc_pct": counting(log, 1.1).soc_pct},
        ),
    ],
)
def test_other_causes_are_named(pack, cause: str, size: float, change) -> None:
    model, logs = pack
    judgement = cangauge.judge([replace(log, **change(log)) for log in logs], model)
    assert (judgement.verdict, judgement.cause.verdict) == ("off", cause)
    assert judgement.cause.size is not None
    assert judgement.cause.size.value == pytest.approx(size, rel=0.3)


def test_an_offset_of_the_sensor_is_taken_out_of_the_corrected_soc(pack) -> None:
    model, logs = pack
    offset_a = model.capacity_ah / 12.0
    read = [
        replace(log, current_a=log.current_a + offset_a)
        for log in with_offset(logs, model, offset_a, 0)
    ]
    judgement = cangauge.judge(read, model)
    assert (judgement.cause.verdict, judgement.since_s) == ("current_offset", 0.0)
    assert judgement.cause.size is not None
    assert judgement.cause.size.value == pytest.approx(offset_a, rel=0.3)
    for log, soc in zip(logs, judgement.corrected_pct, strict=True):
        known = np.isfinite(soc)
        moved, truly = np.diff(soc[known][[0, -1]]), np.diff(log.soc_pct[known][[0, -1]])
        assert moved == pytest.approx(truly, abs=1.5)  # the count alone: 4 % off


def test_parked_days_may_be_alike_but_no_drives(pack) -> None:
    model, logs = pack
    still = (np.arange(900.0), np.zeros(900), np.full(900, logs[-1].voltage_v[-1]))
    parked = cangauge.Log(*still, np.full(900, 20.0), soc_pct=np.full(900, logs[-1].soc_pct[-1]))
    assert len(cangauge.judge([*logs, parked, parked], model).logs) == len(logs) + 2
    with pytest.raises(cangauge.InputError, match="same rows"):
        cangauge.judge([logs[0], logs[0]], model)


def counting(log: cangauge.Log, scale: float) -> cangauge.Log:
    """Return the log of a gauge that counts too much from its start on."""
    return replace(log, soc_pct=log.soc_pct[0] + scale * (log.soc_pct - log.soc_pct[0]))


def test_a_right_gauge_of_an_aged_pack_agrees_and_the_pack_has_its_capacity(pack) -> None:
    model, logs = pack
    judgement = cangauge.judge(logs, model, capacity_ah=1.12 * model.capacity_ah)
    assert (judgement.verdict, judgement.cause.verdict) == ("agrees", "model_capacity")
    assert abs(judgement.error_pct) < 3.0 * judgement.error_std_pct
    assert judgement.pack_ah == pytest.approx(model.capacity_ah, rel=0.02)
    assert "Ah, as the gauge counts; the model has" in judgement.headline
    assert f"--capacity-ah {judgement.pack_ah:.1f}" in judgement.next_step


def test_a_pack_that_aged_a_little_may_be_a_wrong_scale(pack) -> None:
    model, logs = pack
    judgement = cangauge.judge(logs, model, capacity_ah=1.08 * model.capacity_ah)
    assert (judgement.verdict, judgement.cause.verdict) == ("cannot_tell", "unknown")
    assert judgement.probabilities["none"] < 0.05 < judgement.probabilities["model_capacity"]
    assert "either it is wrong, or it is right and the pack" in judgement.headline
    assert "capacity" in judgement.next_step


def test_a_wrong_start_is_named_and_the_corrected_soc_follows_the_truth(pack) -> None:
    model, logs = pack
    judgement = cangauge.judge([replace(log, soc_pct=log.soc_pct - 12.0) for log in logs], model)
    assert (judgement.verdict, judgement.cause.verdict) == ("off", "start_or_reset")
    for log, soc, std in zip(
        logs, judgement.corrected_pct, judgement.corrected_std_pct, strict=True
    ):
        known = np.isfinite(soc)
        assert known.mean() > 0.9
        assert np.max(np.abs(soc - log.soc_pct)[known] / std[known]) < 3.0


def test_day_one_without_a_model_cannot_tell_a_small_error(pack) -> None:
    model, logs = pack
    cells = round(float(logs[0].voltage_v.mean()) / 3.7)
    short = logs[0].rows(logs[0].time_s < logs[0].time_s[0] + 900.0)
    judgement = cangauge.judge(
        [short], chemistry="oxide", cells=cells, capacity_ah=model.capacity_ah
    )
    assert judgement.verdict == "cannot_tell"


def test_without_a_model_the_stated_std_contains_the_free_zero(pack) -> None:
    model, logs = pack
    cells = round(float(logs[0].voltage_v.mean()) / 3.7)
    high = [replace(log, soc_pct=log.soc_pct + 6.0) for log in logs]
    judgement = cangauge.judge(high, chemistry="oxide", cells=cells, capacity_ah=model.capacity_ah)
    assert judgement.error_pct > 6.0
    assert judgement.error_std_pct > 5.0
    assert np.nanmin(judgement.corrected_std_pct[-1]) > 5.0
    assert (judgement.verdict, judgement.cause.verdict) == ("cannot_tell", "none")
    assert "do not settle" in judgement.headline
    assert judgement.next_step.endswith("that needs a model (-m).")


def test_a_jump_is_listed_with_its_size(pack) -> None:
    model, logs = pack
    soc = logs[1].soc_pct.copy()
    middle = len(soc) // 2
    soc[middle:] += 6.0
    judgement = cangauge.judge([logs[0], replace(logs[1], soc_pct=soc), *logs[2:3]], model)
    (jump,) = judgement.jumps
    assert (jump.log, round(jump.size_pct)) == (1, 6)
    at_s = logs[0].duration_s + logs[1].time_s[middle] - logs[1].time_s[0]
    assert jump.since_start_s == pytest.approx(at_s, abs=60.0)
    later = [replace(log, soc_pct=log.soc_pct + 6.0) for log in logs[2:]]
    judgement = cangauge.judge([logs[0], replace(logs[1], soc_pct=soc), *later], model)
    assert (judgement.verdict, judgement.cause.verdict) == ("off", "start_or_reset")
    assert judgement.since_s == pytest.approx(at_s, abs=60.0)
    assert f"min into {logs[1].name}" in judgement.since


@pytest.mark.parametrize("step_pct", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("place", [0.5, 0.95])
def test_sentence_and_table_state_the_moment_of_a_jump(pack, step_pct: float, place: float) -> None:
    model, logs = pack
    named = [replace(log, name=f"day{number}") for number, log in enumerate(logs)]
    changed = []
    for number, log in enumerate(named):
        late = np.arange(len(log)) >= place * len(log)
        error = -10.0 * (late if number == 3 else number > 3)
        changed.append(replace(log, soc_pct=np.round((log.soc_pct + error) / step_pct) * step_pct))
    judgement = cangauge.judge(changed, model)
    assert judgement.cause.verdict == "start_or_reset"
    (jump,) = judgement.jumps
    assert jump.size_pct == pytest.approx(-10.0, abs=1.0)
    after_s = place * named[3].duration_s
    assert jump.time_s - named[3].time_s[0] == pytest.approx(after_s, abs=60.0)
    _, [[moment, _]] = judgement.jump_rows()
    assert moment.endswith("min into day3")
    assert judgement.since.startswith(f"since {moment}")


def test_command_prints_schema_1_and_writes_all_files(
    pack, tmp_path: Path, capsys, monkeypatch
) -> None:
    model, logs = pack
    paths = []
    for number, log in enumerate(logs[:2]):
        paths.append(str(tmp_path / f"day{number}.csv"))
        names = ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct")
        write_table({name: getattr(log, name) for name in names}, paths[-1])
    model.save(tmp_path / "m.json")
    outputs = {name: str(tmp_path / name) for name in ("page.html", "soc.csv", "narrow.json")}
    arguments = [*paths, "-m", str(tmp_path / "m.json"), "--json", "-o", outputs["narrow.json"]]
    arguments += ["--report", outputs["page.html"], "--corrected", outputs["soc.csv"]]
    monkeypatch.setattr(sys, "argv", ["cangauge", "judge", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    result = json.loads(capsys.readouterr().out)
    assert result.keys() == {"schema", "gauge", "cause", "next_step", "days", "corrected"}
    assert result["gauge"].keys() == {
        "error_pct", "error_std_pct", "verdict", "since_s", "worst_pct", "jumps",
    }  # fmt: skip
    assert result["cause"].keys() == {"verdict", "probability", "size"}
    assert result["days"] == 2
    rows = (tmp_path / "soc.csv").read_text().splitlines()
    assert rows[0] == "log,time_s,published_pct,corrected_pct,corrected_std_pct"
    assert len(rows) == 1 + len(logs[0]) + len(logs[1])
    assert "Second opinion" in (tmp_path / "page.html").read_text()
    narrow = cangauge.Model.load(tmp_path / "narrow.json")
    assert narrow.capacity_ah == model.capacity_ah


def with_cells(log: cangauge.Log, model: cangauge.Model, weak: int, lack_pct: float) -> CellColumns:
    """Return the voltages of 12 cells, of which one lacks capacity; the others differ by 0.5 %."""
    rng = np.random.default_rng(1)
    lack = rng.normal(0.0, 0.5, 12)
    balance = rng.normal(0.0, 0.5, 12)
    lack[weak] = lack_pct
    slope = model.voltage_model().pseudo_ocv_slope(log.soc_pct)[:, None] / 12.0
    moved = balance + lack * (log.soc_pct[:, None] - 100.0) / 100.0
    noise = rng.normal(0.0, 0.002, moved.shape)
    return CellColumns(1, log.voltage_v[:, None] / 12.0 + slope * moved + noise)


@pytest.mark.parametrize(("lack_pct", "cause"), [(0.0, "none"), (10.0, "weak_cell")])
def test_a_weak_cell_is_named_with_its_number(pack, lack_pct: float, cause: str) -> None:
    model, logs = pack
    cells = [with_cells(log, model, 7, lack_pct) for log in logs[:2]]
    judgement = cangauge.judge(logs[:2], model, cell_voltages=cells)
    assert judgement.cause.verdict == cause
    if cause == "weak_cell":
        assert judgement.weakest is not None
        assert judgement.weakest.number == 8
        assert judgement.cause.size is not None
        assert judgement.cause.size.value == pytest.approx(lack_pct, abs=2.5)


def test_a_doubtful_gauge_is_not_off_and_several_faults_are_no_known_one(pack) -> None:
    model, logs = pack
    little = [replace(log, soc_pct=log.soc_pct - 3.0) for log in logs[:2]]
    judgement = cangauge.judge(little, model)
    assert 0.05 < judgement.probabilities["none"] < 0.5
    assert (judgement.verdict, judgement.cause.verdict) == ("agrees", "none")
    mixed = [
        replace(log, soc_pct=log.soc_pct + (3.0, -3.0)[day % 2]) for day, log in enumerate(logs)
    ]
    judgement = cangauge.judge(mixed, model)
    assert (judgement.verdict, judgement.cause.verdict) == ("off", "unknown")
    assert (judgement.since_s, judgement.cause.size) == (None, None)
    assert "not known" in judgement.headline


def test_the_gauges_own_count_gives_the_capacity(pack) -> None:
    model, logs = pack
    judgement = cangauge.judge(logs[:1], chemistry="oxide", cells=96)
    assert judgement.model.capacity_ah == pytest.approx(model.capacity_ah, rel=1e-3)
    level = replace(logs[0], soc_pct=np.full(len(logs[0]), 50.0))
    with pytest.raises(cangauge.InputError, match="hardly changes"):
        cangauge.judge([level], chemistry="oxide", cells=96)


def test_logs_that_show_nothing_are_refused(pack) -> None:
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
def test_a_pack_of_other_cells_is_refused_without_a_model(pack, chemistry, cells: int) -> None:
    _, logs = pack
    with pytest.raises(cangauge.InputError, match="V per cell") as refused:
        cangauge.judge(logs[:2], chemistry=chemistry, cells=cells)
    assert "check --chemistry and --cells" in str(refused.value)


def stuck(log: cangauge.Log, step_pct: float, from_row: int) -> cangauge.Log:
    """Return the log of a gauge that shows steps, and stands still from a row on."""
    shown = np.round(log.soc_pct / step_pct) * step_pct
    shown[from_row:] = shown[from_row]
    return replace(log, soc_pct=shown)


def pegged(log: cangauge.Log, at_pct: float) -> cangauge.Log:
    return replace(log, soc_pct=np.full(len(log), at_pct))


@pytest.mark.parametrize(
    ("change", "last"),
    [
        (lambda logs: [stuck(logs[3], 1.0, 0)], 3),
        (lambda logs: [stuck(log, 1.0, 0) for log in logs], 4),
        (lambda logs: [*logs[:4], stuck(logs[4], 1.0, 0)], 4),
        (lambda logs: [*logs[:4], stuck(logs[4], 1.0, len(logs[4]) // 3)], 4),
        (lambda logs: [stuck(logs[1], 0.1, len(logs[1]) // 3)], 1),
        (lambda logs: [*logs[:4], stuck(logs[4], 0.1, len(logs[4]) // 3)], 4),
        (lambda logs: [stuck(logs[0], 1.0, 0), *logs[1:]], 4),
        (lambda logs: [pegged(logs[4], 100.0)], 4),
    ],
    ids=["one", "all", "last", "part", "fine", "fine last", "first", "full"],
)
def test_a_stuck_gauge_does_not_agree(pack, change, last: int) -> None:
    model, logs = pack
    changed = change(logs)
    judgement = cangauge.judge(changed, model)
    assert (judgement.verdict, judgement.cause.verdict) == ("off", "unknown")
    assert "stands at" in judgement.headline
    assert "stands still" in judgement.next_step
    at_end = changed[-1].soc_pct[-1] - logs[last].soc_pct[-1]
    assert judgement.error_pct == pytest.approx(at_end, abs=3.0)
    assert sum(judgement.probabilities.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("empty_from", [0.0, 0.8])
def test_a_gauge_that_shows_empty_is_compared_at_the_end(pack, empty_from: float) -> None:
    model, logs = pack
    log = logs[4]
    late = np.arange(len(log)) >= empty_from * len(log)
    soc = np.where(late, 0.0, np.round(log.soc_pct))
    judgement = cangauge.judge([*logs[:4], replace(log, soc_pct=soc)], model)
    assert judgement.verdict == "off"
    assert judgement.error_pct == pytest.approx(-log.soc_pct[-1], abs=3.0)
    assert judgement.stands == ""  # the charge flows towards the limit


def agrees_beyond_its_std(judgement: Judgement) -> list[float]:
    """Return errors at the ends of logs that are surely above 5 % although the gauge agrees."""
    if judgement.verdict != "agrees":
        return []
    ends = [
        (log.soc_pct[-1] - soc[-1], std[-1])
        for log, soc, std in zip(
            judgement.logs, judgement.corrected_pct, judgement.corrected_std_pct, strict=True
        )
    ]
    return [error for error, std in ends if abs(error) > 5.3 + 1.645 * std]


@pytest.mark.parametrize("step_pct", [0.1, 1.0])
@pytest.mark.parametrize("size_pct", [4.0, 8.0, 16.0])
def test_no_gauge_agrees_beside_an_error_that_its_std_excludes(
    pack, step_pct: float, size_pct: float
) -> None:
    model, logs = pack

    def bent(log: cangauge.Log, error_pct: np.ndarray) -> cangauge.Log:
        soc = np.round((log.soc_pct + error_pct) / step_pct) * step_pct
        return replace(log, soc_pct=np.clip(soc, 0.0, 100.0))

    log = logs[3]
    part = np.linspace(0.0, 1.0, len(log))
    shapes = [size_pct * (part > 0.95), size_pct * part**4, -size_pct * np.clip(3 * part - 2, 0, 1)]
    for shape in shapes:
        for chain in ([bent(log, shape)], [*logs[1:3], bent(log, shape), logs[4]]):
            assert agrees_beyond_its_std(cangauge.judge(chain, model)) == []


def test_a_coarse_soc_counts_at_its_changes_and_not_at_its_limits(pack) -> None:
    model, (log, *_) = pack
    shown = np.minimum(np.round(log.soc_pct), np.round(log.soc_pct[0]) - 2.0)
    shift = 100.0 - shown.max()
    (part,) = Chain.of([replace(log, soc_pct=shown + shift)], model).stretches
    known = np.isfinite(part.published_pct)
    truth = np.interp(part.time_s, log.time_s, log.soc_pct) + shift
    assert 3 <= known.sum() < known.size / 2
    assert part.published_pct[known][1:-1] == pytest.approx(truth[known][1:-1], abs=0.3)
    assert part.published_pct[-1] == pytest.approx(truth[-1], abs=0.5)  # the last row
    (part,) = Chain.of([stuck(log, 1.0, 0)], model).stretches
    assert np.isfinite(part.published_pct[[0, -1]]).all()
    known = np.isfinite(part.published_pct)
    assert known.sum() == pytest.approx(2 + part.held_pct // 2.0, abs=1.0)  # each two steps
    full = np.minimum(log.soc_pct - log.soc_pct[0] + 102.0, 100.0)
    (part,) = Chain.of([replace(log, soc_pct=full)], model).stretches
    assert np.isnan(part.published_pct[0])
    assert np.isfinite(part.published_pct[-1])


def test_a_pause_parts_a_log_and_days_without_dates_follow_one_another(pack) -> None:
    model, logs = pack
    late = replace(logs[1], time_s=logs[1].time_s + 700.0 * (logs[1].time_s > 900.0))
    assert [part.log for part in Chain.of([logs[0], late], model).stretches] == [0, 1, 1]
    dated = [
        replace(log, time_s=log.time_s + 1.7e9 - 86400.0 * day)
        for day, log in enumerate(with_offset(logs, model, model.capacity_ah / 25.0, 2))
    ]
    judgement = cangauge.judge(dated[::-1], model)
    assert [log.time_s[0] for log in judgement.logs] == sorted(log.time_s[0] for log in dated)
    assert judgement.days == len(dated)


def full_charge(error_pct: float) -> cangauge.Log:
    """Return a charge of 16 LFP cells until full, and the SoC of a gauge that reads wrong."""
    model = cangauge.Model.prior("lfp", 16, 100.0)
    time_s = np.arange(0.0, 9000.0, 5.0)
    amps = np.where(time_s < 3600.0, -33.0, -33.0 * np.exp(-(time_s - 3600.0) / 900.0))
    log = cangauge.Log(time_s, amps, np.full(time_s.size, 50.0), np.full(time_s.size, 25.0))
    soc = 100.0 - drawn_ah(log) + drawn_ah(log)[-1]
    volts = model.predict(log, initial_soc_pct=float(soc[0])).voltage_v
    held = np.where(time_s < 3600.0, np.minimum(volts, 55.9), 56.0)
    return replace(log, voltage_v=held, soc_pct=soc + error_pct)


@pytest.mark.parametrize(("error_pct", "verdict"), [(-0.5, "agrees"), (-12.0, "off")])
def test_the_end_of_a_full_charge_settles_an_lfp_pack(error_pct: float, verdict: str) -> None:
    judgement = cangauge.judge(
        [full_charge(error_pct)], chemistry="lfp", cells=16, capacity_ah=100.0
    )
    assert judgement.verdict == verdict
    assert judgement.error_pct == pytest.approx(error_pct, abs=4.0)


def test_the_flat_part_of_an_lfp_pack_cannot_be_told() -> None:
    log = full_charge(0.0)
    drive = log.rows(log.time_s < 2400.0)
    judgement = cangauge.judge([drive], chemistry="lfp", cells=16, capacity_ah=100.0)
    assert judgement.verdict == "cannot_tell"
    assert "LFP" in judgement.next_step


def lfp_drives(shown_pct) -> list[cangauge.Log]:
    """Return four hours of even load on the flat part of 16 LFP cells, by what a gauge shows."""
    model = cangauge.Model.prior("lfp", 16, 100.0)
    logs = []
    for day in range(4):
        time_s = np.arange(0.0, 3600.0, 5.0)
        amps = 12.0 + 8.0 * np.sin(time_s / 100.0)
        log = cangauge.Log(time_s, amps, np.full(time_s.size, 52.0), np.full(time_s.size, 25.0))
        soc = 75.0 - 2.0 * day - drawn_ah(log)
        volts = model.predict(log, initial_soc_pct=float(soc[0])).voltage_v
        logs.append(replace(log, voltage_v=volts, soc_pct=shown_pct(day, time_s / 3600.0, soc)))
    return logs


def test_the_corrected_soc_is_mixed_from_all_moments_and_ways_of_a_cause() -> None:
    # The count drifts, and is right again at each start: whether it was is not in the logs.
    logs = lfp_drives(lambda _, hours, soc: soc - 2.0 * hours)
    judgement = cangauge.judge(logs, chemistry="lfp", cells=16, capacity_ah=100.0)
    assert (judgement.verdict, judgement.cause.verdict) == ("off", "current_offset")
    (answer,) = [each for each in judgement.explanations if each.name == "current_offset"]
    assert 0.05 < answer.share.max() < 0.95
    assert abs(judgement.error_pct + 2.0) < 2.0 * judgement.error_std_pct


def test_a_gauge_that_stood_still_and_jumped_back_was_not_reset() -> None:
    def shown(day: int, hours: np.ndarray, soc: np.ndarray) -> np.ndarray:
        is_held = (day == 2) & (hours > 0.3) & (hours < 0.8)
        return np.where(is_held, soc[np.searchsorted(hours, 0.3)], soc)

    judgement = cangauge.judge(lfp_drives(shown), chemistry="lfp", cells=16, capacity_ah=100.0)
    assert judgement.verdict != "off"
    assert judgement.probabilities["none"] > 0.5
    assert abs(judgement.error_pct) < 2.0 * judgement.error_std_pct
    (stand,) = judgement.chain[2].stood
    assert stand.flowed_pct == pytest.approx(6.0, abs=1.0)
    assert stand.until_s - stand.since_s == pytest.approx(1800.0, abs=60.0)
    assert "for 29.9 min from 18.0 min into" in judgement.stands


def test_dusk_is_no_full_charge_where_the_fit_has_no_knee() -> None:
    log = full_charge(0.0)
    sun = replace(log, voltage_v=np.minimum(log.voltage_v, 53.55))  # the flat part: 3.347 V a cell
    (part,) = Chain.of([log], cangauge.Model.prior("lfp", 16, 100.0)).stretches
    assert part.full.size == 1
    model = cangauge.Model.prior("lfp", 16, 100.0)
    assert model.curve is not None
    flat = model.curve.model_copy(
        update={"voltage_v": [min(v, 53.44) for v in model.curve.voltage_v]}
    )
    (part,) = Chain.of([sun], model.model_copy(update={"curve": flat})).stretches
    assert part.full.size == 0
