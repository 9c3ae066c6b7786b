"""Report pages: whole, self-contained, honest about what is missing."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from cangauge.estimate.offline import estimate_log
from cangauge.estimate.settings import EstimatorSettings
from cangauge.identify.fit import Identification, fit
from cangauge.logs.log import Log
from cangauge.report.charts import Recording, Timeline
from cangauge.report.estimate import estimate_page, estimate_report
from cangauge.report.fit import fit_page, fit_report
from cangauge.report.page import Beside, Bullets, Figure, Page, Section, Table, Tile, render
from synthetic import synthetic_log

FIT_FIGURES = [
    "Current",
    "Voltage",
    "Temperature",
    "Power",
    "Charge taken out",
    "Measured voltage, model and pseudo-OCV",
    "Pseudo-OCV against SoC",
    "Slope of the pseudo-OCV",
    "Measured minus modelled voltage",
    "How large the error is",
    "SoC from voltage alone",
    "Its error",
    "Voltage drop against current",
    "Energy at the terminals",
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
LARGEST_PAGE_BYTES = 3_000_000


class Loads(HTMLParser):
    """Collects what a page would fetch, and its text outside scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.headings: list[str] = []
        self.tables = 0
        self._open = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._open = tag
        self.tables += tag == "table"
        for name, value in attrs:
            local = (value or "").startswith("#")
            if tag == "link" or name == "src" or (name == "href" and not local):
                self.fetched.append(f"{tag} {name}={value}")

    def handle_data(self, data: str) -> None:
        if self._open in {"h2", "h3"} and data.strip():
            self.headings.append(data.strip())
        if self._open == "style":
            self.fetched += re.findall(r"@import.*|url\(.*?\)", data)

    def handle_endtag(self, _tag: str) -> None:
        self._open = ""


@pytest.fixture(scope="module")
def log() -> Log:
    return synthetic_log(hours=1.2, noise_v=0.5, name="drive")


@pytest.fixture(scope="module")
def found(log: Log) -> Identification:
    return fit([log])


def figures(page: Page) -> list[Figure]:
    blocks = [block for section in page.sections for block in section.blocks]
    inside = [figure for block in blocks if isinstance(block, Beside) for figure in block.figures]
    return [block for block in blocks if isinstance(block, Figure)] + inside


def test_fit_report_is_one_file_with_every_published_figure(found: Identification) -> None:
    page = fit_report(found)
    loads = Loads(page)
    assert loads.fetched == []
    assert "default-src 'none'" in page
    assert len(page.encode()) < LARGEST_PAGE_BYTES
    assert set(FIT_FIGURES) <= set(loads.headings)
    assert loads.tables >= 6
    for name in ("k7", "kt", "R4", "std. error", "delay line not yet full"):
        assert name in page
    assert f"{found.voltage_mae_pct:.3f} %" in page
    assert "reconstruction" not in page


def test_every_figure_has_units_on_its_axes_and_a_sentence(found: Identification, log: Log) -> None:
    table, scores = estimate_log(log, found.model, EstimatorSettings())
    pages = [fit_page(found), estimate_page(log, table, scores, found.model)]
    for figure in (item for page in pages for item in figures(page)):
        assert figure.see.endswith(".")
        for axis in (figure.plot.xaxis[0], figure.plot.yaxis[0]):
            label = axis.axis_label or ""
            named_rows = label == "" and hasattr(figure.plot.y_range, "factors")
            assert named_rows or re.search(r"\[.+\]$", label), (figure.title, label)


def test_time_figures_move_together_and_hide_by_legend(found: Identification) -> None:
    plots = [item.plot for item in figures(fit_page(found))]
    over_time = [plot for plot in plots if plot.xaxis[0].axis_label.startswith("time")]
    assert len(over_time) == 9
    assert len({plot.x_range.id for plot in over_time}) == 1
    assert all(legend.click_policy == "hide" for plot in plots for legend in plot.legend)
    assert all(any(type(tool).__name__ == "HoverTool" for tool in plot.tools) for plot in plots)


def test_long_series_are_thinned_and_the_page_says_so() -> None:
    long = synthetic_log(hours=1.2, rate_hz=10.0, noise_v=0.5, name="fast")
    page = fit_page(fit([long]))
    sources = [
        renderer.data_source
        for figure in figures(page)
        for renderer in figure.plot.renderers
        if "x" in renderer.data_source.data
    ]
    assert max(len(source.data["x"]) for source in sources) <= 4000
    assert "Lines longer than 4000 points" in render(page)
    drawn = next(item for item in figures(page) if item.title == "Current").plot.renderers[0]
    assert np.nanmax(drawn.data_source.data["y"]) == pytest.approx(long.current_a.max(), rel=1e-6)


def test_several_logs_stand_one_after_another(log: Log) -> None:
    logs = [
        log,
        synthetic_log(hours=0.4, start_pct=70.0, end_pct=50.0, seed=5, name="second & <third>"),
    ]
    page = fit_page(fit(logs))
    current = next(item for item in figures(page) if item.title == "Current").plot
    names = [item.text for item in current.center if type(item).__name__ == "Label"]
    assert names[0] == "drive"
    assert "second & <third>".startswith(names[1])
    assert any(type(item).__name__ == "Span" for item in current.center)
    html = render(page)
    assert "second &amp; &lt;third&gt;" in html
    assert "second & <third>" not in html.split("<script", maxsplit=1)[0]


