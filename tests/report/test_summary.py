"""Sentences about a diagnosis, and rounding."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from cangauge.report.summary import headline, next_step, parameters_text, rounded


def diagnosis(
    cause: str, parameters: dict[str, Any], alike: tuple[str, ...] = ()
) -> SimpleNamespace:
    """Return as much of a diagnosis as a headline needs."""
    chances = {cause: 0.6} | dict.fromkeys(alike, 0.3)
    return SimpleNamespace(
        verdict=SimpleNamespace(cause=cause, ambiguous_with=alike, probabilities=chances),
        candidates=[{"effect": cause, "parameters": parameters}],
    )


def one(name: str, value: float, ci: tuple[float, float] | None) -> dict[str, Any]:
    return {name: {"value": value, "ci": ci, "unit": "1"}}


@pytest.mark.parametrize(
    ("cause", "parameters", "expected"),
    [
        ("voltage_offset", one("offset_v", 2.71, (2.08, 3.31)),
         "The voltage reads 2.7 (2.1 … 3.3) V too high: voltage_offset (probability 0.60)."),
        ("current_gain", one("gain_pct", -3.0, (-4.0, -2.0)),
         "The current reads 3.0 (2.0 … 4.0) % too low: current_gain (probability 0.60)."),
        # The offset is what to add to the assumed value.
        ("initial_soc", one("offset_pct", -5.0, None),
         "The assumed initial SoC is 5.0 % too high: initial_soc (probability 0.60)."),
        ("hysteresis", one("half_width_v", 2.0, None),
         "The most likely cause is hysteresis (probability 0.60)."),
        ("none", {}, ""),
    ],
)  # fmt: skip
def test_headline_begins_with_the_size(
    cause: str, parameters: dict[str, Any], expected: str
) -> None:
    assert headline(diagnosis(cause, parameters)) == expected


def test_inseparable_causes_share_a_probability() -> None:
    found = diagnosis("voltage_offset", one("offset_v", 2.7, None), ("voltage_gain",))
    assert "voltage_offset or voltage_gain (probability 0.90 together)" in headline(found)
    assert next_step(found).startswith("To separate these causes: ")


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
