"""`cangauge gap`: JSON, files, texts, refusals."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from synthetic import synthetic_log

Run = Callable[..., object]


def day(seed: int) -> Log:
    return synthetic_log(
        hours=0.6, start_pct=85.0, end_pct=65.0, noise_v=0.5, seed=seed, name=f"day {seed}"
    )


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with three days without a fault and one on which the voltage reads 8 V too high."""
    folder = tmp_path_factory.mktemp("days")
    for seed in (11, 12, 13):
        write_log(day(seed), folder / f"good{seed}.parquet")
    log = day(21)
    write_log(replace(log, voltage_v=log.voltage_v + 8.0), folder / "trip.csv")
    return folder


def references(days: Path) -> list[object]:
    return [
        word for path in sorted(days.glob("good*.parquet")) for word in ("--reference", path)
    ]  # fmt: skip


def test_json_report_and_a_model_that_runs(
    run: Run, made: Path, days: Path, tmp_path: Path
) -> None:
    better, page = tmp_path / "better.json", tmp_path / "gap.html"
    ran = run(
        "gap", days / "trip.csv", "-m", made / "model.json", *references(days),
        "--json", "--extended", better, "--report", page,
    )  # fmt: skip
    assert ran.code == 0
    found = json.loads(ran.out)
    assert found["schema"] == 3
    assert found["cause"]["groups"][0]["group"] == "sensors_and_count"
    assert found["extended_model"] == str(better)
    text = html.unescape(page.read_text(encoding="utf-8"))
    assert found["summary"].splitlines()[0] in text
    assert found["cause"]["check_first"] in text
    assert "How far it shrinks" in text
    assert [entry["id"] for entry in Model.load(better).effects]
    ran = run("estimate", days / "trip.csv", "-m", better, "-o", tmp_path / "soc.csv")
    assert ran.code == 0


def test_a_cause_in_the_log_leaves_the_model_as_given(run: Run, made: Path, tmp_path: Path) -> None:
    given: list[object] = []
    for seed, (start_pct, end_pct) in enumerate([(60.0, 30.0)] * 3 + [(90.0, 50.0), (50.0, 5.0)]):
        path = tmp_path / f"good{seed}.csv"
        write_log(
            synthetic_log(
                hours=0.8, start_pct=start_pct, end_pct=end_pct, noise_v=0.5, seed=11 + seed
            ),
            path,
        )
        given += ["--reference", path]
    log = synthetic_log(hours=0.8, start_pct=60.0, end_pct=30.0, noise_v=0.5, seed=20)
    assert log.soc_pct is not None
    write_log(replace(log, soc_pct=log.soc_pct - 14.0), tmp_path / "today.csv")
    better = tmp_path / "better.json"
    ran = run(
        "gap", tmp_path / "today.csv", "-m", made / "model.json", *given, "--extended", better
    )
    assert ran.code == 0
    assert "The assumed initial SoC is 1" in ran.out
    assert "better.json: the model as given, since the cause, initial_soc (probability " in ran.err
    assert "is in these logs" in ran.err
    assert not Model.load(better).effects


def test_text_begins_with_the_verdict(run: Run, made: Path, days: Path, tmp_path: Path) -> None:
    extended = ("--extended", tmp_path / "same.json")
    ran = run("gap", days / "good11.parquet", "-m", made / "model.json", *extended)
    assert ran.code == 0
    assert "same.json: the model as given, since no cause is accepted" in ran.err
    assert ran.out.startswith("No significant gap")
    assert "P(no fault) = " in ran.out
    assert "No reference log was given" in ran.out
    table = {line.split()[0] for line in ran.out.splitlines() if line.strip()}
    assert {"cause", "unknown", "none"} <= table


def test_the_alarm_is_a_choice_of_the_user(run: Run, made: Path, days: Path) -> None:
    given = ("gap", days / "good11.parquet", "-m", made / "model.json", "--json")
    never, always = (json.loads(run(*given, "--alarm", alarm).out)["cause"] for alarm in ("0", "1"))
    assert (never["detected"], always["detected"]) == (False, True)
    assert never["verdict"] == always["verdict"]
    assert run(*given, "--alarm", "2").code == 2


def test_a_log_that_is_its_own_reference_is_refused(run: Run, made: Path, days: Path) -> None:
    ran = run(
        "gap", days / "trip.csv", "-m", made / "model.json", *references(days),
        "--reference", days / "trip.csv", "--extended", days / "never.json",
    )  # fmt: skip
    assert ran.code == 2
    assert "trip.csv" in ran.err
    assert "is both a LOG and a reference" in ran.err
    assert not (days / "never.json").exists()


def test_a_minute_of_data_concludes_nothing(run: Run, made: Path, tmp_path: Path) -> None:
    log = day(21)
    write_log(log.rows(np.arange(60)), tmp_path / "stub.csv")
    ran = run("gap", tmp_path / "stub.csv", "-m", made / "model.json")
    assert ran.code == 2
    assert "too short for a diagnosis" in ran.err
