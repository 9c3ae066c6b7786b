"""`cangauge gap-check --logs`: what the diagnosis would find on one's own pack."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cangauge.extras.validation import own_logs
from cangauge.extras.validation.own_logs import Finding, Healthy, summarize, table
from cangauge.extras.validation.twin.faults import fault_kind
from cangauge.logs.canonical import write_log
from synthetic import synthetic_log

Run = Callable[..., object]


@pytest.fixture(scope="module")
def mine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mine")
    for seed in (11, 12, 13, 14):
        log = synthetic_log(hours=0.4, start_pct=85.0, end_pct=70.0, noise_v=0.5, seed=seed)
        write_log(log, folder / f"day{seed}.csv")
    return folder


def test_own_logs_show_what_would_be_found(
    run: Run, made: Path, mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = tuple(fault_kind(name) for name in ("resistance_asymmetry", "coulombic_efficiency"))
    monkeypatch.setattr(own_logs, "fault_kinds", lambda: kinds)
    page = tmp_path / "mine.html"
    ran = run("gap-check", "--logs", *sorted(mine.glob("*.csv")), "-m", made / "model.json",
              "--at-most", 1, "--report", page, "--json")  # fmt: skip
    assert ran.code == 0
    found = json.loads(ran.out)
    asymmetry, efficiency = found["effects"]
    assert [each["log"] for each in found["healthy"]] == ["day11"]
    gaps = [each["gap_v"] / found["floor_v"] for each in asymmetry["sizes"]]
    assert np.allclose(gaps[:2], [1.0, 2.0], rtol=0.05)
    assert asymmetry["sizes"][1]["probability"] > 0.5
    assert asymmetry["smallest_named"] in {each["size"] for each in asymmetry["sizes"]}
    # The logs never charge much: no physical loss shows, and none is claimed.
    assert efficiency["smallest_named"] is None
    assert efficiency["sizes"][-1]["limited"]
    assert "resistance_asymmetry" in page.read_text(encoding="utf-8")


def test_own_logs_need_others_and_no_drawn_cases(run: Run, mine: Path) -> None:
    log = mine / "day11.csv"
    few = run("gap-check", "--logs", log, mine / "day12.csv", "--capacity-ah", 60)
    assert few.code == 2
    assert "at least 3" in few.err
    mixed = run("gap-check", "--logs", log, "--seed", 3)
    assert mixed.code == 2
    assert "--seed" in mixed.err
    alone = run("gap-check", "--model", log)
    assert alone.code == 2
    assert "--model" in alone.err


def test_an_effect_counts_as_named_by_most_logs() -> None:
    def finding(log: str, floors: float, verdict: str) -> Finding:
        return Finding(log, "current_offset", floors, floors, 0.5, floors > 3.0, 0.4, verdict)

    found = summarize([
        Healthy("a", 0.5, 0.9, "none"),
        Healthy("b", 0.5, 0.9, "none"),
        finding("a", 1.0, "current_offset"), finding("b", 1.0, "none"),
        finding("a", 2.0, "current_offset"), finding("b", 2.0, "current_offset"),
    ])  # fmt: skip
    offset = next(item for item in found["effects"] if item["effect"] == "current_offset")
    assert [size["named"] for size in offset["sizes"]] == [1, 2]
    assert offset["smallest_named"] == 2.0
    row = next(cells for cells in table(found)[1] if cells[0] == "current_offset")
    assert row == ["current_offset", "1.0 A: 0.40, named 1/2", "2.0 A: 0.40, named 2/2", "–",
                   "2.0 A"]  # fmt: skip
