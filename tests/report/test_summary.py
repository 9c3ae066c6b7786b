"""Sentences about a diagnosis, and rounding."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from cangauge.diagnosis import Ceiling, Verdict
from cangauge.extras.report.summary import (
    headline,
    next_step,
    open_question,
    parameters_text,
    rounded,
)


def diagnosis(
    cause: str,
    parameters: dict[str, Any],
    alike: tuple[str, ...] = (),
    none: float = 0.01,
    ceiling: Ceiling | None = None,
) -> SimpleNamespace:
    """Return as much of a diagnosis as its sentences need."""
    chances = {cause: 0.6} | dict.fromkeys(alike, 0.3) | {"none": none}
    return SimpleNamespace(
        verdict=Verdict(cause, chances, (), (), 0.9, ceiling=ceiling),
        candidates=[{"effect": cause, "parameters": parameters}],
        problem=SimpleNamespace(references=()),
        baseline_rmse_v=2.0,
    )


def one(name: str, value: float, ci: tuple[float, float] | None) -> dict[str, Any]:
    return {name: {"value": value, "ci": ci, "unit": "1"}}


@pytest.mark.parametrize(
    ("cause", "parameters", "expected"),
    [
        ("voltage_offset", one("offset_v", 2.71, (2.08, 3.31)),
         "The voltage reads 2.7 (2.1 … 3.3) V too high: voltage_offset (60 %)."),
        ("current_gain", one("gain_pct", -3.0, (-4.0, -2.0)),
         "The current reads 3.0 (2.0 … 4.0) % too low: current_gain (60 %)."),
        # The offset is what to add to the assumed value.
        ("initial_soc", one("offset_pct", -5.0, None),
         "The assumed initial SoC is 5.0 % too high: initial_soc (60 %)."),
        ("hysteresis", one("half_width_v", 2.0, None),
         "The most likely cause is hysteresis (60 %)."),
        ("none", {}, ""),
    ],
)  # fmt: skip
def test_headline_begins_with_the_size(
    cause: str, parameters: dict[str, Any], expected: str
) -> None:
    assert headline(diagnosis(cause, parameters)) == expected


def test_inseparable_causes_share_a_probability() -> None:
    found = diagnosis("voltage_offset", one("offset_v", 2.7, None), ("voltage_gain",))
    assert "voltage_offset or voltage_gain (together 90 %)." in headline(found)
    assert next_step(found).startswith("To separate these causes: ")


def test_a_name_without_an_alarm_says_so() -> None:
    found = diagnosis("voltage_offset", one("offset_v", 2.7, None), none=0.2)
    assert "No alarm: the probability that there is no fault is 20 %." in headline(found)


def test_the_size_that_would_be_separable_is_given() -> None:
    """Three nats separate; evidence grows with the square of the size."""
    unclear = Ceiling({"capacity": math.log(20.0) / 4.0, "hysteresis": 50.0}, 0.7)
    found = diagnosis("current_offset", one("offset_a", 1.5, None), ceiling=unclear)
    text = open_question(found)
    assert "cannot distinguish current_offset from capacity below 3.0" in text
    assert "70 % of cases" in text
    clear = Ceiling({"capacity": 30.0}, 1.0)
    found = diagnosis("current_offset", one("offset_a", 1.5, None), ceiling=clear)
    assert not open_question(found)


@pytest.mark.parametrize(
    ("value", "std_error", "expected"),
    [
        (-18174.2, 9100.0, ("−18174", "9100")),
        (0.00039339, 0.00045, ("0.00039", "0.00045")),
        (3000.0, None, ("3000", "–")),
        (2.0291, 0.484, ("2.03", "0.48")),
    ],
)
def test_values_are_rounded_to_their_standard_error(
    value: float, std_error: float | None, expected: tuple[str, str]
) -> None:
    assert rounded(value, std_error) == expected


def test_parameters_have_units_and_intervals() -> None:
    parameters = {
        "ohm": {"value": 0.05137, "ci": (0.04401, 0.05869), "unit": "ohm"},
        "activation_k": {"value": 8.78e-10, "ci": None, "unit": "K"},
    }
    text = "ohm 0.0514 Ω (0.0440 … 0.0587), activation_k 0.00 K"
    assert parameters_text(parameters) == text
