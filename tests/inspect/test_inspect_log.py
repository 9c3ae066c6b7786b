"""`inspect_log`: rates, gaps, quantization, stuck channels, charge, abilities."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge._text import plain
from cangauge.bus.recording import read_log
from cangauge.inspect.log import LogInspection, inspect_log
from cangauge.logs.log import Log
from cangauge.logs.resolution import quantum_of


def drive(minutes: float = 30.0, *, rate_hz: float = 10.0, seed: int = 1) -> Log:
    """A drive whose current changes every 4 s, 0.1 Ω, quantized to 0.5 A, 0.25 V and 1 °C."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(minutes * 60 * rate_hz)) / rate_hz
    level = rng.normal(20.0, 50.0, int(time[-1] // 4) + 1)
    current = np.rint(level[(time // 4).astype(int)] * 2) / 2
    current[time < 20.0] = 0.0
    taken = np.cumsum(current) / rate_hz / 3600.0
    voltage = np.rint((390.0 - 1.5 * taken - 0.1 * current) * 4) / 4
    return Log(
        time,
        current,
        voltage,
        np.rint(20.0 + time / 400.0),
        soc_pct=90.0 - taken / 40.0 * 100.0,
        name="drive",
        temperature_source="pack",
    )


def ability(found: LogInspection, topic: str) -> tuple[str, str]:
    return found.abilities[topic]


def test_the_figures_of_a_plain_drive() -> None:
    log = drive()
    found = inspect_log(log)
    assert found.rows == 18_000
    assert found.timing.rate_hz == pytest.approx(10.0)
    assert found.timing.regular
    assert found.timing.gap_count == 0
    assert found.channels["current_a"].quantum == pytest.approx(0.5)
    assert found.channels["voltage_v"].quantum == pytest.approx(0.25)
    assert found.channels["temperature_c"].quantum == pytest.approx(1.0)
    assert found.channels["current_a"].maximum == log.current_a.max()
    assert found.resistance is not None
    assert found.resistance["median_ohm"] == pytest.approx(0.1, rel=0.02)
    assert found.soc is not None
    assert found.soc.coverage == 1.0
    assert found.soc.implied_capacity_ah == pytest.approx(40.0, rel=0.01)
    assert found.charge.discharged_ah - found.charge.charged_ah == pytest.approx(
        found.charge.net_ah
    )
    assert found.charge.net_ah == pytest.approx(np.trapezoid(log.current_a, log.time_s) / 3600.0)
    assert found.sign.sign == 1
    assert found.warnings == ()
    assert ability(found, "delayed current terms")[0] == "yes"
    assert ability(found, "start from rest")[0] == "yes"


def test_an_inverted_log_is_warned_of_and_keeps_its_capacity() -> None:
    log = drive()
    found = inspect_log(replace(log, current_a=-log.current_a))
    assert found.sign.sign == -1
    assert found.warnings[0].startswith("the sign of current is inverted")
    assert found.soc is not None
    assert found.soc.implied_capacity_ah == pytest.approx(40.0, rel=0.01)


def test_gaps_are_counted_and_placed() -> None:
    log = drive()
    keep = np.ones(len(log), dtype=bool)
    keep[3001:3031] = False  # 3.1 s
    keep[9001:9501] = False  # 50.1 s
    keep[15_001:15_016] = False  # 1.6 s: no gap
    found = inspect_log(log.rows(keep))
    assert found.timing.gap_count == 2
    first = found.timing.longest_gaps[0]
    assert (first["start_s"], first["length_s"]) == pytest.approx((900.0, 50.1))
    assert found.timing.gap_total_s == pytest.approx(53.2)
    assert found.charge.in_gaps_ah > 0.0
    assert any(
        "2 gaps of more than 2 s, the longest 50.1 s at 900.0 s" in w for w in found.warnings
    )


@pytest.mark.parametrize("channel", ["voltage_v", "current_a"])
def test_a_stuck_channel_is_found_where_it_is(channel: str) -> None:
    log = drive()
    values = getattr(log, channel).copy()
    values[6000:7200] = values[6000]
    found = inspect_log(replace(log, **{channel: values}))
    other = "current_a" if channel == "voltage_v" else "voltage_v"
    assert found.channels[other].stuck == ()
    (stretch,) = found.channels[channel].stuck
    assert stretch["start_s"] == pytest.approx(600.0, abs=4.0)
    assert stretch["duration_s"] == pytest.approx(120.0, abs=8.0)
    assert any(w.startswith(f"{channel} stuck at") for w in found.warnings)


def test_cc_and_cv_phases_are_not_stuck() -> None:
    time = np.arange(0.0, 7200.0)
    steps = np.where((time // 20) % 2 == 0, 30.0, -30.0)
    current = np.select(
        [time < 600, time < 4000], [steps, -20.0], -20.0 * np.exp(-(time - 4000) / 900)
    )
    rest = np.interp(time, [0, 600, 4000, 7200], [3.6, 3.6, 4.16, 4.2])
    voltage = np.where(time < 4000, rest - 0.002 * current, 4.2)
    log = Log(time, current, voltage, np.full(time.size, 20.0))
    found = inspect_log(log)
    assert found.resistance is not None
    assert found.channels["current_a"].stuck == ()
    assert found.channels["voltage_v"].stuck == ()


def test_relaxation_at_no_current_is_not_stuck() -> None:
    log = drive()
    current, voltage = log.current_a.copy(), log.voltage_v.copy()
    current[6000:7200] = 0.0
    voltage[6000:7200] = 370.0 + 5.0 * np.floor(np.arange(1200) / 200.0)
    found = inspect_log(replace(log, current_a=current, voltage_v=voltage))
    assert found.channels["current_a"].stuck == ()


def test_missing_soc_is_measured() -> None:
    log = drive()
    assert log.soc_pct is not None
    soc = log.soc_pct.copy()
    soc[:100] = np.nan
    soc[5000:6000] = np.nan
    soc[-900:] = np.nan
    found = inspect_log(replace(log, soc_pct=soc))
    assert found.soc is not None
    assert found.soc.coverage == pytest.approx(16_000 / 18_000)
    assert found.channels["soc_pct"].missing == 2000
    nothing = inspect_log(replace(log, soc_pct=np.full(len(log), np.nan)))
    assert nothing.soc is None
    assert "soc_pct" not in nothing.channels


def test_a_poor_log_lists_what_it_cannot_identify() -> None:
    time = np.arange(0.0, 6000.0, 10.0)
    log = Log(
        time,
        np.full(time.size, 3.0),
        4.1 - time / 9000.0,
        np.full(time.size, 25.0),
        temperature_source="room",
    )
    found = inspect_log(log)
    assert ability(found, "delayed current terms") == (
        "no",
        "current does not vary",
    )
    assert ability(found, "ohmic resistance")[0] == "no"
    verdict, text = ability(found, "temperature coefficient")
    assert verdict == "no"
    assert "ROOM" in text
    assert ability(found, "capacity")[0] == "no"
    assert "current_a never changes" in found.warnings
    assert any("rows are 10 s apart" in w for w in found.warnings)
    short = inspect_log(drive(minutes=5.0))
    assert "300 s is too short" in ability(short, "delayed current terms")[1]


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_tiny_logs_do_not_break_it(rows: int) -> None:
    log = drive().rows(slice(0, rows))
    found = inspect_log(log)
    assert found.rows == rows
    assert found.resistance is None
    json.dumps(plain(found.to_dict()), allow_nan=False)


@given(
    step=st.sampled_from([0.01, 0.1, 0.25, 0.5, 1.0, 0.1051588]),
    levels=st.integers(5, 400),
    offset=st.floats(-500.0, 500.0),
    seed=st.integers(0, 1000),
)
def test_the_step_of_quantization_is_found(
    step: float, levels: int, offset: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    place = np.concatenate([np.arange(levels), rng.integers(0, levels, 2000)])
    assert quantum_of(offset + step * place) == pytest.approx(step, rel=1e-4)


def test_no_step_is_claimed_where_there_is_none() -> None:
    rng = np.random.default_rng(5)
    assert quantum_of(rng.normal(380.0, 5.0, 5000)) is None
    assert quantum_of(np.full(100, 3.3)) is None
    # A constant current with sensor noise has the sensor's step, not the current's size.
    assert quantum_of(np.concatenate([np.zeros(50), 65.0 + 0.02 * rng.integers(-3, 4, 3000)])) != (
        pytest.approx(65.0, rel=0.01)
    )
    # A few interpolated rows do not hide the step.
    whole = np.concatenate([rng.integers(15, 30, 2000), np.linspace(15, 30, 47)])
    assert quantum_of(whole.astype(float)) == pytest.approx(1.0)


@pytest.mark.real
@pytest.mark.nightly
def test_recorded_trips(shared_data: Path) -> None:
    capacities = []
    for path in sorted((shared_data / "bmw_i3").glob("*.csv.gz")):
        found = inspect_log(read_log(path))
        assert found.soc is not None
        if found.soc.implied_capacity_ah is not None:
            capacities.append(found.soc.implied_capacity_ah)
        assert found.resistance is not None
        assert 0.05 < found.resistance["median_ohm"] < 0.2
        assert found.channels["soc_pct"].quantum == pytest.approx(0.1, rel=0.02) or (
            path.name.startswith("TripA04")
        )
        assert not found.channels["voltage_v"].stuck
        assert not found.channels["current_a"].stuck
        json.dumps(plain(found.to_dict()), allow_nan=False)
    assert np.median(capacities) == pytest.approx(61.75, abs=0.1)  # as its README says


def test_the_answer_says_what_a_short_log_lacks() -> None:
    short = drive(0.1)
    assert inspect_log(short).answer == (
        "good for an estimate, not for a fit: it needs 52 rows, 1 s apart, beyond the first 70 s"
        " and the 70 s after each gap; there are none"
    )
    assert inspect_log(short.rows(slice(0, 1))).answer.startswith("too short: a single row")
