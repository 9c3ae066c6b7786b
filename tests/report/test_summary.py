"""Rows of a diagnosis."""

from __future__ import annotations

from cangauge.diagnosis.sentences import candidate_rows, size_cell


def quantity(value: float, ci: list[float] | None, unit: str) -> dict[str, object]:
    return {"value": value, "ci": ci, "unit": unit}


def test_a_size_has_its_interval_and_unit() -> None:
    candidate = {
        "parameters": {
            "offset_a": quantity(3.01, [2.7, 3.32], "A"),
            "tau_s": quantity(5.0, None, "s"),
        }
    }
    assert size_cell(candidate) == "3.01 (2.7 … 3.3) A"
    candidate["parameters"]["fraction"] = quantity(0.1, [0.05, 0.15], "1")
    assert size_cell(candidate) == "offset 3.01 (2.7 … 3.3) A; fraction 0.100 (0.050 … 0.15)"


def test_none_and_unknown_follow_the_causes() -> None:
    cause = {"effect": "time_skew", "probability": 0.8, "rmse_v": 0.5, "parameters": {}}
    result = {
        "cause": {"candidates": [cause], "probability_none": 0.05, "probability_unknown": 0.15}
    }
    _, rows = candidate_rows(result)
    assert [row[:2] for row in rows] == [
        ["time skew", "0.80"],
        ["unknown", "0.15"],
        ["none", "0.05"],
    ]
