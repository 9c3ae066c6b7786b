"""Scores of verdicts made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cangauge.extras.validation.score import Outcome, bootstrapped, outcome_of, proportion, score
from cangauge.extras.validation.tables import judge_targets
from cangauge.extras.validation.worker_pool import Task


def label(*effects: str, size: float = 0.0, gap_v: float = 2.0, **more: Any) -> dict[str, Any]:
    return {
        "effects": list(effects),
        "faults": [{"id": effect, "size": size, "shape": {}} for effect in effects],
        "gap_v": gap_v if effects else 0.0,
        "floor_v": 1.0,
        "floor_clean_v": 1.0,
        "floor_sensor_v": 0.5,
        **more,
    }  # fmt: skip


def answer(
    verdict: str,
    probability: float = 0.9,
    *,
    ambiguous: tuple[str, ...] = (),
    ranked: tuple[str, ...] = (),
    parameters: dict[str, Any] | None = None,
    rmse: tuple[float, float] = (3.0, 1.0),
) -> dict[str, Any]:
    order = ranked or (verdict, "capacity", "hysteresis")
    return {
        "seconds": 2.0,
        "peak_mib": 200.0,
        "result": {
            "gap": {
                "baseline_rmse_v": rmse[0],
                "extended_rmse_v": rmse[1],
                "closed_fraction": 0.7,
            },
            "cause": {
                "verdict": verdict,
                "probability": probability,
                "detected": verdict != "none",
                "probability_none": probability if verdict == "none" else 0.0,
                "probability_unknown": probability if verdict == "unknown" else 0.0,
                "credible_set": [verdict, *ambiguous],
                "ambiguous_with": list(ambiguous),
                "accepted": [{"effect": verdict}],
                "candidates": [
                    {
                        "effect": effect,
                        "probability": probability if effect == verdict else 0.0,
                        "parameters": parameters or {},
                    }
                    for effect in order
                ],
            },
            "ceiling": None,
        },
    }


def outcome(
    truth: dict[str, Any],
    given: dict[str, Any],
    protocol: str = "simulated",
    leave_out: tuple[str, ...] = (),
) -> Outcome:
    return outcome_of(Task("t", "c", protocol, leave_out), truth, given)


def figures(*items: Outcome, protocol: str = "simulated") -> dict[str, Any]:
    found: dict[str, Any] = score(items)["protocols"][protocol]
    return found


def test_top1_pairs_top2_and_family_differ() -> None:
    truth = label("voltage_offset")
    items = [
        outcome(truth, answer("voltage_offset")),
        outcome(truth, answer("voltage_gain", ambiguous=("voltage_offset",))),
        outcome(truth, answer("voltage_gain", ambiguous=("voltage_offset", "capacity"))),
        outcome(truth, answer("capacity", ranked=("capacity", "voltage_offset"))),
        outcome(truth, answer("none", ranked=("voltage_offset",))),
        outcome(truth, answer("unknown", ranked=("voltage_offset",))),
        outcome(truth, {"error": "boom"}),
    ]
    effects = figures(*items)["effects"]
    hits = {key: effects[key]["hits"] for key in ("top1", "top1_pair", "top2", "family")}
    assert hits == {"top1": 1, "top1_pair": 2, "top2": 2, "family": 3}
    assert effects["top1"]["of"] == 7
    assert effects["detected"]["hits"] == 5
    assert effects["ranked_first"]["hits"] == 3


def test_crash_is_wrong_and_listed() -> None:
    result = score(
        [outcome(label("capacity"), {"error": "boom"}), outcome(label(), {"error": "b"})]
    )
    simulated = result["protocols"]["simulated"]
    assert simulated["effects"]["top1"]["value"] == 0.0
    assert simulated["healthy"]["false_alarms"]["value"] == 1.0
    assert [item["error"] for item in result["crashed"]] == ["boom", "b"]


def test_any_verdict_but_none_is_a_false_alarm() -> None:
    answers = [answer("none"), answer("none"), answer("unknown"), answer("capacity")]
    healthy = figures(*(outcome(label(), item) for item in answers))["healthy"]
    assert healthy["false_alarms"]["hits"] == 2
    assert healthy["named_an_effect"]["hits"] == 1


def test_without_the_cause_only_unknown_is_correct() -> None:
    truth, out = label("capacity"), ("capacity",)
    items = [
        outcome(truth, answer("unknown"), "open-set", out),
        outcome(truth, answer("none"), "open-set", out),
        outcome(truth, answer("initial_soc", 0.8), "open-set", out),
        outcome(truth, answer("initial_soc", 0.4), "open-set", out),
        outcome(truth, answer("capacity"), "open-set", ("hysteresis",)),
    ]
    found = figures(*items, protocol="open-set")
    assert found["open_set"]["cases"] == 4
    assert found["open_set"]["unknown"]["hits"] == 1
    assert found["open_set"]["confidently_wrong"]["hits"] == 1
    assert found["decoys"]["hits"] == found["decoys"]["of"] == 1
    assert "effects" not in found


def test_faults_outside_the_library_are_unknown() -> None:
    items = [
        outcome(label("string_dropout"), answer(verdict)) for verdict in ("unknown", "capacity")
    ]
    assert figures(*items)["open_set"]["unknown"]["value"] == 0.5


def test_two_causes_need_both() -> None:
    truth = label("capacity", "hysteresis")
    both = answer("capacity")
    both["result"]["cause"]["accepted"].append({"effect": "hysteresis"})
    pairs = figures(outcome(truth, both), outcome(truth, answer("capacity")))["pairs"]
    assert pairs["first_is_one_of_both"]["hits"] == 2
    assert pairs["both"]["hits"] == 1


def test_gap_below_the_range_is_excluded() -> None:
    small, large = label("capacity", gap_v=0.3), label("capacity", gap_v=0.6)
    found = figures(outcome(small, answer("none")), outcome(large, answer("capacity")))
    assert found["effects"]["cases"] == found["below_range"] == 1
    assert [entry["top1"]["of"] for entry in found["by_gap"]] == [1, 1, 0, 0]


def test_closed_fraction_uses_the_true_floors() -> None:
    named = outcome(label("capacity"), answer("capacity", rmse=(3.0, 1.0)))
    assert named.closed == {
        "reported": 0.7,
        "clean": pytest.approx((9.0 - 1.0) / (9.0 - 1.0)),
        "sensor": pytest.approx((9.0 - 1.0) / (9.0 - 0.25)),
    }
    missed = outcome(label("capacity"), answer("none", rmse=(3.0, 3.0)))
    assert missed.closed is not None
    assert missed.closed == {"reported": 0.0, "clean": 0.0, "sensor": 0.0}
    no_gap = outcome(label("capacity"), answer("capacity", rmse=(0.9, 0.4)))
    assert no_gap.closed is not None
    assert "clean" not in no_gap.closed


def test_reliability_and_brier_score() -> None:
    items = [outcome(label("capacity"), answer("capacity", 0.95)) for _ in range(3)]
    items.append(outcome(label("capacity"), answer("hysteresis", 0.95)))
    items.append(outcome(label(), answer("none", 0.65)))
    items.append(outcome(label("capacity", "hysteresis"), answer("capacity", 0.1)))
    found = score(items)["reliability"]
    assert found["brier"]["of"] == 5
    assert found["brier"]["value"] == pytest.approx((3 * 0.05**2 + 0.95**2 + 0.35**2) / 5)
    assert found["bins"][9]["right"]["value"] == 0.75
    assert found["bins"][9]["stated"] == pytest.approx(0.95)
    assert found["bins"][6]["right"]["of"] == 1


@pytest.mark.parametrize(("interval", "holds"), [([-6.0, -4.0], 1), ([4.0, 6.0], 0)])
def test_coverage_is_of_the_true_parameter(interval: list[float], holds: int) -> None:
    stated = {"change_pct": {"value": sum(interval) / 2.0, "ci": interval, "unit": "%"}}
    item = outcome(label("capacity", size=0.05), answer("capacity", parameters=stated))
    coverage = figures(item)["coverage"]
    assert coverage["all"]["hits"] == holds
    assert coverage["by_parameter"]["capacity.change_pct"]["of"] == 1


def test_wilson_interval() -> None:
    # Newcombe, Statistics in Medicine 17 (1998) 857, table I, method 3.
    assert proportion(81, 263)["ci"] == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert proportion(0, 20)["ci"] == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert proportion(0, 0)["value"] is None


def test_bootstrap_covers_a_mean() -> None:
    found = bootstrapped([0.0, 1.0] * 50, np.mean)
    assert found["value"] == 0.5
    assert found["ci"] == pytest.approx([0.4, 0.6], abs=0.02)


def test_targets_without_a_figure_are_skipped() -> None:
    result: dict[str, Any] = score([outcome(label(), answer("none")) for _ in range(3)])
    rows = {row["name"]: row for row in judge_targets(result | {"later": {}})}
    assert rows["simulated: false alarms"]["met"]
    assert not any("PyBaMM" in name for name in rows)
