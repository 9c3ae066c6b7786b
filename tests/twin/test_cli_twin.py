"""`cangauge twin` and `simulate`: logs, effects as text, refused input."""

from __future__ import annotations

import doctest
import json
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from cangauge.errors import InputError
from cangauge.extras.validation import simulate
from cangauge.extras.validation.twin import simulation
from cangauge.extras.validation.twin.drive import read_speed
from cangauge.extras.validation.twin.faults import parse_effect
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin_command import twin_command
from cangauge.logs.read import read_log
from cangauge.model.coulomb_counting import capacity_from_full_discharge

app = typer.Typer()
app.command()(twin_command)


def run(*arguments: str) -> dict[str, object]:
    result = CliRunner().invoke(app, [*arguments, "--json"], catch_exceptions=False)
    assert result.exit_code == 0
    found: dict[str, object] = json.loads(result.stdout)
    return found


def test_log_is_canonical_and_repeatable(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.parquet", "b.csv")]
    found = [run("--seed", "4", "--hours", "0.3", "-o", str(path)) for path in paths]
    logs = [read_log(path) for path in paths]
    assert found[0]["rows"] == len(logs[0])
    assert np.array_equal(logs[0].voltage_v, logs[1].voltage_v)
    assert logs[0].temperature_source == "pack"
    assert found[0]["gap_v"] == 0.0
    other = run("--seed", "5", "--hours", "0.3", "-o", str(tmp_path / "c.csv"))
    assert other["capacity_ah"] != found[0]["capacity_ah"]


def test_another_day_has_the_same_pack(tmp_path: Path) -> None:
    first, second = (
        run("--seed", "4", "--day", str(day), "--hours", "0.3", "-o", str(tmp_path / f"{day}.csv"))
        for day in (1, 2)
    )
    assert first["capacity_ah"] == second["capacity_ah"]
    assert first["true_soc_pct"] != second["true_soc_pct"]


def test_effect_has_the_given_size_or_gap(tmp_path: Path) -> None:
    common = ("--seed", "4", "--hours", "0.5", "--pack", "leaf24")
    clean, offset = tmp_path / "clean.csv", tmp_path / "offset.csv"
    run(*common, "-o", str(clean))
    found = run(
        *common, "--effect", "current_offset:offset_a=2",
        "--effect", "hysteresis:gap_v=0.7,reach=0.02", "-o", str(offset),
    )  # fmt: skip
    sizes = {item["effect"]: item for item in found["effects"]}  # type: ignore[attr-defined]
    assert sizes["current_offset"]["value"] == 2.0
    assert sizes["hysteresis"]["shape"]["reach"] == 0.02
    shift = read_log(offset).current_a - read_log(clean).current_a
    assert np.mean(shift) == pytest.approx(2.0, abs=0.02)


def test_soc_is_true_after_the_assumed_initial_soc() -> None:
    found = simulate("initial_soc:shift_pct=-6", seed=4, hours=0.3, start_soc_pct=70.0)
    full, start = found.log.soc_pct, found.recording.log.soc_pct
    assert full is not None
    assert start is not None
    assert full[0] == pytest.approx(70.0, abs=0.6)
    assert full[1] == pytest.approx(64.0, abs=0.2)
    assert np.isfinite(start).sum() == 1


def test_driving_schedule_is_followed(tmp_path: Path) -> None:
    schedule = tmp_path / "speed.csv"
    speed = np.concatenate((np.zeros(100), np.linspace(0, 20, 20), np.full(80, 20.0)))
    rows = "\n".join(f"{t},{3.6 * v}" for t, v in enumerate(speed))
    schedule.write_text(f"time,speed_kmh\n{rows}\n")
    np.testing.assert_allclose(read_speed(schedule), speed, atol=1e-9)
    log = simulate(seed=4, hours=0.2, speed_ms=read_speed(schedule)).log
    standing = (log.time_s % 200 > 5) & (log.time_s % 200 < 95)
    pulling = (log.time_s % 200 > 105) & (log.time_s % 200 < 118)
    assert log.current_a[pulling].mean() > 5.0 * log.current_a[standing].mean()


@pytest.mark.real
def test_public_schedule_is_read(shared_data: Path) -> None:
    speed = read_speed(shared_data / "drive_schedules" / "udds.csv")
    assert speed.size == pytest.approx(1370, abs=3)
    assert speed.max() == pytest.approx(25.3, abs=0.2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-o", "x.txt"), "suffix"),
        (("-o", "x.csv", "--hours", "99"), "--hours"),
        (("-o", "x.csv", "--start-soc", "nan"), "--start-soc"),
        (("-o", "x.csv", "--start-soc", "40", "--end-soc", "60"), "end"),
        (("-o", "x.csv", "--ambient-c", "90"), "ambient"),
        (("-o", "x.csv", "--pack", "tank"), "leaf24"),
        (("-o", "x.csv", "--effect", "gremlins"), "current_offset"),
        (("-o", "nowhere/x.csv"), "folder"),
    ],
)
def test_bad_usage_is_refused(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, list(arguments))
    assert isinstance(result.exception, InputError)
    assert message in str(result.exception)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("current_offset:gain=1", "offset_a=NUMBER"),
        ("current_offset:offset_a", "offset_a=NUMBER"),
        ("current_offset:offset_a=much", "not a number"),
        ("current_offset:offset_a=inf", "not a number"),
        ("current_offset:offset_a=500", "within"),
        ("coulombic_efficiency:loss=-0.1", "within 0"),
        ("current_offset:offset_a=1,gap_v=1", "either"),
        ("hysteresis:gap_v=-1", "gap"),
        ("hysteresis:gap_v=1,reach=7", "within"),
    ],
)
def test_invalid_effect_is_refused(text: str, message: str, pack: TwinPack) -> None:
    with pytest.raises(InputError, match=message):
        parse_effect(text, pack, seed=1, default_gap_v=1.0)


def test_simulate_returns_what_the_command_writes(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    found = run(
        "--seed", "4", "--hours", "0.2", "--effect", "current_offset:offset_a=4", "-o", str(path)
    )  # fmt: skip
    simulated = simulate("current_offset:offset_a=4", seed=4, hours=0.2)
    written = read_log(path)
    for name in ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct"):
        assert np.array_equal(getattr(simulated.log, name), getattr(written, name))
    assert simulated.to_dict().items() <= found.items()


def test_example_of_simulate_runs() -> None:
    assert doctest.testmod(simulation) == (0, 3)


@pytest.mark.parametrize(
    "content",
    ["", "time,speed\n", "time,speed\n0,1\n0,2\n", "time,speed\n0,1\n1,-2\n",
     "time,speed\n0,1\n1,300\n", "time,speed\n0,a\n1,b\n", "only\n1\n2\n"],
)  # fmt: skip
def test_invalid_speed_trace_is_refused(content: str, tmp_path: Path) -> None:
    path = tmp_path / "speed.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=r"speed\.csv"):
        read_speed(path)


def test_full_discharge_gives_its_capacity(tmp_path: Path) -> None:
    """An end at 2.03 % SoC would not count as empty."""
    path = tmp_path / "full.parquet"
    simulated = run("--seed", "1", "--discharge", "--hours", "1", "-o", str(path))
    found = capacity_from_full_discharge([read_log(path)], [None])
    assert found == pytest.approx(simulated["capacity_ah"], rel=0.01)
