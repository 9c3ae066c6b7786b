"""The public face: faults are named, sized and undone, and no sentence contradicts the alarm."""

from __future__ import annotations

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from days import FAULTS, day, more_amperes, more_resistance, more_volts

from cangauge.diagnosis import GROUP_OF, Diagnosis, References, diagnose
from cangauge.diagnosis.answer import CHECKS, TITLES
from cangauge.errors import InputError
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

UNPROVED = {"current_offset", "initial_soc"}
"""Faults that do not stand out in these logs, whose SoC proves no cause: it is counted with the
wrong current, or from the wrong start."""


@pytest.fixture(scope="module")
def healthy(known: References, model: Model) -> Diagnosis:
    return diagnose([day(20)], model, known)


@pytest.fixture(scope="module", params=FAULTS)
def faulty(request: pytest.FixtureRequest, known: References, model: Model) -> Diagnosis:
    fault, size = FAULTS[request.param]
    return diagnose([replace(fault(day(20), size), name=request.param)], model, known)


def test_a_fault_of_two_floors_is_in_the_stated_groups(faulty: Diagnosis) -> None:
    effect = faulty.logs[0].name
    assert faulty.posterior.detected
    assert GROUP_OF[effect] in faulty.posterior.stated_groups
    assert effect in faulty.posterior.credible_set


def test_the_extended_model_is_better_on_held_out_rows(faulty: Diagnosis) -> None:
    if faulty.accepted is None:
        assert faulty.logs[0].name in UNPROVED
        assert faulty.extended_rmse_v == faulty.baseline_rmse_v
        return
    assert faulty.extended_rmse_v < faulty.baseline_rmse_v
    closed, ci = faulty.closed_fraction, faulty.closed_fraction_ci
    assert closed is not None
    assert closed > 0.5
    assert ci is not None
    assert ci[0] <= closed <= ci[1] or closed == pytest.approx(ci[1], abs=0.05)


def test_the_extended_model_runs_as_a_file(faulty: Diagnosis, tmp_path: Path) -> None:
    path = f"{tmp_path}/extended.json"
    faulty.extended_model.save(path)
    loaded = Model.load(path)
    assert [entry["id"] for entry in loaded.effects] == (
        [] if faulty.accepted in {None, "initial_soc"} else [faulty.accepted]
    )


def certain(found: Diagnosis, **probabilities: float) -> Diagnosis:
    """The same evidence with probabilities of some answers, and none of the others."""
    stated = dict.fromkeys(found.posterior.probabilities, 0.0) | probabilities
    return replace(found, posterior=replace(found.posterior, probabilities=stated))


def test_only_what_stands_out_is_accepted_without_a_soc(known: References, model: Model) -> None:
    found = diagnose([more_amperes(day(20), 6.0)], model, known)
    assert found.soc_errors_pct is None
    tied = certain(found, current_offset=0.5, current_gain=0.4, unknown=0.1)
    assert tied.accepted is None
    assert "No extended model: current_offset does not stand out." in tied.summary
    assert tied.extended_model == model
    assert certain(found, current_offset=0.8, current_gain=0.2).accepted == "current_offset"


@pytest.mark.parametrize(
    ("after_pct", "accepted"), [(0.4, (True, True)), (0.9, (True, False)), (1.3, (False, False))]
)
def test_a_cause_that_makes_the_soc_worse_is_not_added(
    known: References,
    model: Model,
    monkeypatch: pytest.MonkeyPatch,
    after_pct: float,
    accepted: tuple[bool, bool],
) -> None:
    """Where it stands out, and where it shares its group with another that closes as much."""
    monkeypatch.setattr(
        Diagnosis, "_soc_error_pct", lambda self, of: 1.0 if of is self.model else after_pct
    )
    found = diagnose([more_volts(day(20), 5.0)], model, known)
    alone = certain(found, voltage_offset=1.0)
    tied = certain(found, voltage_offset=0.5, voltage_gain=0.5)
    assert tuple(each.accepted is not None for each in (alone, tied)) == accepted
    assert ("No extended model" in tied.summary) is not accepted[1]


def test_a_soc_counted_from_a_suspect_start_proves_nothing(known: References, model: Model) -> None:
    found = diagnose([more_volts(day(20), 5.0)], model, known)
    assert found.soc_errors_pct is not None
    assert found.accepted is not None
    suspect = certain(found, voltage_offset=0.5, initial_soc=0.4, voltage_gain=0.1)
    assert suspect.soc_errors_pct is None
    assert suspect.accepted is None
    assert "their SoC proves nothing" in suspect.summary


def test_a_resistance_that_has_grown_is_no_step(known: References, model: Model) -> None:
    found = diagnose([more_resistance(day(20), 0.15)], model, known)
    step = found.evidence.effects["resistance_step"]
    assert step.in_logs == (0.0,)
    named = certain(found, resistance_step=1.0)
    assert named.headline.startswith("The resistance has grown by 0.")
    assert named.accepted == "resistance_step"


def test_no_sentence_contradicts_the_alarm(faulty: Diagnosis, healthy: Diagnosis) -> None:
    for found in (faulty, healthy):
        quiet = "No significant gap" in found.summary
        assert quiet is not found.posterior.detected
        assert (CHECKS["none"] in found.summary) is False
        assert "worse" not in found.summary
    assert TITLES[faulty.posterior.stated_groups[0]].split(",")[0] in faulty.summary


def test_a_healthy_log_gives_no_alarm(healthy: Diagnosis, model: Model) -> None:
    assert not healthy.posterior.detected
    assert healthy.accepted is None
    assert healthy.extended_model == model
    assert healthy.closed_fraction is None
    assert "would have shown" in healthy.summary


