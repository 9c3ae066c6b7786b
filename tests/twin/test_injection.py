"""Faults injected into recorded logs, and the table of what the diagnosis finds of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge import simulate
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.validation import gap_check
from cangauge.extras.validation.twin.faults import FAULT_KINDS, Fault
from cangauge.extras.validation.twin.injection import drive_of, fit_surrogate_pack, inject
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin.recording import rms, scale_to_gap
from cangauge.logs.log import Log
from cangauge.model.effects.library import LIBRARY

CAPACITY_AH = 60.0


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate(seed=4, pack="leaf24", hours=0.3, start_soc_pct=80.0).log


@pytest.fixture(scope="module")
def surrogate(log: Log) -> TwinPack:
    found = fit_surrogate_pack([log], capacity_ah=CAPACITY_AH, cells=96)
    return replace(found, sensors=replace(found.sensors, current_step_a=0.0, voltage_step_v=0.0))


def gap_of(log: Log, surrogate: TwinPack, *faults: Fault) -> FloatArray:
    return inject(log, faults, surrogate)[1]


def test_a_sensor_fault_is_added_to_its_signal_alone(log: Log, surrogate: TwinPack) -> None:
    by_voltage, gap_v = inject(log, [Fault("voltage_offset", 2.0)], surrogate)
    assert np.allclose(by_voltage.voltage_v, log.voltage_v + 2.0)
    assert np.allclose(gap_v, 2.0)
    by_current, gap_v = inject(log, [Fault("current_offset", 3.0)], surrogate)
    assert np.allclose(by_current.current_a, log.current_a + 3.0)
    assert np.allclose(by_current.voltage_v, log.voltage_v)
    # A perfect model is told 3 A too much, expects less voltage, and counts away from the truth.
    assert gap_v.min() > 0.0


def test_relaxations_of_two_faults_add_up(log: Log, surrogate: TwinPack) -> None:
    fast, slow = Fault("fast_polarization", 0.03), Fault("slow_diffusion", 0.05)
    alone = [gap_of(log, surrogate, each) for each in (fast, slow)]
    assert min(map(rms, alone)) > 0.05
    both = gap_of(log, surrogate, fast, slow)
    assert rms(both - alone[0] - alone[1]) < 0.05 * rms(both)


def test_an_injection_is_scaled_to_its_gap(log: Log, surrogate: TwinPack) -> None:
    fault, reached_v = scale_to_gap(
        surrogate, drive_of(log, CAPACITY_AH), Fault("initial_soc", -1.0), 0.8
    )
    assert fault.size < 0.0
    assert reached_v == pytest.approx(0.8, rel=0.04)
    assert rms(gap_of(log, surrogate, fault)) == pytest.approx(0.8, rel=0.04)


def test_a_check_counts_what_was_found_at_each_size(surrogate: TwinPack) -> None:
    def finding(effect: str | None, floors: float, *, right: bool) -> gap_check.Finding:
        fault = "none" if effect is None else LIBRARY[effect].fault
        size = -2.0 * floors
        return gap_check.Finding("log", effect, floors, size, "A", fault, right, right, right, 0.5)

    found = [finding("current_offset", floors, right=right)
             for floors, right in ((1.1, False), (0.9, True), (2.0, True))]  # fmt: skip
    result = gap_check.summarize([*found, finding(None, 0.0, right=False)])
    assert result["healthy"] == {"logs": 1, "alarms": 0, "probability_none": 0.5}
    current = next(item for item in result["faults"] if item["fault"] == "current_reading")
    assert [(of["floors"], of["first"], of["of"]) for of in current["sizes"]] == [
        (1.0, 1, 2), (2.0, 1, 1),
    ]  # fmt: skip
    head, rows = gap_check.table(result)
    assert head == ["fault", "1 floor", "2 floors", "4 floors"]
    assert ["current reading", "1/2, 1/1", "1/1, 1/1", "–"] in rows
    assert "first in 67 % of 3 injected effects" in gap_check.summary(result)
    with pytest.raises(InputError, match="3 healthy logs are too few"):
        next(gap_check.find([simulate(seed=1, hours=0.1).log] * 3, surrogate))


def test_each_log_is_left_out_in_turn() -> None:
    """The first log as it is, then with the first effect at one floor."""
    findings = gap_check.find(*gap_check.simulated_logs(), 1)
    healthy, faulty = next(findings), next(findings)
    assert (healthy.effect, healthy.detected) == (None, False)
    assert (faulty.effect, faulty.unit) == ("current_offset", FAULT_KINDS["current_offset"].unit)
    assert faulty.floors == pytest.approx(1.0, rel=0.1)
