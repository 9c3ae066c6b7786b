"""The public face: faults are stated, sized and undone, and no sentence contradicts the alarm."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from days import (
    FAULTS,
    day,
    more_amperes,
    more_resistance,
    more_volts,
    resistance_step,
    scaled_volts,
    wrong_start,
)

from cangauge.diagnosis import FAULTS as NINE
from cangauge.diagnosis import Diagnosis, Healthy, Posterior, diagnose
from cangauge.diagnosis.model_check import ModelCheck
from cangauge.diagnosis.shapes import shapes
from cangauge.diagnosis.text import plan_text, sentence
from cangauge.errors import InputError
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.effects.base import Effect, Parameter
from cangauge.model.effects.library import LIBRARY
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file


@pytest.fixture(scope="module")
def healthy(known: Healthy, model: Model) -> Diagnosis:
    return diagnose([day(20)], model, known)


@pytest.fixture(scope="module", params=FAULTS)
def faulty(request: pytest.FixtureRequest, known: Healthy, model: Model) -> Diagnosis:
    fault, size = FAULTS[request.param]
    logs = [replace(fault(day(seed), size), name=request.param) for seed in (20, 21)]
    return diagnose(logs, model, known)


def judged(found: Diagnosis, none: float = 0.0, **effects: float) -> Diagnosis:
    """The same evidence with given probabilities; a fault is stated alone from 0.9."""
    every = dict.fromkeys(LIBRARY, 0.0) | {"none": none, "unknown": 0.0} | effects
    return replace(found, posterior=Posterior(every, alarm=0.05, stated_from=0.9))


def test_a_fault_of_two_floors_is_stated(faulty: Diagnosis) -> None:
    assert faulty.posterior.level != "none"
    assert faulty.logs[0].name in faulty.posterior.stated


def test_the_corrected_model_is_better_on_the_log_left_out(faulty: Diagnosis) -> None:
    assert faulty.correction is not None
    assert faulty.extended_rmse_v < 0.7 * faulty.baseline_rmse_v
    assert faulty.to_json()["gap"]["on"] == "left-out log"
    closed, ci = faulty.closed
    assert closed is not None
    assert closed > 0.5
    assert ci is not None
    assert ci[0] - 0.05 <= closed <= ci[1] + 0.05


def test_the_corrected_model_runs_as_a_file(faulty: Diagnosis, tmp_path: Path) -> None:
    path = f"{tmp_path}/corrected.json"
    faulty.extended_model.save(path)
    loaded = Model.load(path)
    assert faulty.correction is not None
    effect = faulty.correction.evidence.shape.effect
    written = [] if effect.fault == "start" else [effect.id]
    assert [entry["id"] for entry in loaded.effects] == written
    assert faulty.is_written is bool(written)


def test_three_lines_answer(faulty: Diagnosis) -> None:
    what, how_far, _ = faulty.summary.splitlines()
    assert "Likelihood: " in what
    assert "→" in how_far
    assert "healthy logs of this pack have" in how_far
    assert faulty.summary == faulty.to_json()["answer"]["text"]


def test_offset_and_gain_of_the_voltage_are_one_fault(known: Healthy, model: Model) -> None:
    found = diagnose([scaled_volts(day(seed), 1.02) for seed in (20, 21)], model, known)
    assert found.posterior.stated[0] == "voltage_reading"
    assert "The pack voltage reads" in found.summary
    assert "too high" in found.summary
    assert "Put a meter on the pack's terminals" in found.summary
    assert found.is_written


def test_a_grown_resistance_has_a_size(known: Healthy, model: Model) -> None:
    found = diagnose([more_resistance(day(seed), 0.08) for seed in (20, 21)], model, known)
    assert found.posterior.stated[0] == "resistance"
    assert found.summary.startswith("The resistance has grown by 0.")
    assert found.extended_rmse_v < 0.5 * found.baseline_rmse_v


def test_the_own_soc_of_a_log_is_evidence_of_the_current(known: Healthy, model: Model) -> None:
    """The car's SoC beside a count with a current that is 6 A too high."""
    logs = [day(seed) for seed in (20, 21)]
    faulty = [replace(log, current_a=log.current_a + 6.0) for log in logs]
    without = [more_amperes(log, 6.0) for log in logs]
    seen, unseen = (diagnose(each, model, known) for each in (faulty, without))
    faults = seen.posterior.faults, unseen.posterior.faults
    assert faults[0]["current_reading"] + faults[0]["capacity"] > 0.8
    assert faults[0]["current_reading"] + faults[0]["capacity"] >= (
        faults[1]["current_reading"] + faults[1]["capacity"]
    )


