"""The warning of the benchmarks: what became slower relative to its barest form."""

from __future__ import annotations

import json

from cost import KEPT, slower


def test_a_ratio_20_percent_above_the_kept_one_is_a_warning() -> None:
    found = {
        "step": {"ratio": 1.3, "us": 2.6, "bare_us": 2.0},
        "frame": {"ratio": 2.3, "us": 4.6, "bare_us": 2.0},
        "new": {"ratio": 9.0, "us": 9.0, "bare_us": 1.0},
    }
    (line,) = slower(found, {"step": 1.0, "frame": 2.0})
    assert line.startswith("warning: step costs 1.30 ×")


def test_the_kept_ratios_are_those_that_are_measured() -> None:
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    assert set(kept) == {"step at 10 Hz", "step at 1 Hz", "offline row at 10 Hz", "live frame"}
    assert all(ratio > 0.0 for ratio in kept.values())
