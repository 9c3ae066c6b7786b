"""Score of the stated probabilities: alarm, credible set, proper scores."""

from __future__ import annotations

import math

import pytest

from cangauge.extras.validation.score import Outcome, score


def outcome(truth: str, verdict: str, of_truth: float, *, alarm: bool, answers: int) -> Outcome:
    right = truth or "none"
    beside = ["voltage_gain", "capacity", "hysteresis"][: answers - 1]
    return Outcome(
        task="", case="", protocol="simulated",
        truth=(truth,) if truth else (), leave_out=(), gap_in_floors=2.0 if truth else None,
        verdict=verdict, probability=0.6, detected=alarm, probability_of_truth=of_truth,
        credible_set=(right if of_truth > 0.05 else "time_skew", *beside),
        ceiling=0.8 if verdict != "none" else None,
    )  # fmt: skip


def test_alarm_is_scored_apart_from_the_verdict() -> None:
    found = score(
        [
            outcome("voltage_offset", "voltage_offset", 0.6, alarm=False, answers=2),
            outcome("current_gain", "voltage_offset", 0.2, alarm=True, answers=2),
            outcome("", "voltage_offset", 0.3, alarm=False, answers=2),
            outcome("", "none", 0.9, alarm=True, answers=2),
        ]
    )["protocols"]["simulated"]
    assert found["effects"]["top1"]["value"] == 0.5
    assert found["effects"]["detected"]["value"] == 0.5
    assert found["healthy"]["false_alarms"]["value"] == 0.5
    assert found["healthy"]["named_an_effect"]["value"] == 0.5


def test_probabilities_and_sets_are_scored() -> None:
    found = score(
        [
            outcome("voltage_offset", "voltage_offset", 0.5, alarm=True, answers=1),
            outcome("current_gain", "current_gain", 0.25, alarm=True, answers=3),
            outcome("current_offset", "none", 0.0, alarm=False, answers=2),
        ]
    )["protocols"]["simulated"]["posterior"]
    assert found["probability_of_truth"]["value"] == pytest.approx(0.25)
    assert found["set_covers"]["value"] == pytest.approx(2.0 / 3.0)
    assert found["set_size"]["value"] == pytest.approx(2.0)
    # One miss with probability 0 does not decide everything.
    expected = (math.log(0.5) + math.log(0.25) + math.log(1e-3)) / 3.0
    assert found["log_score"]["value"] == pytest.approx(expected)
    assert found["ceiling"] == {"value": pytest.approx(0.8), "ci": [0.8, 0.8], "of": 2}
