"""`cangauge gap`: JSON, files, texts, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from report_html import drawn_figures
from synthetic import synthetic_log

Run = Callable[..., object]


def day(seed: int) -> Log:
    return synthetic_log(
        hours=0.6, start_pct=85.0, end_pct=65.0, noise_v=0.5, seed=seed, name=f"day {seed}"
    )


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with three days without a fault and one on which the voltage reads 6 V too high."""
    folder = tmp_path_factory.mktemp("days")
    for seed in (11, 12, 13):
        write_log(day(seed), folder / f"good{seed}.parquet")
    log = day(21)
    write_log(replace(log, voltage_v=log.voltage_v + 6.0), folder / "trip.csv")
    return folder


def references(days: Path) -> list[object]:
    return [
        word for path in sorted(days.glob("good*.parquet")) for word in ("--reference", path)
    ]  # fmt: skip


def test_json_report_figures_and_a_model_that_runs(
    run: Run, made: Path, days: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "cangauge.extras.report.export._PNG_DPI", 20
    )  # what is drawn, not how finely
    better, page, folder = tmp_path / "better.json", tmp_path / "gap.html", tmp_path / "figures"
    ran = run(
        "gap", days / "trip.csv", "-m", made / "model.json", *references(days),
        "--json", "--extended", better, "--report", page, "--figures", folder,
    )  # fmt: skip
    assert ran.code == 0
    found = json.loads(ran.out)
    assert "voltage_offset" in {found["cause"]["verdict"], *found["cause"]["ambiguous_with"]}
    assert found["extended_model"] == str(better)
    assert isinstance(found["limits"], list)
    text = page.read_text(encoding="utf-8")
    assert "What these logs cannot show" in text or not found["limits"]
    assert drawn_figures(folder) == text.count("<figure ")
    assert [entry["id"] for entry in Model.load(better).effects]
    ran = run("estimate", days / "trip.csv", "-m", better, "-o", tmp_path / "soc.csv")
    assert ran.code == 0


def test_text_gives_verdict_candidates_and_caveats(run: Run, made: Path, days: Path) -> None:
    ran = run("gap", days / "good11.parquet", "-m", made / "model.json")
    assert ran.code == 0
    for text in (
        "No significant gap beyond the error stated in the model file",
        "probability", "RMSE [V]", "closed",
        "What these logs cannot show:", "- No reference logs: the floor is",
    ):  # fmt: skip
        assert text in ran.out
    table = {line.split()[0] for line in ran.out.splitlines() if line.strip()}
    assert {"unknown", "none"} <= table


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
