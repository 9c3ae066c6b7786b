"""The residual against the model's stated error, and the log of the last hour."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from statuses import Clock, status

from cangauge.estimation.offline import samples_of
from cangauge.extras.live.comparison import LOG_NAME, REFERENCE, comparison, last_hour
from cangauge.extras.live.history import History
from cangauge.logs.canonical import write_log
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model
from live import in_process, leaf_model_path, short_log


def stated_errors(rows: int, seed: int) -> np.ndarray:
    """Return errors as the model states them, one a second [V]."""
    noise, rng = Model.load(leaf_model_path()).noise, np.random.default_rng(seed)
    total = np.zeros(rows)
    for std_v, time_s in (
        (noise.fast_std_v, noise.fast_time_s),
        (noise.slow_std_v, noise.slow_time_s),
    ):
        kept = np.exp(-1.0 / time_s)
        value = std_v * rng.standard_normal()
        for row in range(rows):
            total[row] += value
            value = kept * value + std_v * np.sqrt(1.0 - kept**2) * rng.standard_normal()
    return total


def history_of(residual_v: np.ndarray) -> History:
    clock = Clock()
    history = History(clock)
    for second, each in enumerate(residual_v.tolist()):
        clock.now_s += 1.0
        history.add(status(float(second), residual_v=each))
    return history


def test_the_stated_error_is_no_gap() -> None:
    answers = [comparison(history_of(stated_errors(3600, seed))) for seed in range(5)]
    assert [each["verdict"] for each in answers] == ["No gap beyond what the model states."] * 5
    for scale in answers[0]["scales"][:6]:
        assert scale["rms_mv"] == pytest.approx(scale["floor_mv"], rel=0.25)


def test_a_growing_error_is_named() -> None:
    noise = stated_errors(3600, 1) * np.linspace(0.5, 5.0, 3600)
    answer = comparison(history_of(noise))
    assert answer["verdict"].startswith("The gap is growing")
    assert all(scale["growing"] and scale["above"] for scale in answer["scales"][:5])


def test_a_large_steady_error_is_not_growing() -> None:
    answer = comparison(history_of(3.0 * stated_errors(3600, 2)))
    assert "and not growing" in answer["verdict"]
    assert answer["scales"][2]["rms_mv"] / answer["scales"][2]["floor_mv"] == pytest.approx(
        3.0, rel=0.2
    )


def test_few_samples_are_not_judged() -> None:
    answer = comparison(history_of(stated_errors(100, 3)))
    assert answer["verdict"] == "Too few samples yet: wait 9 min more."
    assert answer["scales"] == []


def test_a_model_that_is_gone_is_said() -> None:
    history = history_of(stated_errors(700, 3))
    assert history.status is not None
    history.status["model"] = "/nowhere/model.json"
    assert "cannot be read" in comparison(history)["verdict"]


def test_the_last_hour_is_a_log_that_gap_reads(tmp_path: Path, monkeypatch) -> None:
    clock, log = Clock(), short_log(700.0)
    history = History(clock)
    for sample in samples_of(log):
        clock.now_s += 0.1
        history.add(
            status(
                sample.time_s,
                sample={"age_s": 0.0} | {name: getattr(sample, name) for name in sample._fields},
            )
        )
    (tmp_path / LOG_NAME).write_text(last_hour(history))
    write_log(short_log(900.0), tmp_path / REFERENCE)
    read = read_log(tmp_path / LOG_NAME)
    assert len(read.time_s) == len(log.time_s)
    assert read.current_a == pytest.approx(log.current_a, rel=1e-5, abs=1e-5)
    monkeypatch.chdir(tmp_path)
    ended = in_process(*shlex.split(comparison(history)["command"])[1:], "--json")
    assert ended.code == 0, ended.err
    assert ended.json["gap"]["baseline_rmse_v"] > 0.0


def test_the_log_begins_after_a_jump_back_of_time() -> None:
    clock = Clock()
    history = History(clock)
    for time_s in (10.0, 10.1, 10.1, 10.2, 3.0, 3.1):
        clock.now_s += 0.1
        history.add(status(time_s))
    lines = last_hour(history).splitlines()
    assert [line.split(",")[0] for line in lines[1:]] == ["3.000000", "3.100000"]
