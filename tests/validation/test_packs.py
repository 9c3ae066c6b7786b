"""The estimator's bench on a small simulated pack, and on a recorded one where it is present."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cangauge.cli.app import main
from cangauge.errors import InputError
from cangauge.estimation.offline import EstimateTable
from cangauge.extras.validation import packs, packs_quantities, packs_run
from cangauge.extras.validation.packs_quantities import Quantity, QuantityRow, pool_quantities
from cangauge.extras.validation.packs_score import Bench, LogScore, Row, pool_scores, score_log
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import counted_soc_pct
from cangauge.model.published import CAPACITY_AH
from cangauge.types import Status
from synthetic import synthetic_log

CASES = {case.name: case for case in packs_run.CASES}


def small_pack(**changes: Any) -> packs.BenchPack:
    """Three half-hour drives of the published equation, each over 30 % SoC."""
    logs = [
        synthetic_log(
            hours=0.5,
            start_pct=start,
            end_pct=start - 30.0,
            noise_v=0.5,
            seed=seed,
            name=f"d{seed}",
        )
        for seed, start in enumerate((90.0, 75.0, 60.0), start=1)
    ]
    pack = packs.BenchPack("small", "judged", "nmc", logs, logs, "exact", CAPACITY_AH, sizes=(1, 2))
    return replace(pack, **changes)


def bench_of_small_pack(jobs: int) -> Bench:
    cases = [CASES[name] for name in ("withheld", "given", "+2 A")]
    return packs_run.run([small_pack()], cases=cases, sizes=[2], splits=2, jobs=jobs)


@pytest.fixture(scope="module")
def bench() -> Bench:
    return bench_of_small_pack(jobs=1)


def without_times(bench: Bench) -> dict[str, Any]:
    whole = bench.to_dict()
    del whole["seconds"]
    for item in (*whole["rows"], *whole["logs"]):
        del item["fit_seconds"], item["step_us"]
    return whole


def test_bench_of_a_small_pack_is_repeatable(bench: Bench) -> None:
    # As text: an unknown figure is NaN, which does not equal itself.
    in_processes = without_times(bench_of_small_pack(jobs=2))
    assert json.dumps(in_processes) == json.dumps(without_times(bench))


def test_a_log_is_never_judged_by_its_own_model() -> None:
    for size in (1, 2, 3):
        for training, judged in small_pack().splits(size, 5, seed=1):
            assert len(training) == size
            names = {log.name for log in (*training, *judged)}
            assert len(names) == len(training) + len(judged) == 3
    assert not list(small_pack().splits(3, 5, seed=1))  # nothing is left to judge


def test_errors_of_sensors_reach_the_estimate(bench: Bench) -> None:
    given, offset = (row for row in bench.rows if row.case in {"given", "+2 A"})
    # 2 A over half an hour are 1 Ah of 51.5 Ah, 1.0 % on average.
    assert given.counting_mae_pct == pytest.approx(0.0, abs=1e-9)
    assert offset.counting_mae_pct == pytest.approx(100.0 * 0.5 / CAPACITY_AH, rel=0.01)
    asked = {(row.case, row.quantity): row.asked for row in bench.quantities}
    assert asked["+2 A", "offset at 20 min, A"] == asked["+2 A", "offset at the end, A"] == 2
    assert ("given", "offset at 20 min, A") not in asked


def test_voltage_and_capacity_errors_reach_the_estimate() -> None:
    found = packs_run.run(
        [small_pack()],
        cases=[CASES["given"], CASES["voltage +0.5 %"], CASES["capacity +10 %"]],
        sizes=[1],
        splits=1,
    )
    given, voltage, capacity = found.rows
    # 0.5 % of about 380 V is 1.9 V, worth several % SoC to the inverse.
    assert voltage.newton_mae_pct > given.newton_mae_pct + 1.0
    assert voltage.counting_mae_pct == given.counting_mae_pct
    # 30 % SoC counted as 27.3 %: 1.4 % off on average.
    assert capacity.counting_mae_pct == pytest.approx(30.0 * (1.0 - 1.0 / 1.1) / 2.0, rel=0.15)


def of_known_errors(error_pct: list[float], std_pct: list[float], **log: Any) -> LogScore:
    """Score of a log of one sample every 5 minutes at 50 % SoC with given errors."""
    n = len(error_pct)
    one = np.ones(n)
    soc = log.pop("soc_pct", 50.0 * one)
    truth = Log(300.0 * np.arange(n), one, 380.0 * one, 20.0 * one, soc, name="known")
    known = np.where(np.isfinite(soc), soc, 50.0)
    table = EstimateTable(
        time_s=truth.time_s,
        soc_pct=known + np.array(error_pct),
        soc_std_pct=np.array(std_pct),
        soc_newton_pct=known + 3.0,
        soc_coulomb_pct=known - 2.0,
        voltage_model_v=380.0 * one,
        residual_v=0.0 * one,
        status=np.full(n, Status.VALID),
        reasons=np.zeros(n, np.int64),
    )
    return score_log(table, known + 4.0, truth, **log)


def test_score_of_a_log_by_hand() -> None:
    # At 0, 5, 10 and 15 minutes.
    score = of_known_errors([8.0, -1.0, 4.0, 1.0], [1.0, 1.0, 1.0, 0.4])
    assert score.rows == 4
    assert score.mae_pct == pytest.approx(3.5)
    assert score.rmse_pct == pytest.approx(math.sqrt((64 + 1 + 16 + 1) / 4))
    assert score.max_pct == 8.0
    assert score.cover == 0.25
    assert score.mean_std_pct == pytest.approx(0.85)
    assert (score.newton_mae_pct, score.counting_mae_pct, score.plain_mae_pct) == (3.0, 2.0, 4.0)
    assert score.five_min_mae_pct == pytest.approx(2.0)
    assert score.late_mae_pct == pytest.approx(2.5)
    assert score.late_wrong == 0.5
    assert (score.valid, score.valid_wrong) == (1.0, 0.5)
    later = of_known_errors([8.0, -1.0, 4.0, 1.0], [1.0, 1.0, 1.0, 0.4], after_s=300.0)
    assert (later.rows, later.max_pct) == (3, 4.0)
    assert later.valid_wrong == 0.5  # over all samples


def test_unknown_estimates_and_references_are_left_out() -> None:
    soc = np.array([math.nan, 50.0, 50.0, 50.0])
    score = of_known_errors([9.0, math.nan, 1.0, 3.0], [1.0, math.nan, 1.0, 1.0], soc_pct=soc)
    assert score.rows == 2
    assert score.mae_pct == 2.0
    assert score.cover == 0.5


def test_a_log_without_scored_samples_changes_no_row() -> None:
    known = replace(of_known_errors([1.0, 2.0], [1.0, 1.0]), pack="p", case="given", size=5)
    unknown = of_known_errors([math.nan], [1.0])
    unknown = replace(unknown, pack="p", case="given", size=5, log="unknown")
    alone, both = row_of(known), row_of(known, unknown)
    assert both.rmse_pct == alone.rmse_pct
    assert (both.max_pct, both.worst_cover_log) == (2.0, "known")
    assert [target.met for target in both.targets] == [target.met for target in alone.targets]


def row_of(*scores: LogScore, case: str | None = None) -> Row:
    rows = pool_scores(scores, {score.pack: "nmc" for score in scores})
    return next(row for row in rows if case is None or row.case == case)


def a_score(**changes: Any) -> LogScore:
    """Score of a log that meets every target."""
    score = LogScore(
        log="a", minutes=30.0, rows=1000, mae_pct=0.8, rmse_pct=1.0, max_pct=3.0, cover=0.95,
        mean_std_pct=1.0, newton_mae_pct=1.0, counting_mae_pct=2.0, plain_mae_pct=1.0,
        five_min_rows=800, five_min_mae_pct=0.8, late_rows=600, late_mae_pct=0.8, late_wrong=0.0,
        valid=0.9, valid_wrong=0.0, empty_rows=0, empty_uncovered=0, pack="p", role="judged",
        case="withheld", size=10, split=0,
    )  # fmt: skip
    return replace(score, **changes)


def test_row_pools_logs_by_their_samples() -> None:
    row = row_of(
        a_score(),
        a_score(log="b", rows=3000, mae_pct=2.0, rmse_pct=3.0, max_pct=7.0, cover=0.75),
        # Too short to be judged alone.
        a_score(log="short", minutes=12.0, rows=1, cover=0.0, mae_pct=0.8, rmse_pct=1.0),
    )
    assert row.mae_pct == pytest.approx((1001 * 0.8 + 3000 * 2.0) / 4001)
    assert row.rmse_pct == pytest.approx(math.sqrt((1001 * 1.0 + 3000 * 9.0) / 4001))
    assert row.cover == pytest.approx((1000 * 0.95 + 3000 * 0.75) / 4001)
    assert (row.max_pct, row.logs) == (7.0, 3)
    assert (row.worst_cover_log, row.worst_cover, row.worst_mae_log) == ("b", 0.75, "b")


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, ()),
        ({"mae_pct": 1.41}, ("inputs",)),
        ({"mae_pct": 1.39}, ()),
        ({"five_min_mae_pct": 1.2}, ("5 min",)),
        ({"five_min_mae_pct": 1.2, "size": 5}, ()),
        ({"five_min_mae_pct": 1.6, "size": 5}, ("5 min",)),
        ({"five_min_mae_pct": 9.0, "size": 3}, ()),
        ({"cover": 0.89}, ("2σ",)),
        ({"cover": 0.995}, ("2σ",)),
        ({"cover": 0.74}, ("2σ", "2σ of a log")),
        ({"mean_std_pct": 0.6}, ("σ/RMSE",)),
        ({"mean_std_pct": 1.6}, ("σ/RMSE",)),
    ],
)
def test_targets_of_a_good_and_a_bad_row(changes: dict[str, Any], missed: tuple[str, ...]) -> None:
    assert row_of(a_score(**changes)).missed == missed


def test_counting_that_repeats_the_reference_sets_no_limit() -> None:
    exact = {"case": "given", "counting_mae_pct": 0.0}
    assert "inputs" in row_of(a_score(**exact)).missed
    assert row_of(a_score(**exact, counting_is_reference=True)).missed == ()


def quantity_row(*found: Quantity) -> QuantityRow:
    (row,) = pool_quantities({("p", "judged", 5, "case"): found})
    return row


def test_offset_must_be_found_unless_the_std_covers_it() -> None:
    name = "offset at 20 min, A"
    assert quantity_row(Quantity(name, 1.0, 0.6, 2.0)).missed == ()
    assert quantity_row(Quantity(name, 1.0, 0.4, 2.0)).missed == ("2σ beside the SoC", "offset")
    assert quantity_row(Quantity(name, 1.8, 0.05, 2.0)).missed == ("2σ beside the SoC",)


def test_quantities_are_pooled_and_unknown_ones_left_out() -> None:
    name = "capacity, %"
    row = quantity_row(
        Quantity(name, 103.0, 1.0, 100.0),
        Quantity(name, 99.0, 2.0, 100.0),
        Quantity(name, math.nan, 1.0, 100.0),
    )
    assert (row.asked, row.mae, row.max, row.cover, row.mean_std) == (2, 2.0, 3.0, 0.5, 1.5)
    assert row.std_over_rmse == pytest.approx(1.5 / math.sqrt(5.0))
    assert row.missed == ("2σ beside the SoC",)
    assert "capacity" in quantity_row(Quantity(name, 103.0, 2.0, 100.0)).missed


def test_every_number_of_a_weak_cell_must_be_right() -> None:
    found = [Quantity("weak cell", 20.0, 1.0, 20.0, is_right) for is_right in (True, False)]
    assert quantity_row(*found).missed == ("number",)
    assert quantity_row(found[0]).missed == ()


def test_uncovered_error_near_empty_is_a_miss() -> None:
    soc = np.array([50.0, 8.0, 8.0, 8.0])
    score = of_known_errors([6.0, 6.0, 6.0, 4.0], [1.0, 3.5, 1.0, 1.0], soc_pct=soc)
    assert (score.empty_rows, score.empty_uncovered) == (3, 1)
    assert "empty" in row_of(a_score(empty_rows=3, empty_uncovered=1)).missed
    assert row_of(a_score(empty_rows=3)).missed == ()


def test_wrong_start_is_judged_by_the_same_withheld_logs() -> None:
    low = a_score(case="start 20 % low", late_mae_pct=1.0)
    same, other = a_score(late_mae_pct=0.8), a_score(log="b", late_mae_pct=5.0)
    assert "recovery" in row_of(low, same, other, case=low.case).missed
    assert row_of(low, replace(same, late_mae_pct=0.95), case=low.case).missed == ()
    astray = replace(low, late_mae_pct=0.8, late_wrong=0.6)
    assert row_of(astray, same, case=low.case).missed == ("astray",)


def test_wrong_start_outside_the_scale_is_no_case() -> None:
    low, high = CASES["start 20 % low"], CASES["start 20 % high"]
    log = synthetic_log(hours=0.3, start_pct=90.0, end_pct=80.0)
    assert (low.suits(log), high.suits(log)) == (True, False)
    log = synthetic_log(hours=0.3, start_pct=15.0, end_pct=10.0)
    assert (low.suits(log), high.suits(log)) == (False, True)
    assert CASES["withheld"].suits(log)
    found = packs_run.run([small_pack()], cases=[CASES["withheld"], high], sizes=[1], splits=1)
    # "d1" starts at 90 %.
    assert {score.log for score in found.logs if score.case == high.name} <= {"d2", "d3"}


def test_logs_without_a_model_are_named() -> None:
    # Capacities of a quarter: the counted SoC leaves 0 to 100 %.
    found = packs_run.run([small_pack(capacity_ah=CAPACITY_AH / 4.0)], sizes=[1], splits=1)
    assert found.rows == ()
    (failure,) = found.failures
    assert (failure.pack, failure.size) == ("small", 1)
    assert "capacity" in failure.error


def test_charges_between_logs_return_the_charge() -> None:
    logs = small_pack().judged[:2]  # 90 to 60 %, 75 to 45 %
    log, is_measured = packs_run.chain(logs, CAPACITY_AH)
    assert log.soc_pct is not None
    assert len(log) == len(is_measured)
    assert np.isnan(log.soc_pct[~is_measured]).all()
    charged_ah = -log.current_a[~is_measured].sum() / 3600.0
    assert charged_ah == pytest.approx(0.15 * CAPACITY_AH, rel=1e-3)
    counted = counted_soc_pct(log, CAPACITY_AH, 90.0)
    assert counted[is_measured] == pytest.approx(log.soc_pct[is_measured], abs=0.05)


def test_a_wrong_capacity_is_asked_for_after_the_charges() -> None:
    case = CASES["charges, capacity +10 %"]
    found = packs_run.run([small_pack()], cases=[case], sizes=[2], splits=1)
    (row,), (capacity,) = found.rows, found.quantities
    assert (row.logs, capacity.quantity) == (1, "capacity, %")
    assert row.mae_pct < row.counting_mae_pct
    assert (capacity.asked, capacity.cover) == (1, 1.0)


def test_the_model_of_another_pack_is_told_apart() -> None:
    other = [
        replace(log, current_a=1.6 * log.current_a, voltage_v=0.97 * log.voltage_v)
        for log in small_pack().judged
    ]
    found = packs_run.run(
        [
            small_pack(place="here"),
            small_pack(name="other", place="there", judged=other, training=other),
        ],
        cases=[CASES["withheld"], CASES["another pack's model"]],
        sizes=[2],
        splits=1,
    )
    mine = {row.case: row for row in found.rows if row.pack == "small"}
    assert (mine["withheld"].mismatches, mine["another pack's model"].logs) == (0, 3)
    assert {log.log.split(":")[0] for log in found.logs if log.is_model_wrong} == {"other", "small"}
    assert mine["another pack's model"].targets == ()


def test_a_weakened_cell_is_empty_first() -> None:
    log = synthetic_log(hours=0.5, start_pct=90.0, end_pct=0.0)
    real_v = np.column_stack([log.voltage_v / 96.0] * 6)
    weak = packs_quantities.WeakCell.of(log, real_v, 96, 50)
    assert weak.cells_v.shape == (len(weak.log), 96)
    assert weak.cells_v.sum(axis=1) == pytest.approx(weak.log.voltage_v)
    assert int(np.argmin(weak.cells_v[-1])) == 49
    assert weak.soc_pct[-1] == pytest.approx(0.0, abs=0.5)
    assert weak.log.soc_pct is not None
    assert weak.log.soc_pct[-1] == pytest.approx(20.0, abs=0.5)
    six = packs_quantities.WeakCell.of(log, real_v, 6, 1)
    assert six.cells_v.sum(axis=1) == pytest.approx(six.log.voltage_v)


def test_number_of_logs_that_no_pack_has_is_an_error() -> None:
    with pytest.raises(InputError, match="--logs"):
        packs_run.run([small_pack()], sizes=[7])


def test_pack_of_a_cell_counts_from_the_known_start() -> None:
    time_s = np.arange(0.0, 3601.0)
    one = np.ones(time_s.size)
    cell = Log(time_s, 2.0 * one, 3.7 * one, 25.0 * one)
    pack = packs.as_pack(cell, 96, 17, 4.0, 90.0)
    assert pack.voltage_v[0] == pytest.approx(96 * 3.7)
    assert pack.current_a[0] == pytest.approx(34.0)
    assert pack.soc_pct is not None
    assert pack.soc_pct[[0, -1]] == pytest.approx([90.0, 40.0])


def test_named_pack_without_folder_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "bmw_i3").mkdir()
    with pytest.raises(InputError, match="lg_hg2"):
        packs.load(tmp_path, ["lg_hg2"])
    with pytest.raises(InputError, match="no recorded packs"):
        packs.load(tmp_path / "bmw_i3")
    with pytest.raises(InputError, match="does not exist"):
        packs.load(tmp_path / "absent")


@pytest.mark.parametrize(
    ("options", "field"),
    [
        (["--data", ".", "--pack", "tesla"], "--pack"),
        (["--data", ".", "--case", "upside down"], "--case"),
        (["--data", "absent"], "--data"),
    ],
)
def test_wrong_option_of_the_bench_is_named(
    options: list[str],
    field: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["cangauge", "packs-check", *options, "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert json.loads(capsys.readouterr().out)["error"]["field"] == field


def test_judged_logs_are_in_no_development_pack(shared_data: Path) -> None:
    names = ["i3_dev", "car1_dev", "i3", "i3_winter", "car1"]
    found = {pack.name: pack for pack in packs.load(shared_data, names)}
    known = {
        log.name
        for name in ("i3_dev", "car1_dev")
        for log in (*found[name].training, *found[name].judged)
    }
    for name in ("i3", "i3_winter", "car1"):
        assert found[name].role == "judged"
        assert not known & {log.name for log in found[name].judged}


def test_quick_bench_on_a_recorded_pack(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--data", str(shared_data), "--quick", "--pack", "i3_dev", "--logs", "5"]
    monkeypatch.setattr(sys, "argv", ["cangauge", "packs-check", *options, "--jobs", "1", "--json"])
    main_code = _exit_code()
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert main_code == 0
    assert "fitting and estimating" in printed.err
    assert [row["case"] for row in result["rows"]] == list(packs_run.QUICK_CASES)
    for row in result["rows"]:
        assert (row["role"], row["size"], row["logs"]) == ("development", 5, packs_run.QUICK_LOGS)
        assert 0.0 < row["mae_pct"] <= row["rmse_pct"] <= row["max_pct"] < 100.0
        assert set(row["missed"]) == {t["name"] for t in row["targets"] if not t["met"]}
    # The car's own SoC is counted: a given start leaves counting nothing to lose.
    assert result["rows"][1]["counting_mae_pct"] < 0.5


def _exit_code() -> int:
    try:
        main()
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0