def test_a_gauge_that_stands_still_in_a_reference_says_nothing(
    references: list[Log], model: Model
) -> None:
    short = day(14).rows(slice(0, 400))
    still = replace(short, soc_pct=np.full(len(short), 85.0), name="still")
    found = diagnose([more_volts(day(20), 6.0)], model, [*references, still])
    assert found.posterior.level == "gap"
    assert "voltage_reading" in found.posterior.stated


def test_a_reference_at_soc_of_its_own_shows_no_healthy_error(
    references: list[Log], known: Healthy, model: Model
) -> None:
    """Its error is that of a curve that nobody has seen."""
    empty = wrong_start(replace(day(14), name="elsewhere"), 45.0)
    found = diagnose([day(20)], model, [*references, empty])
    assert found.healthy_rmse_v < 1.5 * known.rmse_v


def test_the_surer_the_answer_the_step_stays(known: Healthy, model: Model) -> None:
    found = diagnose([FAULTS["clock"][0](day(seed), 2.0) for seed in (20, 21)], model, known)
    assert found.posterior.faults["clock"] > 0.8
    step = found.to_json()["next_step"]
    assert step["measurement"] == "the time stamps of a sharp pulse"
    assert step["between"][0] == "clock"
    assert step["probability_after"] >= step["probability_now"]


def test_where_is_an_excess(known: Healthy, model: Model) -> None:
    everywhere = diagnose([more_volts(day(20), 6.0)], model, known)
    assert "The error is alike everywhere" in everywhere.summary
    late = day(20)
    half = late.time_s > 0.6 * late.duration_s
    found = diagnose([replace(late, voltage_v=late.voltage_v + 8.0 * half)], model, known)
    assert "alike everywhere" not in found.summary
    for place in found.where:
        assert place["ci"][0] <= place["excess"] * 1.2
        assert place["axis"] in {"soc", "temperature", "current", "rest", "time"}


def test_a_model_of_another_resistance_is_told_first(references: list[Log], model: Model) -> None:
    assert model.loads is not None
    tripled = tuple(3.0 * ohm for ohm in model.loads.resistance_ohm)
    loads = model.loads.model_copy(update={"resistance_ohm": tripled})
    found = diagnose([day(20)], model.model_copy(update={"loads": loads}), references)
    check = found.model_check
    assert check is not None
    assert not check.describes
    assert check.missed[0].evidence.fault == "resistance"
    share = check.missed[0].evidence.parameters["share"].value
    assert share == pytest.approx(-2.0 / 3.0, rel=0.2)
    assert found.summary.startswith("The model misses the healthy logs by ")
    assert check.missed[-1].rmse_v < 2.5 * check.among_themselves_rmse_v


def test_a_model_with_a_wrong_level_is_told_first(references: list[Log], model: Model) -> None:
    assert model.curve is not None
    higher = tuple(volts - 8.0 for volts in model.curve.voltage_v)
    curve = model.curve.model_copy(update={"voltage_v": higher})
    found = diagnose([day(20)], model.model_copy(update={"curve": curve}), references)
    assert found.model_check is not None
    assert [each.evidence.fault for each in found.model_check.missed] == ["voltage_reading"]
    assert found.is_written
    assert "compared with the model, the pack voltage reads" in found.summary
    assert "with the model corrected" in found.summary
    assert found.extended_rmse_v < 0.3 * found.baseline_rmse_v
    start = judged(found, initial_soc=1.0)
    correction = start.to_json()["correction"]
    assert correction["accepted"]
    alone = "the model is corrected for the healthy logs alone: a wrong start belongs to these logs"
    assert correction["why_not"].startswith(alone)
    assert "does not correct the fault of these logs: a wrong start belongs to" in start.summary