def test_a_reconstruction_is_called_one(log: Log) -> None:
    named = replace(log, name="leaf2012_reconstruction_white")
    found = fit([named])
    assert "This is a reconstruction" in fit_report(found)
    table, scores = estimate_log(named, found.model, EstimatorSettings())
    assert "This is a reconstruction" in estimate_report(named, table, scores, found.model)


def test_estimate_report(found: Identification, log: Log) -> None:
    settings = EstimatorSettings(initial_soc_pct=100.0)
    table, scores = estimate_log(log, found.model, settings)
    page = estimate_report(log, table, scores, found.model, settings)
    loads = Loads(page)
    assert loads.fetched == []
    assert set(ESTIMATE_FIGURES) <= set(loads.headings)
    assert len(page.encode()) < LARGEST_PAGE_BYTES
    assert "less current has been seen than the model&#x27;s longest delay needs" in page
    assert f"{scores.soc_mae_pct:.2f} %" in page


def test_without_reference_nothing_is_compared(found: Identification, log: Log) -> None:
    bare = replace(log, soc_pct=None)
    table, scores = estimate_log(bare, found.model, EstimatorSettings())
    headings = Loads(estimate_report(bare, table, scores, found.model)).headings
    assert "Error against the reference" not in headings
    assert "How good it is" not in headings
    assert "Uncertainty" in headings


def test_a_start_alone_is_no_reference(found: Identification, log: Log) -> None:
    soc = np.full(len(log), np.nan)
    soc[0] = 100.0
    start = replace(log, soc_pct=soc)
    table, scores = estimate_log(start, found.model, EstimatorSettings(initial_soc_pct=100.0))
    headings = Loads(estimate_report(start, table, scores, found.model)).headings
    assert "Error against the reference" not in headings


@pytest.mark.parametrize("rows", [1, 2, 30])
def test_short_logs_still_give_a_page(found: Identification, log: Log, rows: int) -> None:
    short = log.rows(slice(0, rows))
    table, scores = estimate_log(short, found.model, EstimatorSettings())
    loads = Loads(estimate_report(short, table, scores, found.model))
    assert "Estimated state of charge" in loads.headings


def test_samples_without_voltage_or_any_estimate(found: Identification, log: Log) -> None:
    few = log.rows(slice(0, 60))
    table, scores = estimate_log(few, found.model, EstimatorSettings())
    nothing = np.full(60, np.nan)
    table = replace(
        table,
        **{name: nothing for name in vars(table) if name not in {"time_s", "status", "reasons"}},
    )
    recording = Recording(
        few.time_s, few.current_a, nothing, nothing, nothing, "parked", "", "pack", ()
    )
    page = estimate_report(recording, table, replace(scores, soc_mae_pct=None), found.model)
    assert "State of charge of parked" in page
    assert "NaN" not in re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_start_up_rows_stay_out_of_the_frame(found: Identification, log: Log) -> None:
    volts = log.voltage_v.copy()
    volts[2000:2030] = 0.5
    dipped = replace(log, voltage_v=volts)
    page = fit_page(fit([dipped]))
    voltage = next(item for item in figures(page) if item.title == "Voltage")
    assert voltage.plot.y_range.start > 200.0
    assert "below the frame" in voltage.see


def test_lines_break_over_gaps_and_between_logs() -> None:
    def make(time_s: list[float]) -> Log:
        n = len(time_s)
        return Log(np.array(time_s), np.zeros(n), np.ones(n), np.ones(n))

    logs = [make([100.0, 101.0, 102.0, 110.0, 111.0]), make([5.0, 6.0, 7.0])]
    timeline = Timeline.of(logs)
    x, y = timeline.line([(item.time_s, item.time_s) for item in logs])
    nan = np.nan
    expected = [100.0, 101.0, 102.0, nan, 110.0, 111.0, nan, 5.0, 6.0, 7.0, nan]
    assert np.array_equal(y, expected, equal_nan=True)
    assert np.all(np.diff(x) >= 0.0)
    assert x[0] == 0.0
    assert timeline.end == pytest.approx(x[-1])


def test_page_escapes_what_it_shows() -> None:
    page = Page(
        title="<b>title</b>",
        subtitle="a & b",
        tiles=[Tile("<i>", "1 < 2")],
        sections=[Section("<s>", [Table(["<h>"], [["<c>"]], "<n>"), Bullets(["<li>"])])],
        banners=["<banner>"],
    )
    html = render(page)
    for text in ("<b>title", "<i>", "<s>", "<h>", "<c>", "<n>", "<li><li>", "<banner>"):
        assert text not in html
    assert "&lt;b&gt;title&lt;/b&gt;" in html


@pytest.mark.slow
def test_a_browser_draws_every_figure(found: Identification, tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium on this machine")
    path = tmp_path / "fit.html"
    # The drawings live in shadow roots, which a dump leaves out: the page itself counts them.
    counting = """<script>setTimeout(() => {
      let found = 0;
      const walk = root => { for (const e of root.querySelectorAll('*')) {
        if (e.tagName === 'CANVAS' && e.width > 100) found++;
        if (e.shadowRoot) walk(e.shadowRoot); } };
      walk(document); document.title = 'drawn ' + found; }, 3000)</script>"""
    path.write_text(fit_report(found).replace("</body>", counting + "</body>"), encoding="utf-8")
    dumped = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=8000",
         "--window-size=1300,9000", "--dump-dom", path.as_uri()],
        capture_output=True, text=True, timeout=60, check=True,
    ).stdout  # fmt: skip
    drawn = re.search(r"<title>drawn (\d+)", dumped)
    assert drawn
    assert int(drawn.group(1)) >= len(FIT_FIGURES)
