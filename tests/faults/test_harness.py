"""The whole harness, on services that are broken on purpose, and on the real one, over UDP."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import fakes
import pytest

from faults import alter
from faults.catalogue import EVERYTHING, ON_VCAN, shortened
from faults.drive import Profile
from faults.fault import Fault
from faults.judge import Verdict
from faults.line import udp
from faults.process import prepare
from faults.schedule import Jobs, run_all
from faults.table import Row

pytestmark = pytest.mark.slow

BRIEF = Profile("brief", 75.0, 80.0, (20.0, 50.0), 8.0)
"""Ten seconds; none of the fakes has a delay line to fill."""

GONE = Fault("gone", "no frame for four seconds on the clock", BRIEF, frames=alter.drop())


@pytest.fixture(scope="module", autouse=True)
def _server() -> None:
    prepare()


def verdict(target: Callable[[list[str]], None]) -> Verdict:
    # A line for each: those that run at the same time in other tests have others.
    _, gone = run_all([GONE], lambda number: udp(500 + number), Jobs(2, 1), 1, target=target)
    return gone.verdict


def test_an_honest_service_passes() -> None:
    found = verdict(fakes.honest)
    assert found.failures == ()
    assert found.worst_status == "invalid"


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (fakes.always_valid, "current"),
        (fakes.silent_after_a_fault, "nothing published after the fault"),
        (fakes.drifts_after_a_fault, "SoC 2.0 % off and valid after recovery"),
        (fakes.dies_of_a_fault, "ended by itself, status 1"),
    ],
)
def test_a_broken_service_fails(target: Callable[[list[str]], None], said: str) -> None:
    assert said in " ".join(verdict(target).failures)


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (fakes.hard_to_stop, "exit status 3"),
        (fakes.never_valid, "not valid"),
        (fakes.does_not_start, "does not start"),
    ],
)
def test_what_cannot_even_run_undisturbed_is_an_error(
    target: Callable[[list[str]], None], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        verdict(target)


def test_the_catalogue() -> None:
    assert len(EVERYTHING) >= 40
    assert {fault.name for fault in ON_VCAN} <= EVERYTHING.keys()
    assert len({fault.done + fault.profile.name + fault.name for fault in ON_VCAN}) == len(ON_VCAN)


def test_the_service_survives_a_few_faults() -> None:
    names = ("drop 20 %", "CRC wrong, some", "counter jumps", "DLC short", "NaN at times")
    # What is left after a short time is not asked here: that is `make faults`.
    done = run_all(
        [shortened(EVERYTHING[name]) for name in names],
        lambda number: udp(600 + number), Jobs(4, 1), seed=1,
    )  # fmt: skip
    for each in done:
        assert each.verdict.failures == (), each.fault.name
    rows = [Row.of(each.fault, "udp", each.verdict) for each in done]
    assert [repr(Row.from_json(row.as_json())) for row in rows] == [repr(row) for row in rows]


def test_the_same_seed_gives_the_same_frames() -> None:
    from random import Random  # noqa: PLC0415

    from cangauge.bus.vehicle import load_vehicle  # noqa: PLC0415
    from faults.drive import events  # noqa: PLC0415

    vehicle = load_vehicle("generic")
    change = alter.both(alter.crc_wrong(0.3), alter.shuffle(0.5))

    def made(seed: int) -> list[tuple[float, bytes]]:
        rng = Random(seed)  # noqa: S311 - must be repeatable
        found = change(events(BRIEF, vehicle), BRIEF, vehicle, rng)
        return [(event.at_s, bytes(event.frame.data)) for event in found]

    assert made(1) == made(1) != made(2)
    assert replace(GONE, name="x").alike == GONE.alike
