"""The sign of current is found where the data show it, and left open elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.logs.sign import (
    correlation,
    current_steps,
    require_discharge_positive,
    sign_of_current,
)


def drive(
    seed: int = 0, *, minutes: float = 10.0, resistance_ohm: float = 0.1, noise_v: float = 0.2
) -> Log:
    """A pack with an ohmic drop, a falling rest voltage and current that steps every 5 s."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(minutes * 60)) * 1.0
    current = np.repeat(rng.normal(15.0, 40.0, time.size // 5 + 1), 5)[: time.size]
    taken_ah = np.cumsum(current) / 3600.0
    voltage = 380.0 - 0.5 * taken_ah - resistance_ohm * current + rng.normal(0, noise_v, time.size)
    return Log(time, current, voltage, np.full(time.size, 20.0))


def turned(log: Log) -> Log:
    return replace(log, current_a=-log.current_a)


@given(seed=st.integers(0, 10_000), resistance_ohm=st.floats(0.05, 0.2))
def test_both_conventions_are_distinguished(seed: int, resistance_ohm: float) -> None:
    log = drive(seed, resistance_ohm=resistance_ohm)
    finding = sign_of_current(log)
    assert finding.sign == 1
    assert finding.confidence > 0.99
    assert sign_of_current(turned(log)).sign == -1
    noise = replace(log, voltage_v=380.0 + np.random.default_rng(seed).normal(0.0, 1.0, len(log)))
    assert sign_of_current(noise).sign == 0  # an unrelated voltage shows nothing


@pytest.mark.parametrize("rows", [1, 2, 500])
def test_logs_without_excitation_leave_it_open(rows: int) -> None:
    level = np.full(rows, 20.0)
    for amps, volts in ((0.0, 380.0 + np.arange(rows) % 7), (5.0, np.full(rows, 380.0))):
        finding = sign_of_current(Log(np.arange(float(rows)), np.full(rows, amps), volts, level))
        assert finding.sign == 0
        assert 0.5 <= finding.confidence < 0.99


def test_charge_and_reference_soc_show_it_without_steps() -> None:
    time = np.arange(0.0, 3600.0)
    level = np.full(time.size, 20.0)
    steady = Log(time, np.full(time.size, 30.0), 4.1 - time / 4000.0, level)
    assert sign_of_current(steady).evidence[0].text == "no clear step of current"
    assert "rank correlation -1.00" in sign_of_current(steady).sentence
    current = 20.0 + 5.0 * np.sin(time / 300.0)
    soc = 80.0 - np.cumsum(current) / 3600.0 / 60.0 * 100.0
    soc[100:900] = np.nan
    flat = Log(time, current, np.full(time.size, 3.3), level, soc_pct=soc)
    for log in (steady, flat):
        assert (sign_of_current(log).sign, sign_of_current(turned(log)).sign) == (1, -1)


def test_contradicting_evidence_leaves_it_open() -> None:
    log = drive(minutes=60.0)
    rising = 50.0 + np.cumsum(log.current_a) / 3600.0
    assert sign_of_current(replace(log, soc_pct=rising)).sign == 0


def test_commands_can_refuse_an_inverted_log() -> None:
    log = replace(drive(), name="drive")
    require_discharge_positive(log)
    with pytest.raises(
        InputError,
        match=r"drive: current_a: the sign of current is inverted: volt.*"
        r"age moved with current in (\d+) of \1 steps.*multiply the column by -1",
    ):
        require_discharge_positive(turned(log))


def test_an_inverted_soc_may_be_what_is_wrong() -> None:
    time = np.arange(0.0, 3600.0)
    current, level = np.full(time.size, 30.0), np.full(time.size, 20.0)
    log = Log(time, current, level + 360.0, level, soc_pct=50.0 + time / 360.0)
    with pytest.raises(InputError, match="or, if the current is right, correct soc_pct"):
        require_discharge_positive(log)


def test_steps_are_the_changes_over_a_second() -> None:
    time = np.arange(0.0, 60.0, 0.1)
    current = np.where(time >= 30.0, 50.0, 0.0)
    level = np.full(time.size, 20.0)
    amps, volts = current_steps(Log(time, current, 380.0 - 0.1 * current, level))
    np.testing.assert_allclose(amps, [50.0])
    np.testing.assert_allclose(volts, [-5.0])


def test_correlation_agrees_with_numpy_and_survives_constants() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=50), rng.normal(size=50)
    assert correlation(a, b) == pytest.approx(np.corrcoef(a, b)[0, 1])
    assert correlation(a, np.ones(50)) == 0.0
    assert correlation(np.full(50, 1e-310), b) == 0.0