def test_two_errors_of_a_model_that_cancel_are_both_told(
    references: list[Log], model: Model
) -> None:
    """The sag of three times the resistance hides a level that is too high."""
    assert model.loads is not None
    assert model.curve is not None
    ohm = tuple(3.0 * each for each in model.loads.resistance_ohm)
    volts = tuple(each + 8.0 for each in model.curve.voltage_v)
    both = {
        "loads": model.loads.model_copy(update={"resistance_ohm": ohm}),
        "curve": model.curve.model_copy(update={"voltage_v": volts}),
    }
    found = diagnose([day(20)], model.model_copy(update=both), references)
    check = found.model_check
    assert check is not None
    faults = {each.evidence.fault for each in check.missed}
    assert faults == {"resistance", "voltage_reading"}
    assert check.missed[-1].rmse_v < 2.0 * check.among_themselves_rmse_v


def test_the_model_as_fitted_describes_the_references(references: list[Log], model: Model) -> None:
    found = diagnose([day(20)], model, references)
    assert found.to_json()["model"]["describes_references"] is True
    assert found.to_json()["model"]["faults"] == []


def test_a_model_that_only_its_uncertainty_excuses_is_told(healthy: Diagnosis) -> None:
    check = ModelCheck(2.0, 0.4, 1.5, (), healthy.model.extended_model())
    assert check.describes
    assert "misses the healthy logs by 2.0 V" in replace(healthy, model_check=check).summary
    known = replace(check, references_rmse_v=0.5)
    assert "misses" not in replace(healthy, model_check=known).summary


def test_a_published_equation_without_functions_is_diagnosed(references: list[Log]) -> None:
    found = diagnose([more_volts(day(20), 5.0)], leaf_2012_model_file(), references)
    assert "voltage_reading" in found.posterior.stated
    json.dumps(found.to_json(), allow_nan=False)


def test_rows_that_do_not_follow_the_load_are_said(known: Healthy, model: Model) -> None:
    log = day(20)
    sparse = {name: getattr(log, name)[::60] for name in ("time_s", "current_a", "voltage_v")}
    slow = replace(log, **sparse, temperature_c=log.temperature_c[::60], soc_pct=None)
    found = diagnose([slow], model, known)
    assert "a row every 60 s" in " ".join(found.caveats)


