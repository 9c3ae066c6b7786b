"""Pass criteria on runs made by hand: each criterion must be able to fail."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from cangauge.types import Reason
from faults.criteria import (
    DEGRADED,
    VALID,
    Estimate,
    Observation,
    Reference,
    Verdict,
    judge,
)

BEGAN, FAULT, ENDED = 1000.0, (1080.0, 1100.0), 1190.0
STD_PCT = 0.7


def drive(time_s: float) -> float:
    """SoC of the undisturbed run [%]."""
    return 70.0 - 0.02 * (time_s - BEGAN)


def observed(**changes: object) -> Observation:
    """A run without errors; recorded for one more second."""
    times = [BEGAN + 0.1 * number for number in range(1901)]
    run = Observation(
        published=[Estimate(time_s + 0.01, drive(time_s), VALID, 0, STD_PCT) for time_s in times],
        sent_s=times,
        bus_s=[time_s - BEGAN for time_s in times],
        good_sent_s={role: list(times) for role in ("current", "voltage", "temperature")},
        fault_s=FAULT,
        began_s=BEGAN,
        ended_s=ENDED,
        recovered_from_s=1171.0,
    )
    return replace(run, **changes)  # type: ignore[arg-type] # names of fields


def published(change: object = 0.0, first: float = 0.0, last: float = math.inf) -> list[Estimate]:
    """Estimates of that run with a status, a shift of the SoC [%], or None (missing) for a time."""
    out = []
    for each in observed().published:
        if first <= each.time_s < last:
            if change is None:
                continue
            if isinstance(change, float):
                each = replace(each, soc_pct=each.soc_pct + change)  # noqa: PLW2901
            else:
                each = replace(each, status=change)  # type: ignore[arg-type] # noqa: PLW2901
        out.append(each)
    return out


def verdict(run: Observation) -> Verdict:
    return judge(run, Reference(observed()))


def without(role: str, seconds: float) -> dict[str, list[float]]:
    """Good frames of a run without a role from the start of the fault."""
    times = {key: list(value) for key, value in observed().good_sent_s.items()}
    times[role] = [t for t in times[role] if not FAULT[0] <= t < FAULT[0] + seconds]
    return times


def test_the_undisturbed_run_passes() -> None:
    found = verdict(observed())
    assert found.passed
    assert found.soc_error_pct == found.worst_error_pct == pytest.approx(0.0, abs=1e-9)
    assert found.stale_valid_s == found.not_valid_s == 0.0
    assert found.last_status == found.worst_status == "valid"


@pytest.mark.parametrize(
    ("shift", "passes"), [(1.03, True), (-1.03, True), (1.1, False), (-1.1, False)]
)
def test_soc_error_after_recovery(shift: float, passes: bool) -> None:
    found = verdict(observed(published=published(shift, 1150.0)))
    assert found.passed is passes
    assert found.soc_error_pct == pytest.approx(abs(shift), abs=0.011)  # transport time


@pytest.mark.parametrize(
    ("role", "seconds", "passes"),
    [
        ("current", 2.5, True),
        ("current", 4.0, False),
        ("voltage", 4.0, False),
        ("temperature", 9.0, True),
        ("temperature", 14.0, False),
    ],
)
def test_stale_and_valid_fails(role: str, seconds: float, passes: bool) -> None:
    found = verdict(observed(good_sent_s=without(role, seconds)))
    assert found.passed is passes
    assert (role in " ".join(found.failures)) is not passes


def test_unexpected_silence_fails() -> None:
    gone = published(None, 1090.0, 1095.0)
    found = verdict(observed(published=gone))
    assert found.failures == ("silent for 5.1 s",)
    assert verdict(
        observed(published=gone, expected_silence_s=[(1089.0, 1091.0), (1090.5, 1094.0)])
    ).passed


def reported(reason: Reason, first: float, last: float, status: int = DEGRADED) -> Observation:
    """A run that publishes a reason for a time."""
    changed = [
        replace(each, reason=int(reason), status=status) if first <= each.time_s < last else each
        for each in observed().published
    ]
    return observed(published=changed)


def test_fault_must_be_reported_and_not_valid() -> None:
    reference, reason = Reference(observed()), Reason.DUPLICATE_SENDER
    first, last = FAULT
    assert judge(reported(reason, first + 2.0, last), reference, reports=reason).passed
    none = judge(observed(), reference, reports=reason)
    assert "no duplicate sender reported" in none.failures
    assert judge(observed(), reference).passed
    early = judge(reported(reason, first, first + 8.0), reference, reports=reason)
    assert early.failures == ("valid 8 s into the fault",)


def test_fault_that_must_recover_is_valid_at_the_end() -> None:
    reference = Reference(observed())
    assert judge(observed(), reference, recovers=True).passed
    late = judge(reported(Reason.CURRENT_GAP, FAULT[0], math.inf), reference, recovers=True)
    assert late.failures == ("not valid again",)
