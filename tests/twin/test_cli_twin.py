"""`cangauge twin` and `simulate`: logs, effects as text, refused input."""

from __future__ import annotations

import contextlib
import doctest
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from cangauge import simulate
from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.extras.validation.twin import simulation
from cangauge.extras.validation.twin.faults import parse_effect
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin_command import twin_command
from cangauge.model.coulomb_counting import capacity_from_full_discharge

app = typer.Typer()
app.command()(twin_command)


def run(*arguments: str) -> dict[str, object]:
    result = CliRunner().invoke(app, [*arguments, "--json"], catch_exceptions=False)
    assert result.exit_code == 0
    found: dict[str, object] = json.loads(result.stdout)
    return found


def test_the_command_writes_what_simulate_returns(tmp_path: Path) -> None:
    arguments = (
        "--seed", "4", "--day", "2", "--hours", "0.3", "--pack", "leaf24",
        "--effect", "current_offset:offset_a=4",
    )  # fmt: skip
    paths = [tmp_path / name for name in ("a.parquet", "b.csv")]
    found = [run(*arguments, "-o", str(path)) for path in paths]
    simulated = simulate("current_offset:offset_a=4", seed=4, drive=2, hours=0.3, pack="leaf24")
    assert simulated.to_dict().items() <= found[0].items()
    for path in paths:
        written = read_log(path)
        assert written.temperature_source == "pack"
        for name in ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct"):
            assert np.array_equal(getattr(simulated.log, name), getattr(written, name))


def test_another_drive_has_the_same_pack_and_another_seed_another() -> None:
    first, second, other = (
        simulate(seed=seed, drive=drive, hours=0.3).to_dict()
        for seed, drive in ((4, 1), (4, 2), (5, 1))
    )
    assert first["capacity_ah"] == second["capacity_ah"] != other["capacity_ah"]
    assert first["true_soc_pct"] != second["true_soc_pct"]
    assert first["gap_v"] == 0.0


def test_effect_has_the_given_size_or_gap() -> None:
    common = {"seed": 4, "hours": 0.5, "pack": "leaf24"}
    effects = ["current_offset:offset_a=2", "hysteresis:gap_v=0.7,reach=0.02"]
    clean, found = simulate(**common), simulate(effects, **common)
    sizes = {item["effect"]: item for item in found.to_dict()["effects"]}
    assert sizes["current_offset"]["value"] == 2.0
    assert sizes["hysteresis"]["shape"]["reach"] == 0.02
    shift = found.log.current_a - clean.log.current_a
    assert np.mean(shift) == pytest.approx(2.0, abs=0.02)


def test_soc_is_true_after_the_assumed_initial_soc() -> None:
    found = simulate("initial_soc:shift_pct=-6", seed=4, hours=0.3, start_soc_pct=70.0)
    full, start = found.log.soc_pct, found.recording.log.soc_pct
    assert full is not None
    assert start is not None
    assert full[0] == pytest.approx(70.0, abs=0.6)
    assert full[1] == pytest.approx(64.0, abs=0.2)
    assert np.isfinite(start).sum() == 1


def test_speed_is_followed() -> None:
    speed = np.concatenate((np.zeros(100), np.linspace(0, 20, 20), np.full(80, 20.0)))
    log = simulate(seed=4, hours=0.2, speed_ms=speed).log
    standing = (log.time_s % 200 > 5) & (log.time_s % 200 < 95)
    pulling = (log.time_s % 200 > 105) & (log.time_s % 200 < 118)
    assert log.current_a[pulling].mean() > 5.0 * log.current_a[standing].mean()


def test_full_discharge_gives_its_capacity() -> None:
    """An end at 2.03 % SoC would not count as empty."""
    full = simulate(seed=1, discharge=True, hours=1.0)
    found = capacity_from_full_discharge([full.log], [None])
    assert found == pytest.approx(full.pack.capacity_ah, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-o", "x.txt"), "suffix"),
        (("-o", "x.csv", "--seed", "-1"), "--seed"),
        (("-o", "x.csv", "--hours", "99"), "--hours"),
        (("-o", "x.csv", "--pack", "tank"), "leaf24"),
        (("-o", "x.csv", "--effect", "gremlins"), "current_offset"),
        (("-o", "nowhere/x.csv"), "folder"),
    ],
)
def test_bad_usage_is_refused(arguments: tuple[str, ...], message: str, tmp_path: Path) -> None:
    with contextlib.chdir(tmp_path):
        result = CliRunner().invoke(app, list(arguments))
    assert isinstance(result.exception, InputError)
    assert message in str(result.exception)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hours": 99.0}, "hours"),
        ({"start_soc_pct": float("nan")}, "start SoC"),
        ({"start_soc_pct": 40.0, "end_soc_pct": 60.0}, "give a lower end"),
        ({"ambient_c": 90.0}, "ambient"),
        ({"speed_ms": [[0.0, 5.0], [1.0, 6.0]]}, "speed_ms"),
        ({"speed_ms": [3.0, -1.0]}, "speed_ms"),
        ({"speed_ms": []}, "speed_ms"),
    ],
)
def test_a_value_out_of_range_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate(seed=1, **options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("current_offset:gain=1", "offset_a=NUMBER"),
        ("current_offset:offset_a", "offset_a=NUMBER"),
        ("current_offset:offset_a=much", "not a number"),
        ("current_offset:offset_a=inf", "within"),
        ("current_offset:offset_a=500", "within"),
        ("coulombic_efficiency:loss=-0.1", "within 0"),
        ("current_offset:offset_a=1,gap_v=1", "either"),
        ("hysteresis:gap_v=-1", "gap"),
        ("hysteresis:gap_v=1,reach=7", "within"),
    ],
)
def test_invalid_effect_is_refused(text: str, message: str, pack: TwinPack) -> None:
    with pytest.raises(InputError, match=message):
        parse_effect(text, pack, seed=1)


def test_example_of_simulate_runs() -> None:
    assert doctest.testmod(simulation) == (0, 3)