def test_an_effect_of_your_own_reaches_the_diagnosis(
    references: list[Log], model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drop that follows the square of the current, as a worked example."""
    square = Effect(
        id="square_drop",
        fault="resistance",
        parameters=(Parameter("ohm_per_a", "ohm/A", -0.01, 0.01),),
        equation="ΔU = −k·I·|I|",
        about="The square of the current, as an example.",
        drive=lambda load, v, *_: -v["ohm_per_a"] * load.current_a * np.abs(load.current_a),
    )
    monkeypatch.setitem(LIBRARY, "square_drop", square)  # type: ignore[misc] # a dict

    def faulty(seed: int) -> Log:
        log = day(seed)
        change_v = -0.002 * log.current_a * np.abs(log.current_a)
        return replace(log, voltage_v=log.voltage_v + change_v)

    found = diagnose([faulty(20), faulty(21)], model, references)
    assert found.posterior.stated[0] == "resistance"
    assert found.best_of("resistance").shape.effect.id == "square_drop"
    value = found.best_of("resistance").parameters["ohm_per_a"].value
    assert value == pytest.approx(0.002, rel=0.1)


def test_a_wrong_start_belongs_to_the_log(known: Healthy, model: Model) -> None:
    found = diagnose([wrong_start(day(seed), 8.0) for seed in (20, 21)], model, known)
    stated = judged(found, initial_soc=1.0)
    assert found.evidence["initial_soc"].size == pytest.approx(8.0, abs=3.0)
    assert "The first log began at 8" in stated.summary
    assert "pass --initial-soc" in stated.summary
    assert not stated.is_written
    assert stated.extended_model == model


def test_a_correction_that_makes_the_soc_worse_is_refused(known: Healthy, model: Model) -> None:
    """The car's SoC lies where the voltage has it, or little nearer to it than to the truth."""

    def own_soc(log: Log, beyond_pct: float) -> Log:
        assert log.soc_pct is not None
        soc = log.soc_pct + beyond_pct
        soc[0] = log.soc_pct[0]
        return replace(log, soc_pct=soc)

    logs = [more_volts(day(seed), 5.0) for seed in (20, 21)]
    kept, within, refused = (
        judged(
            diagnose([own_soc(log, beyond_pct) for log in logs], model, known), voltage_offset=1.0
        )
        for beyond_pct in (0.0, 7.0, 10.0)
    )
    assert kept.is_written
    assert within.is_written
    assert within.soc_errors_pct is not None
    before_pct, after_pct = within.soc_errors_pct
    assert before_pct < after_pct < before_pct + 1.0
    assert not refused.is_written
    assert refused.why_not is not None
    assert "the SoC error of left-out rows grows (" in refused.why_not
    assert refused.why_not in refused.summary


def test_a_correction_that_makes_the_voltage_worse_is_refused(healthy: Diagnosis) -> None:
    found = judged(healthy, voltage_gain=1.0)
    assert found.corrections["voltage_reading"].rmse_v > found.baseline_rmse_v
    assert not found.is_written
    assert found.why_not is not None
    assert "the voltage error of left-out rows does not shrink (" in found.why_not
    assert found.why_not in found.summary


def test_a_step_of_resistance_is_judged_where_it_happened(known: Healthy, model: Model) -> None:
    """The model that is written has it from the first row on, and is wrong before it."""
    log = resistance_step(day(20), 0.08)
    assert log.soc_pct is not None
    beyond = replace(log, soc_pct=log.soc_pct - 10.0 * (log.time_s > 1400.0))
    kept, refused = (
        judged(diagnose([each], model, known), resistance_step=1.0) for each in (log, beyond)
    )
    assert kept.is_written
    assert kept.extended_model.effects[-1]["parameters"]["start_s"] == 0.0
    assert kept.soc_errors_pct is not None
    assert kept.soc_errors_pct[1] < 0.5 * kept.soc_errors_pct[0]
    assert not refused.is_written


@pytest.mark.parametrize(
    ("likelier", "other"), [("initial_soc", "voltage_offset"), ("voltage_offset", "initial_soc")]
)
def test_of_two_stated_faults_the_likelier_corrects(
    known: Healthy, model: Model, likelier: str, other: str
) -> None:
    found = diagnose([more_volts(day(seed), 5.0) for seed in (20, 21)], model, known)
    both = judged(found, **{likelier: 0.55, other: 0.45})
    assert both.correction is not None
    assert both.correction.evidence.fault == both.posterior.stated[0]
    assert both.extended_rmse_v == both.corrections[both.correction.evidence.fault].rmse_v
    words = {"initial_soc": "wrong start", "voltage_offset": "voltage reading"}
    assert f"with the {words[likelier]} corrected (" in both.summary
    assert f"with the {words[other]})" in both.summary


def test_a_second_fault_is_named_only_where_both_are_sure(faulty: Diagnosis) -> None:
    both = judged(faulty, voltage_offset=0.7, capacity=0.25, weak_cell=0.05)
    assert ", or the capacity is" in both.summary
    assert "Most likely" not in both.summary
    apart = judged(faulty, voltage_offset=0.7, capacity=0.1, weak_cell=0.1, time_skew=0.1)
    assert apart.summary.startswith("Most likely the pack voltage reads")
    assert "or the capacity is" not in apart.summary
    assert apart.to_json()["answer"]["stated"] == ["voltage_reading", "capacity"]


def test_an_improbable_first_fault_leaves_the_cause_open(faulty: Diagnosis) -> None:
    found = judged(faulty, voltage_offset=0.4, capacity=0.3, weak_cell=0.2, time_skew=0.1)
    assert found.summary.startswith("The cause is not clear. Most probable: the pack voltage reads")
    alone = judged(faulty, voltage_offset=0.95, capacity=0.05)
    assert alone.summary.startswith("The pack voltage reads")


def test_faults_that_look_alike_are_told_together(faulty: Diagnosis) -> None:
    both = judged(faulty, voltage_offset=0.5, initial_soc=0.4, weak_cell=0.1).summary
    assert "the level of the voltage (voltage reading, wrong start or slow voltage) 90 %." in both
    apart = judged(faulty, voltage_offset=0.5, weak_cell=0.3, initial_soc=0.2).summary
    assert "level of the voltage" not in apart
    alone = judged(faulty, voltage_offset=0.95, initial_soc=0.05).summary
    assert "level of the voltage" not in alone


def test_the_measurement_of_the_second_fault_says_what_it_tells(faulty: Diagnosis) -> None:
    measured = [
        judged(faulty, **{a: 0.5, b: 0.45, "capacity": 0.05})
        for a in ("time_skew", "weak_cell", "hysteresis", "voltage_offset")
        for b in ("time_skew", "weak_cell", "hysteresis", "voltage_offset")
        if a != b
    ]
    for found in measured:
        assert found.next_step is not None
        is_first = found.next_step[0] == found.posterior.stated[0]
        assert found.check_first.startswith("To tell the ") is not is_first
    assert {found.check_first.startswith("To tell the ") for found in measured} == {True, False}


def test_a_step_in_one_of_several_logs_names_the_log(known: Healthy, model: Model) -> None:
    logs = [day(20), resistance_step(day(21), 0.16), more_resistance(day(22), 0.16)]
    found = judged(diagnose(logs, model, known), resistance_step=1.0)
    assert " of day 21 (" in found.summary or "in minute 24 of day 21." in found.summary


def test_a_likely_fault_that_is_not_stated_is_named(healthy: Diagnosis) -> None:
    leaning = judged(healthy, none=0.3, resistance_growth=0.7)
    assert leaning.posterior.level == "none"
    assert "P(no fault) 30 %, resistance 70 %." in leaning.summary
    assert "a fault is likelier than none" in leaning.summary
    assert "Nothing to do" not in leaning.summary
    assert plan_text(leaning).endswith("diagnose one more log like these together with them.")
    assert "Nothing to do" in judged(healthy, none=0.7, resistance_growth=0.3).summary


def test_a_sentence_has_the_sign_of_its_unit(healthy: Diagnosis) -> None:
    for of in healthy.evidence.values():
        said = sentence(of, healthy.healthy.model.pack, [rows.trace for rows in healthy.rows])
        assert "ohm" not in said
        assert " 1 (" not in said


def test_no_sentence_contradicts_the_alarm(faulty: Diagnosis, healthy: Diagnosis) -> None:
    for found in (faulty, healthy):
        quiet = "No significant gap" in found.summary
        assert quiet is (found.posterior.level == "none")


def test_a_healthy_log_gives_no_alarm(healthy: Diagnosis, model: Model) -> None:
    assert healthy.posterior.level == "none"
    assert healthy.correction is None
    assert healthy.extended_model == model
    assert healthy.closed == (None, None)
    assert "would have shown" in healthy.summary


def test_a_size_has_an_interval_that_covers(known: Healthy, model: Model) -> None:
    held = []
    for seed in (20, 22):
        for volts in (4.0, -6.0):
            found = diagnose([more_volts(day(seed), volts)], model, known)
            of = found.evidence["voltage_offset"]
            held.append(abs(of.size - volts) <= 2.0 * of.std)
    assert np.mean(held) >= 0.75


def test_json_is_schema_4(faulty: Diagnosis) -> None:
    again = json.loads(json.dumps(faulty.to_json(), allow_nan=False))
    assert again["schema"] == 4
    answer, faults = again["answer"], again["faults"]
    total = answer["probability_none"] + answer["probability_unknown"]
    total += sum(item["probability"] for item in faults)
    assert total == pytest.approx(1.0)
    assert {item["fault"] for item in faults} == set(NINE)
    assert [item["probability"] for item in faults] == sorted(
        (item["probability"] for item in faults), reverse=True
    )
    for item in faults:
        assert 0.0 <= item["effect_probability"] <= item["probability"]
        assert any(each["ci"] for each in item["parameters"].values())
    assert again["gap"]["healthy_rmse_v"] == faulty.healthy_rmse_v
    assert again["correction"]["accepted"] is faulty.is_written


def test_references_learned_before_give_the_same(
    references: list[Log], known: Healthy, model: Model
) -> None:
    log = more_volts(day(20), 3.0)
    one, other = diagnose([log], model, references), diagnose([log], model, known)
    assert one.posterior.probabilities == other.posterior.probabilities
    assert one.extended_rmse_v == other.extended_rmse_v


def test_files_are_logs_and_models(
    references: list[Log], known: Healthy, model: Model, tmp_path: Path
) -> None:
    write_log(day(20), tmp_path / "monday.csv")
    model.save(tmp_path / "pack.json")
    found = diagnose(str(tmp_path / "monday.csv"), tmp_path / "pack.json", known)
    assert found.logs[0].name == "monday"
    assert found.model == model


def test_the_model_is_the_reference_where_none_is_given(model: Model) -> None:
    found = diagnose([more_volts(day(20), 12.0)], model)
    assert "Without references" in " ".join(found.caveats)
    assert found.to_json()["model"]["describes_references"] is None
    assert next(iter(found.posterior.faults)) in {"voltage_reading", "start"}
    assert diagnose([day(20)], model).posterior.level == "none"


def test_a_start_is_found_from_the_voltage_and_said(known: Healthy, model: Model) -> None:
    found = diagnose([replace(day(20), soc_pct=None)], model, known)
    assert "states no SoC" in " ".join(found.caveats)
    assert found.posterior.level == "none"
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
    known: Healthy, model: Model, change: object, word: str
) -> None:
    with pytest.raises(InputError, match=word):
        diagnose([change(day(20))], model, known)  # type: ignore[operator]


