"""Pass criteria on runs made by hand: each criterion must be able to fail."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from cangauge.types import Reason
from faults.criteria import (
    DEGRADED,
    INVALID,
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


def test_wrong_soc_passes_while_not_valid() -> None:
    wrong = [replace(each, soc_pct=20.0, status=DEGRADED) for each in published()]
    found = verdict(observed(published=wrong))
    assert found.passed
    assert math.isnan(found.soc_error_pct)


def test_the_worst_error_is_that_beyond_its_own_deviation() -> None:
    frames = published()
    for place, error_pct, std_pct in ((-60, 1.5, 5.0), (-50, 0.9, 0.1)):
        soc_pct = frames[place].soc_pct - error_pct
        frames[place] = replace(frames[place], soc_pct=soc_pct, soc_std_pct=std_pct)
    found = verdict(observed(published=frames))
    assert (found.passed, found.std_pct) == (False, 0.1)


def test_single_wrong_frame_fails() -> None:
    frames = published()
    frames[-50] = replace(frames[-50], soc_pct=frames[-50].soc_pct - 3.0)
    assert not verdict(observed(published=frames)).passed


def test_soc_error_during_the_fault_passes() -> None:
    found = verdict(observed(published=published(-5.0, *FAULT)))
    assert found.passed
    assert found.worst_error_pct == pytest.approx(5.0, abs=0.02)


def test_valid_without_a_number_fails() -> None:
    frames = published()
    frames[-10] = replace(frames[-10], soc_pct=math.nan)
    assert not verdict(observed(published=frames)).passed


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


def test_stale_and_invalid_passes() -> None:
    run = observed(
        good_sent_s=without("current", 20.0), published=published(INVALID, FAULT[0] + 2.0, FAULT[1])
    )
    found = verdict(run)
    assert found.passed
    assert found.worst_status == "invalid"
    assert found.not_valid_s == pytest.approx(18.0, abs=0.2)


def test_missing_role_fails() -> None:
    good = {**observed().good_sent_s, "voltage": []}
    assert not verdict(observed(good_sent_s=good)).passed


def test_unexpected_silence_fails() -> None:
    gone = published(None, 1090.0, 1095.0)
    found = verdict(observed(published=gone))
    assert found.failures == ("silent for 5.1 s",)
    assert verdict(
        observed(published=gone, expected_silence_s=[(1089.0, 1091.0), (1090.5, 1094.0)])
    ).passed


def test_silence_until_the_end_fails() -> None:
    found = verdict(observed(published=published(None, 1120.0)))
    assert "nothing published after the fault" in found.failures
    assert found.last_status == "none"
    assert not verdict(observed(published=[])).passed


def test_unexpected_end_of_the_process_fails() -> None:
    found = verdict(observed(incidents=["ended by itself, status -11"]))
    assert found.failures == ("ended by itself, status -11",)


@pytest.mark.parametrize(
    "bad",
    [
        {"published": published(DEGRADED, 1185.0)},
        {"published": published(DEGRADED, 1079.5, 1081.0)},
        {"published": []},
        {"incidents": ["ended by itself, status 1"]},
    ],
)
def test_invalid_undisturbed_run_is_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="undisturbed"):
        Reference(observed(**bad))


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
