"""The page of a diagnosis: the answer, two pictures; everything else folded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.diagnosis import Diagnosis, Healthy, diagnose, learn_references
from cangauge.extras.report.diagnosis import gap_page
from cangauge.extras.report.page import Page
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from report_html import MAX_PAGE_BYTES
from synthetic import synthetic_log


def day(seed: int) -> Log:
    return synthetic_log(
        hours=0.5, start_pct=85.0, end_pct=65.0, noise_v=0.5, seed=seed, name=f"day {seed}"
    )


@pytest.fixture(scope="module")
def model() -> Model:
    logs = [synthetic_log(noise_v=0.5, seed=seed) for seed in (1, 2)]
    return fit(logs, capacity_ah=51.5).model


@pytest.fixture(scope="module")
def known(model: Model) -> Healthy:
    return learn_references([day(k) for k in (1, 2, 3)], model)


@pytest.fixture(scope="module")
def found(model: Model, known: Healthy) -> Diagnosis:
    log = day(21)
    return diagnose([replace(log, voltage_v=log.voltage_v + 8.0)], model, known)


@pytest.fixture(scope="module")
def page(found: Diagnosis) -> Page:
    return gap_page(found)


def test_the_page_has_the_same_three_lines(found: Diagnosis, page: Page) -> None:
    assert page.lead == found.summary.splitlines()[0]
    assert page.subtitle == " ".join(found.summary.splitlines()[1:])
    (tile,) = [tile for tile in page.tiles if tile.label == "Fault"]
    assert "voltage reading" in tile.value


def test_two_pictures_are_open_and_the_rest_is_folded(page: Page) -> None:
    ((beside,),) = page.sections.values()
    assert [figure.title.split(":")[0] for figure in beside] == ["Where", "How far it shrinks"]
    assert "Every fault: probability and size" in page.folded


def test_page_says_the_same_as_the_json(found: Diagnosis, page: Page) -> None:
    text, gap = page.html(), found.to_json()["gap"]
    assert f"{gap['baseline_rmse_v']:.2f}" in text
    assert f"{gap['healthy_rmse_v']:.2f}" in text
    assert len(text) < MAX_PAGE_BYTES


def test_a_log_with_absolute_times_is_drawn_within_its_axis(model: Model, known: Healthy) -> None:
    log = day(21)
    moved = replace(log, time_s=log.time_s + 1.7e9, voltage_v=log.voltage_v + 8.0)
    page = gap_page(diagnose([moved], model, known))
    (error,) = [each for each in page.figures if each.title == "Measured minus modelled voltage"]
    for line in error.plot.renderers:
        assert np.nanmin(line.data_source.data["x"]) >= 0.0


def test_a_healthy_log_has_a_page_too(model: Model, known: Healthy) -> None:
    page = gap_page(diagnose([day(22)], model, known))
    assert page.lead.startswith("No significant gap")
    html = page.html()
    assert "Beside healthy logs" in html
    assert "Mean SoC error with the start withheld: " in html
    assert " %, corrected " not in html


def test_a_log_of_some_minutes_has_a_page_too(model: Model, known: Healthy) -> None:
    log = day(21).rows(slice(500))
    found = diagnose([replace(log, voltage_v=log.voltage_v + 8.0)], model, known)
    assert not found.where  # too short to tell where the error lies
    html = gap_page(found).html()
    assert "How far it shrinks" in html
    assert "Where else the error lies" not in html
