"""The page of a diagnosis: verdict, what to do, two pictures; everything else folded."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cangauge.diagnosis import Diagnosis, References, diagnose, learn_references
from cangauge.diagnosis.sentences import EXPLAINED
from cangauge.extras.report.diagnosis import gap_page
from cangauge.extras.report.page import Page
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.effects.library import LIBRARY
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
def known(model: Model) -> References:
    return learn_references([day(k) for k in (1, 2, 3)], model)


@pytest.fixture(scope="module")
def found(model: Model, known: References) -> Diagnosis:
    log = day(21)
    return diagnose([replace(log, voltage_v=log.voltage_v + 8.0)], model, known)


@pytest.fixture(scope="module")
def page(found: Diagnosis) -> Page:
    return gap_page(found)


def test_the_page_begins_with_the_verdict_and_what_to_check(found: Diagnosis, page: Page) -> None:
    assert page.lead == found.headline
    assert found.posterior.check_first in page.subtitle
    (tile,) = [tile for tile in page.tiles if tile.label == "Look first at"]
    assert tile.value in page.lead


def test_two_pictures_are_open_and_the_rest_is_folded(page: Page) -> None:
    ((beside,),) = page.sections.values()
    assert [figure.title.split(":")[0] for figure in beside] == [
        "Where",
        "How far it shrinks",
    ]
    assert "Every cause: probability and size" in page.folded


def test_page_says_the_same_as_the_json(found: Diagnosis, page: Page) -> None:
    text, gap = page.html(), found.to_json()["gap"]
    assert f"{gap['baseline_rmse_v']:.2f}" in text
    assert f"{gap['healthy_rmse_v']:.2f}" in text
    assert len(text) < MAX_PAGE_BYTES


def test_a_likely_gap_states_the_figures_that_show_it(model: Model, known: References) -> None:
    log = day(21)
    likely = diagnose([replace(log, voltage_v=log.voltage_v + 1.2)], model, known)
    assert likely.posterior.likely
    assert not likely.posterior.detected
    assert "with what the references show of this pack); a healthy log has" in likely.summary
    assert f"{likely.posterior.members[0]}, the likeliest cause, would leave 0." in likely.summary


def test_every_cause_is_explained() -> None:
    assert set(LIBRARY) <= set(EXPLAINED)
