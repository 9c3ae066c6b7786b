"""What two commands say of one log is one figure."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.logs.canonical import write_log
from live import succeeds
from synthetic import synthetic_log


@pytest.fixture(scope="module")
def trip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trip whose own SoC is in whole steps of 0.5 %, and comes a while after the current."""
    log = synthetic_log(hours=0.5, start_pct=80.0, end_pct=60.0, noise_v=0.5, seed=3)
    assert log.soc_pct is not None
    soc_pct = np.round(log.soc_pct * 2.0) / 2.0
    soc_pct[:40] = np.nan
    path = tmp_path_factory.mktemp("trip") / "trip.csv"
    write_log(replace(log, soc_pct=soc_pct), path)
    return path


def test_inspect_and_fit_state_one_capacity(trip: Path, tmp_path: Path) -> None:
    inspected = succeeds("inspect", trip, "--json").json
    options = ("-o", tmp_path / "m.json", "--capacity-ah", "from-soc", "--json")
    fitted_ah = succeeds("fit", trip, *options).json["capacity_ah"]
    assert fitted_ah == pytest.approx(inspected["soc"]["implied_capacity_ah"], rel=1e-9)
    (ability,) = [each for each in inspected["abilities"] if each["topic"] == "capacity"]
    assert f"{fitted_ah:.2f} ± " in ability["text"]


def test_terminal_page_and_model_state_one_soc_range(trip: Path, tmp_path: Path) -> None:
    model, page = tmp_path / "m.json", tmp_path / "m.html"
    ran = succeeds("fit", trip, "-o", model, "--capacity-ah", "from-soc", "--report", page)
    low, high = json.loads(model.read_text(encoding="utf-8"))["range"]["soc_pct"]
    (shown,) = re.findall(r"identified at SoC\s+(\S+) … (\S+)", ran.out)
    assert shown == (f"{low:.1f}", f"{high:.1f}")
    text = html.unescape(re.sub(r"<[^>]+>", " ", page.read_text(encoding="utf-8")))
    assert f"The logs cover {low:.1f} … {high:.1f} %" in text
    sentence = f"Fitted from {low:.0f} to {high:.0f} % SoC"
    assert sentence in ran.out
    assert sentence in text


def test_table_of_estimates_ends_where_the_terminal_says(made: Path, tmp_path: Path) -> None:
    table = tmp_path / "soc.csv"
    ran = succeeds("estimate", made / "part.csv", "-m", made / "model.json", "-o", table)
    names, *_, last = table.read_text(encoding="utf-8").splitlines()
    row = dict(zip(names.split(","), last.split(","), strict=True))
    (end,) = re.findall(r"SoC at the end\s+(\S+)", ran.out)
    assert end == f"{float(row['soc_pct']):.1f}"
