"""Report pages: whole, self-contained, honest about what is missing."""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape

from cangauge._version import __version__
from cangauge.bus.decoder import FrameStatistics
from cangauge.bus.recording import CaptureSamples, read_log
from cangauge.estimation.offline import estimate_log
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.report.charts import Figure, TimeFigures
from cangauge.extras.report.estimate import estimate_page
from cangauge.extras.report.fit import fit_page
from cangauge.extras.report.page import Page, Table, Tile, joined
from cangauge.identify.fit import fit
from cangauge.identify.identification import Identification
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.service.offline import RecordedEstimate
from cangauge.types import REASON_WORDS, Reason
from report_html import MAX_PAGE_BYTES, Html
from synthetic import synthetic_log

FIT_FIGURES = [
    "Current",
    "Voltage",
    "Temperature",
    "Measured voltage, model and pseudo-OCV",
    "Pseudo-OCV against SoC",
    "Slope of the pseudo-OCV",
    "Measured minus modelled voltage",
    "Distribution of the error",
    "SoC from voltage alone",
    "Voltage drop against current",
]
ESTIMATE_FIGURES = [
    "Estimated state of charge",
    "Error against the reference",
    "Measured and modelled voltage",
    "Measured minus modelled voltage",
    "Current",
    "Temperature",
    "Status over time",
]


@pytest.fixture(scope="module")
def log() -> Log:
    return synthetic_log(hours=1.2, noise_v=0.5, name="drive")


@pytest.fixture(scope="module")
def found(log: Log) -> Identification:
    return fit([log])


def estimated(
    log: Log, model: Model, settings: EstimatorSettings | None = None
) -> RecordedEstimate:
    settings = settings or EstimatorSettings()
    return RecordedEstimate(log, *estimate_log(log, model, settings), model, settings)


def figure(page: Page, title: str) -> Figure:
    return next(item for item in page.figures if item.title == title)


def test_fit_report_is_one_file_with_every_published_figure(found: Identification) -> None:
    page = fit_page(found).html()
    html = Html(page)
    assert html.fetched == []
    assert "default-src 'none'" in page
    assert len(page.encode()) < MAX_PAGE_BYTES
    assert set(FIT_FIGURES) <= set(html.headings)
    assert html.tables >= 6
    for name in ("k7", "kt", "R4", "std. error", "delay line not yet full"):
        assert name in page
    assert f"{found.voltage_mae_pct:.3f} %" in page
    assert "reconstruction" not in page


def test_figures_have_units_on_their_axes_and_a_caption(found: Identification, log: Log) -> None:
    pages = [fit_page(found), estimate_page(estimated(log, found.model))]
    for item in (item for page in pages for item in page.figures):
        assert item.caption.endswith(".")
        for axis in (item.plot.xaxis[0], item.plot.yaxis[0]):
            label = axis.axis_label or ""
            named_rows = label == "" and hasattr(item.plot.y_range, "factors")
            assert named_rows or re.search(r"\[.+\]$", label), (item.title, label)


def test_time_figures_move_together_and_hide_by_legend(found: Identification) -> None:
    plots = [item.plot for item in fit_page(found).figures]
    over_time = [plot for plot in plots if plot.xaxis[0].axis_label.startswith("time")]
    assert len(over_time) == 6
    assert len({plot.x_range.id for plot in over_time}) == 1
    assert all(legend.click_policy == "hide" for plot in plots for legend in plot.legend)
    assert all(any(type(tool).__name__ == "HoverTool" for tool in plot.tools) for plot in plots)


def test_long_series_are_reduced_and_the_page_says_so() -> None:
    long = synthetic_log(hours=1.2, rate_hz=10.0, noise_v=0.5, name="fast")
    page = fit_page(fit([long]))
    sources = [
        renderer.data_source
        for item in page.figures
        for renderer in item.plot.renderers
        if "x" in renderer.data_source.data
    ]
    assert max(len(source.data["x"]) for source in sources) <= 4000
    assert "Lines longer than 4000 points" in page.html()
    drawn = figure(page, "Current").plot.renderers[0]
    assert np.nanmax(drawn.data_source.data["y"]) == pytest.approx(long.current_a.max(), rel=1e-6)


def test_several_logs_follow_one_another(log: Log) -> None:
    logs = [
        log,
        synthetic_log(hours=0.4, start_pct=70.0, end_pct=50.0, seed=5, name="second & <third>"),
    ]
    page = fit_page(fit(logs))
    current = figure(page, "Current").plot
    names = [item.text for item in current.center if type(item).__name__ == "Label"]
    assert names[0] == "drive"
    assert "second & <third>".startswith(names[1])
    assert any(type(item).__name__ == "Span" for item in current.center)
    html = page.html()
    assert "second &amp; &lt;third&gt;" in html
    assert "second & <third>" not in html.split("<script", maxsplit=1)[0]


