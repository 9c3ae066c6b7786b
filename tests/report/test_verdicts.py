"""The sentence on top of a page: what was found, in words, from the numbers."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cangauge.cli.app import app
from cangauge.errors import InputError
from cangauge.estimation.offline import estimate_log
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.report.estimate import estimate_page, estimate_verdict
from cangauge.extras.report.inspection import inspect_page
from cangauge.identify.fit import fit
from cangauge.identify.identification import Identification
from cangauge.inspect.log import inspect_log
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.published import CAPACITY_AH
from cangauge.service.offline import RecordedEstimate
from cangauge.types import Reason, Status
from report_html import MAX_PAGE_BYTES, Html
from synthetic import synthetic_log


@pytest.fixture(scope="module")
def log() -> Log:
    return synthetic_log(hours=1.0, start_pct=88.0, end_pct=42.0, noise_v=0.5, name="drive")


@pytest.fixture(scope="module")
def found(log: Log) -> Identification:
    return fit([log], capacity_ah=CAPACITY_AH)


@pytest.fixture(scope="module")
def estimate(found: Identification, log: Log) -> RecordedEstimate:
    settings = EstimatorSettings()
    return RecordedEstimate(log, *estimate_log(log, found.model, settings), found.model, settings)


def degraded(estimate: RecordedEstimate, *spans: tuple[int, int]) -> RecordedEstimate:
    """Return the estimate, valid but for rows without a temperature."""
    status = np.full(len(estimate.table), Status.VALID)
    reasons = np.zeros(status.size, dtype=np.int64)
    for begin, end in spans:
        status[begin:end] = Status.DEGRADED
        reasons[begin:end] = Reason.TEMPERATURE_MISSING
    return replace(
        estimate,
        table=replace(estimate.table, status=status, reasons=reasons),
        scores=replace(estimate.scores, valid_fraction=float(np.mean(status == Status.VALID))),
    )


def test_fit_states_range_and_what_is_missing(found: Identification) -> None:
    text = found.verdict
    low, high = found.model.range.soc_pct  # as the terminal prints it
    assert text.startswith(f"Fitted from {low:.0f} to {high:.0f} % SoC: mean voltage error ")
    assert f"on {found.model.noise.judged_on}. Add a drive below 42 % and above 87 %: " in text


def test_fit_over_a_full_discharge_lacks_no_range() -> None:
    text = fit([synthetic_log(hours=1.2, noise_v=0.5, name="full")]).verdict
    assert text.startswith("Fitted from 1 to 98 % SoC")
    assert "Add a drive" not in text


def test_constant_temperature_leaves_kt_unidentified(log: Log) -> None:
    level = replace(log, temperature_c=np.full(len(log), 24.0))
    text = fit([level], capacity_ah=CAPACITY_AH).verdict
    assert "No temperature dependence: the logs have one temperature, within 0.0 K." in text


def test_a_parked_hour_identifies_nothing(log: Log) -> None:
    parked = replace(log, current_a=np.full(len(log), 0.2), voltage_v=np.full(len(log), 380.0))
    text = fit([parked], capacity_ah=CAPACITY_AH, initial_soc_pct=80.0).verdict
    assert text.startswith("The logs identify nothing: the SoC moves by 0.4 %, the current by 0.0")


def test_estimate_states_error_and_longest_period(estimate: RecordedEstimate, log: Log) -> None:
    estimate = degraded(estimate, (700, 940), (2000, 2010))
    text = estimate_verdict(estimate)
    assert text.startswith(f"SoC within {estimate.scores.soc_max_pct:.1f} % of the log's own")
    assert "degraded from 0:11:40 to 0:15:40 because the sample has no temperature" in text
    assert text.endswith("the longest of 2 periods.")


def test_estimate_without_reference_states_its_sigma(estimate: RecordedEstimate, log: Log) -> None:
    estimate = replace(degraded(estimate), recorded=replace(log, soc_pct=None))
    text = estimate_verdict(estimate)
    assert re.match(
        r"SoC from [\d.]+ to [\d.]+ % \(±[\d.]+ % at the end, 2σ\); valid through", text
    )


def test_estimate_that_never_was_valid_says_so(estimate: RecordedEstimate, log: Log) -> None:
    estimate = degraded(estimate, (0, len(log)))
    assert "; never valid; degraded from 0:00:00" in estimate_verdict(estimate)


def test_initialising_is_no_period(estimate: RecordedEstimate) -> None:
    estimate = degraded(estimate, (700, 940))
    estimate.table.status[:600] = Status.INITIALISING
    text = estimate_verdict(estimate)
    assert "degraded from 0:11:40" in text
    assert "periods" not in text


def test_every_link_has_its_anchor_and_each_id_is_unique(estimate: RecordedEstimate) -> None:
    page = estimate_page(degraded(estimate, (700, 940))).html()
    markup = re.sub(r"<(script|style).*?</\1>", "", page, flags=re.DOTALL)
    ids = re.findall(r' id="([^"]+)"', markup)
    assert len(set(ids)) == len(ids)
    assert set(re.findall(r'href="#([^"]+)"', markup)) <= set(ids)


def test_the_page_of_a_log_leads_with_what_the_command_says_first(log: Log) -> None:
    found = inspect_log(log)
    assert found.answer[1:] in inspect_page(found, log).html()


@pytest.mark.parametrize("rows", [1, 10])
def test_a_short_log_still_gives_a_page(log: Log, rows: int) -> None:
    short = log.rows(slice(0, rows))
    assert "Recorded data" in Html(inspect_page(inspect_log(short), short).html()).headings


def test_inspect_writes_an_offline_page(log: Log, tmp_path: Path) -> None:
    path, report = tmp_path / "drive.csv", tmp_path / "drive.html"
    write_log(log, path)
    done = CliRunner().invoke(app, ["inspect", str(path), "--report", str(report)])
    assert done.exit_code == 0, done.output
    page = report.read_text(encoding="utf-8")
    html = Html(page)
    assert html.fetched == []
    assert {"Current", "Voltage", "Temperature", "What this log can identify"} <= set(html.headings)
    assert len(page.encode()) < MAX_PAGE_BYTES


def test_inspect_never_overwrites_its_log(log: Log, tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    write_log(log, path)
    done = CliRunner().invoke(app, ["inspect", str(path), "--report", str(path)])
    assert isinstance(done.exception, InputError)
    assert path.read_text(encoding="utf-8").startswith("time_s")