def test_a_size_has_an_interval_that_covers(known: References, model: Model) -> None:
    held = []
    for seed in (20, 22):
        for amperes in (4.0, -6.0):
            found = diagnose([more_amperes(day(seed), amperes)], model, known)
            ci = found.parameters["current_offset"]["offset_a"].ci
            assert ci is not None
            held.append(ci[0] <= amperes <= ci[1])
    assert np.mean(held) >= 0.8


def test_json_is_schema_3(faulty: Diagnosis) -> None:
    found = faulty.to_json("x.json")
    again = json.loads(json.dumps(found, allow_nan=False))
    assert again["schema"] == 3
    cause = again["cause"]
    assert sum(item["probability"] for item in cause["groups"]) == pytest.approx(1.0)
    assert len(cause["candidates"]) == len(GROUP_OF)
    assert {item["effect"] for item in again["visible_from"]} == set(GROUP_OF)
    assert again["gap"]["healthy_rmse_v"] == faulty.healthy_rmse_v
    for axis in ("soc", "current", "temperature", "rest", "time", "timescale"):
        assert sum(x["share"] for x in again["where"] if x["axis"] == axis) == pytest.approx(1.0)
    assert again["extended_model"] == "x.json"


def test_several_logs_share_one_cause(known: References, model: Model) -> None:
    found = diagnose([more_volts(day(seed), 4.0) for seed in (20, 21)], model, known)
    assert "sensors_and_count" in found.posterior.stated_groups
    assert len(found.log_errors) == 2


def test_references_learned_before_give_the_same(
    references: list[Log], known: References, model: Model
) -> None:
    log = more_volts(day(20), 3.0)
    one, other = diagnose([log], model, references), diagnose([log], model, known)
    assert one.posterior.probabilities == other.posterior.probabilities
    assert one.extended_rmse_v == other.extended_rmse_v


def test_files_are_logs_and_models(
    references: list[Log], known: References, model: Model, tmp_path: Path
) -> None:
    write_log(day(20), tmp_path / "monday.csv")
    model.save(tmp_path / "pack.json")
    found = diagnose(str(tmp_path / "monday.csv"), tmp_path / "pack.json", known)
    assert found.logs[0].name == "monday"
    assert found.model == model


def test_an_effect_can_be_taken_out_of_the_library(known: References, model: Model) -> None:
    found = diagnose([more_volts(day(20), 5.0)], model, known, without=["voltage_offset"])
    assert "voltage_offset" not in found.posterior.probabilities
    assert sum(found.posterior.probabilities.values()) == pytest.approx(1.0)


def test_the_model_is_the_reference_where_none_is_given(model: Model) -> None:
    found = diagnose([more_volts(day(20), 12.0)], model)
    assert "No reference log" in found.summary
    assert found.posterior.groups["sensors_and_count"] == max(
        p for group, p in found.posterior.groups.items() if group in TITLES
    )
    assert not diagnose([day(20)], model).posterior.detected


def test_a_start_is_found_from_the_voltage_and_said(known: References, model: Model) -> None:
    found = diagnose([replace(day(20), soc_pct=None)], model, known)
    assert "states no SoC" in " ".join(found.caveats)
    assert not found.posterior.detected
    given = diagnose([replace(day(20), soc_pct=None)], model, known, initial_soc_pct=85.0)
    assert "states no SoC" not in " ".join(given.caveats)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda log: log.rows(log.time_s < 200.0), "too short"),
        (lambda log: replace(log, voltage_v=2.0 * log.voltage_v), "another pack"),
        (lambda log: replace(log, current_a=0.0 * log.current_a), "constant"),
        (lambda log: replace(log, current_a=12.0 * log.current_a), "no start explains it"),
    ],
)
def test_what_cannot_be_diagnosed_is_refused(
    known: References, model: Model, change: object, word: str
) -> None:
    with pytest.raises(InputError, match=word):
        diagnose([change(day(20))], model, known)  # type: ignore[operator]


class Cells(HTMLParser):
    """Open tags, and the text of every table cell."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.cells: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)
        self.cells += [""] if tag in {"td", "th"} else []

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1] in {"td", "th"}:
            self.cells[-1] += data


def test_a_notebook_shows_the_answer(known: References, model: Model) -> None:
    log = replace(more_volts(day(20), 5.0).rows(slice(0, 500)), name="<b>day & night</b>")
    found = diagnose([log], model, known)
    shown = Cells(found._repr_html_())
    assert not shown.open  # every tag is closed, and the log's name is text
    assert "&lt;b&gt;day &amp; night&lt;/b&gt; is shorter" in found._repr_html_()
    assert shown.cells[:2] == ["cause", "probability"]
    assert shown.cells[4] == next(iter(found.posterior.effects)).replace("_", " ")
    assert shown.cells[-8::4] == ["unknown", "none"]
    assert found.headline in repr(found)


def test_no_log_starts_beyond_full(known: References, model: Model) -> None:
    full = [replace(day(20), soc_pct=None)]
    found = diagnose(full, model, known, initial_soc_pct=100.0)
    assert found.evidence.effects["initial_soc"].size >= -2.0


def test_a_log_is_not_its_own_reference(references: list[Log], model: Model) -> None:
    with pytest.raises(InputError, match="same rows"):
        diagnose([references[0]], model, references)


def test_a_single_wrong_row_is_no_fault(known: References, model: Model) -> None:
    log = day(20)
    volts = log.voltage_v.copy()
    volts[500] = 700.0
    assert not diagnose([replace(log, voltage_v=volts)], model, known).posterior.detected