def test_pages_name_version_date_hashed_inputs_and_a_reconstruction(
    log: Log, tmp_path: Path
) -> None:
    path = tmp_path / "leaf2012_reconstruction_drive.csv"
    write_log(log.rows(slice(None, None, 4)), path)
    log = read_log(path)
    found = fit([log])
    model_path = tmp_path / "model.json"
    found.model.save(model_path)
    paths = (path, model_path)
    hashes = [hashlib.sha256(path.read_bytes()).hexdigest()[:12] for path in paths]
    pages = [fit_page(found).html(), estimate_page(estimated(log, found.model), model_path).html()]
    for page in pages:
        text = Html(page).text
        for words in (f"cangauge {__version__}", "drive", *(f">{digits}<" for digits in hashes)):
            assert words in text
        assert re.search(r"\b20\d\d-\d\d-\d\d \d\d:\d\d UTC", text)
        assert re.search(r"<title>.*drive.*</title>", page)
        assert "This is a reconstruction" in page


def test_estimate_report(found: Identification, log: Log) -> None:
    estimate = estimated(log, found.model, EstimatorSettings(initial_soc_pct=100.0))
    page = estimate_page(estimate).html()
    html = Html(page)
    assert html.fetched == []
    assert set(ESTIMATE_FIGURES) <= set(html.headings)
    assert len(page.encode()) < MAX_PAGE_BYTES
    assert str(escape(REASON_WORDS[Reason.DELAY_LINE_FILLING])) in page
    assert f"{estimate.scores.soc_mae_pct:.2f} %" in page


def test_without_reference_nothing_is_compared(found: Identification, log: Log) -> None:
    headings = Html(
        estimate_page(estimated(replace(log, soc_pct=None), found.model)).html()
    ).headings
    assert "Error against the reference" not in headings
    assert "Uncertainty" in headings


def test_an_initial_value_is_no_reference(found: Identification, log: Log) -> None:
    soc = np.full(len(log), np.nan)
    soc[0] = 100.0
    settings = EstimatorSettings(initial_soc_pct=100.0)
    estimate = estimated(replace(log, soc_pct=soc), found.model, settings)
    assert "Error against the reference" not in Html(estimate_page(estimate).html()).headings


@pytest.mark.parametrize("rows", [1, 30])
def test_short_logs_still_give_a_page(found: Identification, log: Log, rows: int) -> None:
    estimate = estimated(log.rows(slice(0, rows)), found.model)
    assert "Estimated state of charge" in Html(estimate_page(estimate).html()).headings


def test_samples_without_voltage_or_any_estimate(found: Identification, log: Log) -> None:
    few = log.rows(slice(0, 60))
    estimate = estimated(few, found.model)
    nothing = np.full(60, np.nan)
    numbers = set(vars(estimate.table)) - {"time_s", "status", "reasons"}
    page = estimate_page(
        replace(
            estimate,
            recorded=CaptureSamples(
                few.time_s,
                few.current_a,
                nothing,
                nothing,
                nothing,
                "parked.log",
                "pack",
                FrameStatistics(),
                (),
            ),
            table=replace(estimate.table, **dict.fromkeys(numbers, nothing)),
            scores=replace(estimate.scores, soc_mae_pct=None),
        )
    ).html()
    assert "State of charge of parked" in page
    assert "NaN" not in Html(page).text


def test_start_up_rows_stay_out_of_the_figure(found: Identification, log: Log) -> None:
    volts = log.voltage_v.copy()
    volts[2000:2030] = 0.5
    voltage = figure(fit_page(fit([replace(log, voltage_v=volts)])), "Voltage")
    assert voltage.plot.y_range.start > 200.0
    assert "below the figure" in voltage.caption


def test_lines_break_over_gaps_and_between_logs() -> None:
    def make(time_s: list[float]) -> Log:
        n = len(time_s)
        return Log(np.array(time_s), np.zeros(n), np.ones(n), np.ones(n))

    logs = [make([100.0, 101.0, 102.0, 110.0, 111.0]), make([5.0, 6.0, 7.0])]
    time = TimeFigures([item.time_s for item in logs])
    x, y = time.joined([(item.time_s, item.time_s) for item in logs])
    nan = np.nan
    expected = [100.0, 101.0, 102.0, nan, 110.0, 111.0, nan, 5.0, 6.0, 7.0, nan]
    assert np.array_equal(y, expected, equal_nan=True)
    assert np.all(np.diff(x) >= 0.0)
    assert x[0] == 0.0
    assert time.end == pytest.approx(x[-1])


def test_page_escapes_what_it_shows() -> None:
    page = Page(
        title="<b>title</b>",
        lead="<lead>",
        subtitle="a & b",
        tiles=[Tile("<i>", "1 < 2")],
        sections={"<s>": [Table(["<h>"], [["<c>"]], "<n>"), ["<li>"]]},
        warnings=["<banner>"],
    )
    html = page.html()
    for text in ("<b>title", "<lead>", "<i>", "<s>", "<h>", "<c>", "<n>", "<li><li>", "<banner>"):
        assert text not in html
    assert "&lt;b&gt;title&lt;/b&gt;" in html


def test_columns_of_numbers_are_flush_right() -> None:
    table = Table(["name", "value"], [["a", "−1.5"], ["b", "–"]])
    html = Page("t", "", "", [], {"s": [table]}).html()
    assert '<th scope="col">name</th><th class="number" scope="col">value</th>' in html
    assert '<td>a</td><td class="number">−1.5</td>' in html


def test_titles_name_a_few_logs_and_count_the_rest() -> None:
    assert joined(["a", "b", "c"]) == "a, b, c"
    assert joined(["a", "b", "c", "d", "e"]) == "a, b and 3 more"