def test_a_notebook_shows_the_answer_as_text(known: Healthy, model: Model) -> None:
    log = replace(more_volts(day(20), 5.0), name="<b>day & night</b>")
    found = diagnose([log], model, known)
    shown = found._repr_html_()
    assert shown.count("<p>") == len(found.summary.splitlines())
    assert "<b>" not in shown
    assert found.summary in repr(found)


def test_no_log_starts_beyond_full(known: Healthy, model: Model) -> None:
    full = [replace(day(20), soc_pct=None)]
    found = diagnose(full, model, known, initial_soc_pct=100.0)
    assert found.evidence["initial_soc"].size <= 2.0 + 1e-9


def test_a_log_is_not_its_own_reference(references: list[Log], model: Model) -> None:
    with pytest.raises(InputError, match="same rows"):
        diagnose([references[0]], model, references)


def test_the_shortest_log_is_diagnosed(known: Healthy, model: Model) -> None:
    """Its rows fill one block of those that are held out."""
    log = more_volts(day(20).rows(slice(0, 310)), 6.0)
    found = diagnose([log], model, known)
    assert np.isfinite(found.extended_rmse_v)
    assert "lasts 5 min: slow effects hardly develop" in " ".join(found.caveats)


def test_a_log_with_gaps_says_so(known: Healthy, model: Model) -> None:
    log = day(20)
    found = diagnose([log.rows((log.time_s < 600.0) | (log.time_s > 1500.0))], model, known)
    assert "has gaps; charge that flowed in them is not counted" in " ".join(found.caveats)


def test_a_single_wrong_row_is_no_fault(known: Healthy, model: Model) -> None:
    log = day(20)
    volts = log.voltage_v.copy()
    volts[500] = 700.0
    assert diagnose([replace(log, voltage_v=volts)], model, known).posterior.level != "gap"


def test_every_effect_of_the_library_is_tried(model: Model) -> None:
    """Those with a grid at each of its values."""
    tried = Counter(shape.effect.id for shape in shapes(model.extended_model().pack))
    assert set(tried) == set(LIBRARY)
    assert tried["resistance_temperature"] == 3
