"""Numbers and reasons as text."""

from __future__ import annotations

import math

import pytest

from cangauge._text import counted, duration, number, significant, span
from cangauge.types import REASON_WORDS, Reason, reason_names


@pytest.mark.parametrize(
    ("value", "digits", "unit", "text"),
    [
        (1.23456, 2, "V", "1.23 V"),
        (-1.5, 1, "", "−1.5"),
        (-0.0001, 2, "%", "0.00 %"),
        (math.nan, 2, "%", "–"),
        (math.inf, 2, "%", "–"),
        (None, 2, "%", "–"),
    ],
)
def test_number(value: float | None, digits: int, unit: str, text: str) -> None:
    assert number(value, digits, unit) == text


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (0.0372, 3, "0.0372"),
        (21.697, 4, "21.70"),
        (4312.0, 2, "4300"),
        (5.6e6, 2, "5.6e+06"),
        (-0.00371, 3, "−0.00371"),
        (math.nan, 3, "–"),
    ],
)
def test_significant(value: float, digits: int, text: str) -> None:
    assert significant(value, digits) == text


def test_span_and_duration() -> None:
    assert span(-50.0, 200.0, 0, "A") == "−50 … 200 A"
    assert duration(70.0) == "70 s"
    assert duration(1800.0) == "30.0 min"
    assert duration(9273.0) == "2.58 h"


def test_one_thing_is_singular() -> None:
    assert [counted(count, "gap") for count in (0, 1, 2)] == ["0 gaps", "1 gap", "2 gaps"]


def test_every_reason_has_a_name_and_a_meaning() -> None:
    assert set(REASON_WORDS) == set(Reason)
    both = Reason.DELAY_LINE_FILLING | Reason.VOLTAGE_MISSING
    assert reason_names(int(both)) == "delay line filling; voltage missing"
    assert reason_names(0) == ""
