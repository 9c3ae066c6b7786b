"""The judge of the faults, shown runs made by hand: each of its rules must be able to fail."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from faults.judge import DEGRADED, INVALID, VALID, Reference, Seen, Told, Verdict, judge

BEGAN, FAULT, ENDED = 1000.0, (1080.0, 1100.0), 1190.0


def drive(time_s: float) -> float:
    """SoC of the undisturbed run [%]."""
    return 70.0 - 0.02 * (time_s - BEGAN)


def seen(**changes: object) -> Seen:
    """A run in which nothing went wrong; a second more is listened after its end."""
    times = [BEGAN + 0.1 * number for number in range(1901)]
    run = Seen(
        told=[Told(time_s + 0.01, drive(time_s), VALID, 0) for time_s in times],
        sent_s=times,
        bus_s=[time_s - BEGAN for time_s in times],
        good_s={role: list(times) for role in ("current", "voltage", "temperature")},
        fault_s=FAULT,
        began_s=BEGAN,
        ended_s=ENDED,
        judged_from_s=1171.0,
    )
    return replace(run, **changes)  # type: ignore[arg-type] # names of fields


def told(change: object = 0.0, first: float = 0.0, last: float = math.inf) -> list[Told]:
    """The estimates of that run, changed from … to: a status, a shift of SoC [%], or None: gone."""
    out = []
    for each in seen().told:
        if first <= each.time_s < last:
            if change is None:
                continue
            if isinstance(change, float):
                each = replace(each, soc_pct=each.soc_pct + change)  # noqa: PLW2901
            else:
                each = replace(each, status=change)  # type: ignore[arg-type] # noqa: PLW2901
        out.append(each)
    return out


def verdict(run: Seen) -> Verdict:
    return judge(run, Reference(seen()))


def without(role: str, seconds: float) -> dict[str, list[float]]:
    """Good frames of a run in which a role is missing from the fault's begin on."""
    times = {key: list(value) for key, value in seen().good_s.items()}
    times[role] = [t for t in times[role] if not FAULT[0] <= t < FAULT[0] + seconds]
    return times


def test_the_undisturbed_run_passes() -> None:
    found = verdict(seen())
    assert found.passed
    assert found.soc_error_pct == found.worst_error_pct == pytest.approx(0.0, abs=1e-9)
    assert found.stale_valid_s == found.not_valid_s == 0.0
    assert found.last_status == found.worst_status == "valid"


@pytest.mark.parametrize(
    ("shift", "passes"), [(0.98, True), (-0.98, True), (1.1, False), (-1.1, False)]
)
def test_soc_after_recovery(shift: float, passes: bool) -> None:
    found = verdict(seen(told=told(shift, 1150.0)))
    assert found.passed is passes
    assert found.soc_error_pct == pytest.approx(abs(shift), abs=0.011)  # what transport allows


def test_a_wrong_soc_is_none_while_it_is_not_called_valid() -> None:
    wrong = [replace(each, soc_pct=20.0, status=DEGRADED) for each in told()]
    found = verdict(seen(told=wrong))
    assert found.passed
    assert math.isnan(found.soc_error_pct)


def test_one_wrong_frame_among_right_ones_is_seen() -> None:
    frames = told()
    frames[-50] = replace(frames[-50], soc_pct=frames[-50].soc_pct - 3.0)
    assert not verdict(seen(told=frames)).passed


def test_a_soc_that_is_wrong_only_during_the_fault_is_told_but_passes() -> None:
    found = verdict(seen(told=told(-5.0, *FAULT)))
    assert found.passed
    assert found.worst_error_pct == pytest.approx(5.0, abs=0.02)


def test_valid_without_a_number() -> None:
    frames = told()
    frames[-10] = replace(frames[-10], soc_pct=math.nan)
    assert not verdict(seen(told=frames)).passed


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
def test_stale_and_valid(role: str, seconds: float, passes: bool) -> None:
    found = verdict(seen(good_s=without(role, seconds)))
    assert found.passed is passes
    assert (role in " ".join(found.failures)) is not passes


def test_stale_and_marked() -> None:
    run = seen(good_s=without("current", 20.0), told=told(INVALID, FAULT[0] + 2.0, FAULT[1]))
    found = verdict(run)
    assert found.passed
    assert found.worst_status == "invalid"
    assert found.not_valid_s == pytest.approx(18.0, abs=0.2)


def test_a_role_that_never_came() -> None:
    good = {**seen().good_s, "voltage": []}
    assert not verdict(seen(good_s=good)).passed


def test_silence() -> None:
    gone = told(None, 1090.0, 1095.0)
    found = verdict(seen(told=gone))
    assert found.failures == ("silent for 5.1 s",)
    assert verdict(seen(told=gone, excused=[(1089.0, 1091.0), (1090.5, 1094.0)])).passed


def test_silence_until_the_end() -> None:
    found = verdict(seen(told=told(None, 1120.0)))
    assert "nothing published after the fault" in found.failures
    assert found.last_status == "none"
    assert not verdict(seen(told=[])).passed


def test_trouble_of_the_process() -> None:
    found = verdict(seen(troubles=["ended by itself, status -11"]))
    assert found.failures == ("ended by itself, status -11",)


@pytest.mark.parametrize(
    "bad",
    [
        {"told": told(DEGRADED, 1185.0)},
        {"told": told(DEGRADED, 1079.5, 1081.0)},
        {"told": []},
        {"troubles": ["ended by itself, status 1"]},
    ],
)
def test_what_is_no_reference(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="undisturbed"):
        Reference(seen(**bad))
