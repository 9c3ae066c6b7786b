"""The page of a diagnosis: the answer first, details folded."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cangauge.diagnosis import SEGMENTS, Diagnosis, ErrorShare, diagnose
from cangauge.errors import InputError
from cangauge.extras.report.diagnosis import gap_page
from cangauge.extras.report.error_places import share_figures
from cangauge.extras.report.page import (
    Beside,
    Bullets,
    Figure,
    InputFile,
    Page,
    Section,
    Table,
    render,
)
from cangauge.extras.report.summary import EXPLAINED, headline
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH
from report_html import MAX_PAGE_BYTES, Html, excess_width_px, title_after_scripts
from synthetic import synthetic_log

SECTIONS = [
    "How sure this is",
    "Where the gap is",
    "How far the gap shrinks",
    "What was compared",
]
DETAILS = [
    "Every effect: evidence and parameters",
    "Errors in numbers",
    "Error over SoC, current, temperature and time",
    "Worst segments",
    "What these logs can show",
]


def day(seed: int) -> Log:
    return synthetic_log(
        hours=0.5, start_pct=85.0, end_pct=65.0, noise_v=0.5, seed=seed, name=f"day {seed}"
    )


@pytest.fixture(scope="module")
def model() -> Model:
    logs = [synthetic_log(noise_v=0.5, seed=seed) for seed in (1, 2)]
    return fit(logs, capacity_ah=CAPACITY_AH).model


@pytest.fixture(scope="module")
def references() -> list[Log]:
    return [day(seed) for seed in (11, 12, 13)]


@pytest.fixture(scope="module")
def offset(model: Model, references: list[Log]) -> Diagnosis:
    logs = [replace(day(seed), current_a=day(seed).current_a + 6.0) for seed in (21, 22)]
    return diagnose(logs, model, references)


@pytest.fixture(scope="module")
def page(offset: Diagnosis) -> Page:
    return gap_page(offset, InputFile("model", "pack", "0123456789abcdef"))


def section(page: Page, title: str) -> Section:
    return next(item for item in page.sections if item.title == title)


def tables(part: Section) -> list[Table]:
    return [block for block in part.blocks if isinstance(block, Table)]


def stacked(figure: Figure) -> list[Any]:
    """Return the plots of a figure that are stacked vertically."""
    grid = next(item for item in figure.plot.references() if type(item).__name__ == "GridPlot")
    return [drawn for drawn, _row, _column in grid.children]


def test_every_question_has_its_section(page: Page) -> None:
    assert [item.title for item in page.sections if not item.is_folded] == SECTIONS
    assert [item.title for item in page.sections if item.is_folded] == DETAILS
    text = render(page)
    assert text.count("<details>") == text.count("</details>") == len(DETAILS)


def test_every_answer_is_explained_in_a_line(page: Page, offset: Diagnosis) -> None:
    causes = {name for name, effect in LIBRARY.items() if effect.is_cause}
    assert causes | {"none", "unknown"} <= EXPLAINED.keys() <= {*LIBRARY, "none", "unknown"}
    explained = dict(tables(section(page, "How sure this is"))[0].rows)
    assert {*offset.verdict.credible_set, "none", "unknown"} <= explained.keys()
    assert explained["none"] == EXPLAINED["none"]
    assert len(tables(section(page, DETAILS[0]))[0].rows) == len(offset.candidates)


def test_compared_are_all_logs_and_references(page: Page) -> None:
    rows = tables(section(page, "What was compared"))[0].rows
    assert [(row[0], row[1]) for row in rows] == [
        ("log", "day 21"), ("log", "day 22"),
        ("reference", "day 11"), ("reference", "day 12"), ("reference", "day 13"),
    ]  # fmt: skip
    errors = [float(row[5]) for row in rows]
    assert max(errors[2:]) < min(errors[:2])


def test_title_names_the_logs_and_the_lead_size_and_cause(page: Page, offset: Diagnosis) -> None:
    assert page.title == "Diagnosis of day 21, day 22 with model pack"
    assert page.lead == headline(offset)
    assert re.match(r"The current reads \d\.\d \(.* … .*\) A too high: current_offset", page.lead)
    assert ">0123456789ab<" in render(page)


def test_size_is_in_volts_and_soc_against_two_floors(page: Page, offset: Diagnosis) -> None:
    rows = {row[0]: row for row in tables(section(page, "Errors in numbers"))[0].rows}
    assert list(rows) == [
        "model as given", "with current_offset", "floor: references", "floor: explainable",
    ]  # fmt: skip
    assert rows["model as given"][1] == f"{offset.baseline_rmse_v:.2f}"
    assert rows["floor: references"][1] == f"{offset.floor_v:.2f}"
    assert rows["floor: explainable"][1] == f"{offset.explainable_v:.2f}"
    assert rows["with current_offset"][3] == f"{offset.extended_soc_mae_pct:.2f}"
    slope = offset.baseline_rmse_v / float(rows["model as given"][2])
    assert 0.2 < slope < 2.0  # V per % of a 96-cell pack


def test_maps_show_before_and_after_in_the_same_shades(page: Page) -> None:
    maps = [item for item in page.figures if item.title.startswith("RMS error over SoC ×")]
    assert [item.title for item in maps] == [
        "RMS error over SoC × current, model as given",
        "RMS error over SoC × temperature, model as given",
        "RMS error over SoC × current, with current_offset",
        "RMS error over SoC × temperature, with current_offset",
    ]
    bars = [item for each in maps for item in each.plot.right if type(item).__name__ == "ColorBar"]
    assert len(bars) == 4
    assert len({bar.color_mapper.high for bar in bars}) == 1
    assert all("[V]" in bar.title for bar in bars)
    before, after = (np.array(maps[k].plot.renderers[0].data_source.data["rms"]) for k in (0, 2))
    assert after.mean() < 0.6 * before.mean()
    assert np.isfinite(before).all()


def test_ten_worst_segments_are_drawn_on_one_scale(page: Page, offset: Diagnosis) -> None:
    part = section(page, "Worst segments")
    drawn = [item for block in part.blocks if isinstance(block, Beside) for item in block.figures]
    assert len(drawn) == SEGMENTS
    assert (
        drawn[0].title
        == f"1. {offset.worst_segments[0].log} at {offset.worst_segments[0].time_s:.0f} s"
    )
    ranges = set()
    for each in drawn:
        error, current = stacked(each)
        names = {line.name for line in error.renderers}
        assert {"model as given", "with current_offset"} <= names
        assert current.yaxis[0].axis_label == "current [A]"
        x = current.renderers[0].data_source.data["x"]
        assert np.abs(x).max() <= 60.0
        ranges.add((error.y_range.start, error.y_range.end))
    assert len(ranges) == 1
    assert len(tables(part)[0].rows) == SEGMENTS


def test_closing_is_shown_over_time_and_by_log(page: Page) -> None:
    part = section(page, "How far the gap shrinks")
    over_time = [block for block in part.blocks if isinstance(block, Figure)][-1]
    names = {line.name for line in over_time.plot.renderers}
    assert {"model as given", "with current_offset"} <= names
    rows = tables(section(page, "Errors in numbers"))[1].rows
    assert [row[0] for row in rows] == ["day 21", "day 22"]
    assert all(float(row[5]) < float(row[4]) for row in rows)


def test_shares_have_intervals(page: Page) -> None:
    shares = [item for item in page.figures if item.title.startswith("Share of the squared error")]
    assert len(shares) == 6
    for each in shares:
        assert any(type(item).__name__ == "Whisker" for item in each.plot.center)
        data = each.plot.renderers[0].data_source.data
        assert all(low <= high for low, high in zip(data["low"], data["high"], strict=True))


def test_shares_of_small_currents_have_distinct_names() -> None:
    edges = [-1.2, -0.06, 0.06, 1.5, 2.9]
    places = [
        ErrorShare("current", low, high, "A", 0.25, 0.1, (0.2, 0.3))
        for low, high in pairwise(edges)
    ]
    (figure,) = share_figures(places)
    names = figure.plot.y_range.factors
    assert len(set(names)) == len(names)
    assert "−0.06 … 0.06" in names


def test_every_figure_has_units_and_a_caption(page: Page) -> None:
    for each in page.figures:
        assert each.caption.endswith("."), each.title
        drawn = stacked(each) if each.title[0].isdigit() else [each.plot]
        for plot in drawn:
            for axis in (plot.xaxis[0], plot.yaxis[0]):
                label = axis.axis_label or ""
                unlabelled = hasattr(plot.y_range, "factors") or not axis.visible
                assert unlabelled or re.search(r"\[.+\]$", label), (each.title, label)


def test_page_is_small_and_loads_nothing(page: Page) -> None:
    text = render(page)
    assert len(text.encode()) < MAX_PAGE_BYTES
    assert "default-src 'none'" in text
    assert "NaN" not in Html(text).text
    assert render(page).count("<figure ") == text.count("<figure ") == len(page.figures)


@pytest.mark.slow
def test_page_with_folded_details_is_short(page: Page, tmp_path: Path) -> None:
    measuring = """<script>setTimeout(() => {
      document.title = document.documentElement.scrollHeight }, 3000)</script></body>"""
    file = tmp_path / "page.html"
    file.write_text(render(page).replace("</body>", measuring), encoding="utf-8")
    assert 2000 < int(title_after_scripts(file, "1280,1000")) <= 3500


@pytest.mark.slow
def test_page_does_not_scroll_sideways_at_400_px(page: Page, tmp_path: Path) -> None:
    assert excess_width_px(render(page), tmp_path) == 0


def test_caveats_of_a_poor_log_come_first(model: Model) -> None:
    short = synthetic_log(hours=0.15, start_pct=70.0, end_pct=68.0, noise_v=0.5, name="stub")
    short = replace(short, temperature_c=np.full(len(short), 23.0))
    found = diagnose([short], model, [])
    assert found.verdict.cause == "none"
    page = gap_page(found)
    assert page.sections[0].title == "How sure this is"
    bullets = page.sections[0].blocks[-1]
    assert isinstance(bullets, Bullets)
    words = " ".join(bullets.items)
    for said in ("No cause can be named", "does not prove that there is none", "Shorter than 10",
                 "Narrow temperature range", "Narrow SoC range", "No reference logs"):  # fmt: skip
        assert said in words
    assert any(tile.label == "Floor: model file" for tile in page.tiles)


def test_a_coarse_temperature_is_a_caveat(model: Model) -> None:
    log = synthetic_log(hours=0.5, start_pct=70.0, end_pct=60.0, noise_v=0.5, name="coarse")
    coarse = replace(log, temperature_c=np.round(log.temperature_c))
    fine_caveats, caveats = (
        " ".join(diagnose([each], model, []).caveats) for each in (log, coarse)
    )
    assert "reported in steps" not in fine_caveats
    assert "reported in steps of 1 K" in caveats


def test_a_log_too_short_to_judge_on_is_refused(model: Model) -> None:
    five = synthetic_log(hours=305.0 / 3600.0, start_pct=70.0, end_pct=69.0, noise_v=0.5)
    with pytest.raises(InputError, match="nothing can be concluded"):
        diagnose([five], model, [])
