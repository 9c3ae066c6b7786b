"""Faults: scaled to a gap, and their effect on the signals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.faults import FAULT_KINDS, Fault, faults_by_id
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin.physics import (
    Response,
    cole_cole,
    finite_warburg,
    simulate_truth,
)
from cangauge.extras.validation.twin.recording import (
    read_drive,
    record_drive,
    rms,
    scale_to_gap,
)
from selection import nightly_except

DESIGN_IDS = {
    "current_offset", "current_gain", "voltage_offset", "voltage_gain", "temperature_lag",
    "core_temperature", "time_skew", "capacity", "initial_soc", "coulombic_efficiency",
    "resistance_temperature", "resistance_soc", "resistance_asymmetry", "resistance_step",
    "charge_transfer", "fast_polarization", "slow_diffusion", "hysteresis",
    "entropic_coefficient", "weak_cell", "temperature_offset", "resistance_growth",
}  # fmt: skip
WANTED_V = 0.4
IN_SUITE = ("current_offset", "time_skew", "slow_diffusion", "hysteresis", "weak_cell")
"""A fault of each way to act; the others run in `make nightly`."""


def demanding_drive_of(pack: TwinPack) -> Drive:
    """Return a cold drive with pack heating and a stop at a charger: it shows every fault."""
    drawn = draw_drive(
        np.random.default_rng(8),
        pack,
        hours=2.0,
        ambient_c=-6.0,
        start_soc_pct=85,
        end_soc_pct=8,
        discharge=True,
    )
    middle = drawn.time_s.size // 2
    charging = np.full(round(2400.0 / drawn.step_s), -0.6 * pack.capacity_ah)
    current = np.concatenate((drawn.current_a[:middle], charging, drawn.current_a[middle:]))
    time_s = np.arange(current.size) * drawn.step_s
    return Drive(
        time_s, current, np.full_like(time_s, -6.0), drawn.start_c, drawn.start_soc,
        conditioning_w=4000.0, target_c=22.0, seed=3,
    )  # fmt: skip


@pytest.fixture(scope="module")
def demanding_drive(pack: TwinPack) -> Drive:
    return demanding_drive_of(pack)


@pytest.fixture(scope="module")
def healthy(pack: TwinPack, demanding_drive: Drive) -> Response:
    return simulate_truth(pack, demanding_drive)


def test_faults_of_the_library_are_complete() -> None:
    assert set(FAULT_KINDS) == DESIGN_IDS


@pytest.mark.parametrize("fault_id", nightly_except(IN_SUITE, list(FAULT_KINDS)))
def test_fault_is_scaled_to_the_gap(fault_id: str, pack: TwinPack, demanding_drive: Drive) -> None:
    wanted = Fault(fault_id, 1.0, seed=2)
    fault, reached_v = scale_to_gap(pack, demanding_drive, wanted, WANTED_V)
    assert reached_v == pytest.approx(WANTED_V, rel=0.05)
    low, high = fault.kind.limits(pack)
    assert 0.999 * low <= fault.size <= 1.001 * high
    # In the log, sensor errors and gap add up.
    recording = record_drive(pack, demanding_drive, (fault,))
    error = recording.log.voltage_v - recording.expected_voltage_v
    assert rms(recording.gap_v) == pytest.approx(WANTED_V, rel=0.08)
    assert rms(error) == pytest.approx(np.hypot(WANTED_V, rms(error - recording.gap_v)), rel=0.08)


@pytest.mark.parametrize("fault_id", FAULT_KINDS)
def test_fault_of_size_zero_changes_nothing(fault_id: str) -> None:
    assert not faults_by_id([Fault(fault_id, 0.0)])


# A late current is not the mirror image of an early one within the skew.
@pytest.mark.parametrize(
    "fault_id",
    nightly_except(
        IN_SUITE,
        [each.id for each in FAULT_KINDS.values() if each.signed and each.id != "time_skew"],
    ),
)
def test_negative_fault_opens_the_opposite_gap(
    fault_id: str, pack: TwinPack, demanding_drive: Drive, healthy: Response
) -> None:
    fault, _ = scale_to_gap(pack, demanding_drive, Fault(fault_id, 1.0), 0.2)
    gaps = []
    for sign in (1.0, -1.0):
        signed = faults_by_id([replace(fault, size=sign * fault.size)])
        read = read_drive(pack, demanding_drive, signed, healthy)
        gaps.append(read.gap_v[: read.truth.rows])
    rows = min(gap.size for gap in gaps)
    assert rows * demanding_drive.step_s > 3000.0
    assert rms(gaps[0][:rows] + gaps[1][:rows]) < 0.5 * rms(gaps[0][:rows] - gaps[1][:rows])


def test_sensor_faults_leave_the_truth_unchanged(
    pack: TwinPack, demanding_drive: Drive, healthy: Response
) -> None:
    for fault in (
        Fault("current_offset", 2.0), Fault("current_gain", 0.05), Fault("voltage_offset", 1.0),
        Fault("voltage_gain", 0.01), Fault("time_skew", 1.5), Fault("temperature_lag", 900.0),
    ):  # fmt: skip
        truth = simulate_truth(pack, demanding_drive, faults_by_id([fault]), healthy)
        assert np.array_equal(truth.voltage_v, healthy.voltage_v)
    read = read_drive(pack, demanding_drive, faults_by_id([Fault("current_offset", 2.0)]), healthy)
    np.testing.assert_allclose(read.current_a - demanding_drive.current_a, 2.0)


def test_time_skew_delays_the_current(
    pack: TwinPack, demanding_drive: Drive, healthy: Response
) -> None:
    condition = faults_by_id([Fault("time_skew", 2.0)])
    measured = read_drive(pack, demanding_drive, condition, healthy).current_a
    rows = round(2.0 / demanding_drive.step_s)
    np.testing.assert_allclose(measured[rows:], demanding_drive.current_a[:-rows], atol=1e-9)


def test_charge_faults_shift_the_true_soc(pack: TwinPack, demanding_drive: Drive) -> None:
    clean = record_drive(pack, demanding_drive, ()).true_soc_pct
    short = record_drive(pack, demanding_drive, (Fault("initial_soc", -4.0),)).true_soc_pct
    rows = min(clean.size, short.size)
    np.testing.assert_allclose(short[:rows] - clean[:rows], -4.0, atol=1e-9)
    lossy = record_drive(pack, demanding_drive, (Fault("coulombic_efficiency", 0.3),)).true_soc_pct
    charged = np.minimum(demanding_drive.current_a, 0.0)
    missing = 30.0 * np.trapezoid(charged, demanding_drive.time_s) / 3600.0 / pack.capacity_ah
    assert lossy[-1] - clean[lossy.size - 1] == pytest.approx(missing, rel=0.03)


def test_resistance_step_acts_from_its_time_on(
    pack: TwinPack, demanding_drive: Drive, healthy: Response
) -> None:
    fault = Fault("resistance_step", 0.02, {"at_s": 2000.0})
    truth = simulate_truth(pack, demanding_drive, faults_by_id([fault]), healthy)
    gap = truth.voltage_v - healthy.voltage_v
    before = demanding_drive.time_s < 2000.0
    np.testing.assert_allclose(gap[before], 0.0, atol=2e-3)  # tolerance of the thermal iteration
    # Shortly after the step, before it warms the pack.
    soon = ~before & (demanding_drive.time_s < 2100.0)
    np.testing.assert_allclose(gap[soon], -0.02 * demanding_drive.current_a[soon], atol=2e-2)


def test_asymmetry_acts_during_charge_only(
    pack: TwinPack, demanding_drive: Drive, healthy: Response
) -> None:
    condition = faults_by_id([Fault("resistance_asymmetry", 0.05)])
    truth = simulate_truth(pack, demanding_drive, condition, healthy)
    gap, current = truth.voltage_v - healthy.voltage_v, demanding_drive.current_a
    # Before the charger, which warms the pack.
    current = current[: round(3000.0 / demanding_drive.step_s)]
    gap = gap[: current.size]
    hard = current < -20.0
    np.testing.assert_allclose(gap[hard], -0.05 * current[hard], rtol=0.15)
    assert np.max(np.abs(gap[current > 20.0])) < 0.03


def test_hysteresis_loop_has_its_width(pack: TwinPack) -> None:
    pulse = pack.capacity_ah * np.concatenate((np.ones(2400), -np.ones(2400), np.zeros(1200)))
    time_s = np.arange(pulse.size) * 0.5
    drive = Drive(time_s, pulse, np.full_like(time_s, 25.0), 25.0, 0.7, history=1.0)
    clean = simulate_truth(pack, drive)
    condition = faults_by_id([Fault("hysteresis", 1.0, {"reach": 0.03})])
    gap = simulate_truth(pack, drive, condition, clean).voltage_v - clean.voltage_v
    assert gap[0] == pytest.approx(-1.0)
    assert gap[2399] == pytest.approx(-1.0)
    assert gap[4799] == pytest.approx(1.0)
    assert gap[-1] == pytest.approx(1.0)  # constant at rest


def test_relaxations_sum_to_their_resistance() -> None:
    for modes, name in ((cole_cole, "fast_polarization"), (finite_warburg, "slow_diffusion")):
        ohms, taus_s = modes(Fault(name, 0.03))
        assert ohms.sum() == pytest.approx(0.03)
        assert np.all((ohms > 0.0) & (taus_s > 0.0))


def test_unreachable_gap_is_reported_as_limited(pack: TwinPack) -> None:
    gentle = draw_drive(np.random.default_rng(1), pack, hours=0.5, ambient_c=25.0, start_soc_pct=90)
    _, reached_v = scale_to_gap(pack, gentle, Fault("temperature_lag", 1.0), 5.0)
    assert reached_v < 1.0


def test_repeated_faults_are_refused() -> None:
    with pytest.raises(InputError, match="twice"):
        faults_by_id([Fault("capacity", 0.1), Fault("capacity", 0.2)])
