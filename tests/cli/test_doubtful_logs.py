"""What every command says of a log whose current or SoC cannot be right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from live import in_process, succeeds


def changed(made: Path, folder: Path, change: Callable[[Log], Log]) -> Path:
    """Write a changed copy of the part of a discharge."""
    path = folder / "log.csv"
    write_log(change(read_log(made / "part.csv")), path)
    return path


def commands(log: Path, model: Path, folder: Path) -> dict[str, tuple[object, ...]]:
    return {
        "estimate": ("estimate", log, "-m", model, "-o", folder / "soc.csv"),
        "judge": ("judge", log, "-m", model),
        "gap": ("gap", log, "-m", model),
    }


def unsigned(log: Log) -> Log:
    codes = np.round(-100.0 * log.current_a).astype(np.int64)
    return replace(log, current_a=np.mod(codes, 1 << 16) / 100.0)


def test_no_command_takes_a_current_that_was_read_unsigned(made: Path, tmp_path: Path) -> None:
    log = changed(made, tmp_path, unsigned)
    every = commands(log, made / "model.json", tmp_path) | {"inspect": ("inspect", log)}
    for command in every.values():
        error = in_process(*command).err.splitlines()[-1]
        assert "the current wraps at 655.36 A (16 bits unsigned of 0.01 A)" in error
        assert "milli" not in error


@pytest.mark.parametrize("factor", [0.1, 5.0])
@pytest.mark.parametrize("name", ["estimate", "judge", "gap"])
def test_charge_against_soc_is_said_first(
    made: Path, tmp_path: Path, name: str, factor: float
) -> None:
    def scaled(log: Log) -> Log:
        return replace(log, current_a=factor * log.current_a)

    log = changed(made, tmp_path, scaled)
    ran = in_process(*commands(log, made / "model.json", tmp_path)[name])
    assert "charge and SoC contradict each other" in ran.err.splitlines()[-1]
    assert not ran.out


def test_inspect_says_first_that_parts_contradict_each_other(made: Path, tmp_path: Path) -> None:
    def half(log: Log) -> Log:
        late = np.arange(len(log)) > len(log) // 2
        return replace(log, current_a=np.where(late, 0.2, 1.0) * log.current_a)

    found = succeeds("inspect", changed(made, tmp_path, half), "--json").json
    assert found["answer"] == found["contradiction"]
    assert "contradict each other" in found["answer"]
    assert found["soc"]["implied_capacity_ah"] is None


def test_a_soc_above_full_starts_no_estimate(made: Path, tmp_path: Path) -> None:
    def too_high(log: Log) -> Log:
        assert log.soc_pct is not None
        return replace(log, soc_pct=log.soc_pct * 1.35)

    log = changed(made, tmp_path, too_high)
    ran = succeeds("estimate", log, "-m", made / "model.json", "-o", tmp_path / "soc.csv")
    assert "found by the voltage" in ran.out.splitlines()[0]
    assert "is not within 0–100 %" in ran.err
