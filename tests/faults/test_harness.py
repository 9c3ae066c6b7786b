"""The whole harness, on services that are broken on purpose, and on the real one, over UDP."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import fakes
import pytest

from faults import alter
from faults.catalogue import EVERYTHING, shortened
from faults.drive import Profile
from faults.fault import Fault
from faults.line import udp
from faults.process import Target, prepare
from faults.schedule import Done, Jobs, run_all
from faults.table import Row

pytestmark = pytest.mark.slow

BRIEF = Profile("brief", 75.0, 60.0, (12.0, 42.0), 8.0)
"""Seven seconds and a half; none of the fakes has a delay line to fill."""

GONE = Fault("gone", "no frame for four seconds on the clock", BRIEF, frames=alter.drop())


BROKEN: list[tuple[Target, str]] = [
    (fakes.always_valid, "current"),
    (fakes.silent_after_a_fault, "nothing published after the fault"),
    (fakes.drifts_after_a_fault, "SoC 2.0 % off and valid after recovery"),
    (fakes.dies_of_a_fault, "ended by itself, status 1"),
]
NO_REFERENCE: list[tuple[Target, str]] = [
    (fakes.hard_to_stop, "exit status 3"),
    (fakes.never_valid, "not valid"),
    (fakes.does_not_start, "does not start"),
]
FAKES = [fakes.honest, *(target for target, _ in [*BROKEN, *NO_REFERENCE])]


@pytest.fixture(scope="module", autouse=True)
def _server() -> None:
    prepare()


@pytest.fixture(scope="module")
def results() -> dict[Target, list[Done]]:
    """Undisturbed run and fault of every fake; all at once, each on lines of its own."""

    def one(number: int) -> list[Done]:
        target = FAKES[number]
        return run_all(
            [GONE], lambda line: udp(5 * number + line), Jobs(2, 1), 1, target=target,
            # These have no reference, and a second try takes as long as the first.
            again_if_disturbed=target not in (fakes.hard_to_stop, fakes.never_valid),
        )  # fmt: skip

    with ThreadPoolExecutor(len(FAKES)) as pool:
        return dict(zip(FAKES, pool.map(one, range(len(FAKES))), strict=True))


def test_an_honest_service_passes(results: dict[Target, list[Done]]) -> None:
    for each in results[fakes.honest]:
        assert each.verdict is not None
        assert each.verdict.failures == ()
    assert results[fakes.honest][1].verdict.worst_status == "invalid"  # type: ignore[union-attr] # not None


@pytest.mark.parametrize(("target", "said"), BROKEN)
def test_a_broken_service_fails(
    results: dict[Target, list[Done]], target: Target, said: str
) -> None:
    _, gone = results[target]
    assert gone.verdict is not None
    assert said in " ".join(gone.verdict.failures)


@pytest.mark.parametrize(("target", "said"), NO_REFERENCE)
def test_what_cannot_even_run_undisturbed_is_not_judged(
    results: dict[Target, list[Done]], target: Target, said: str
) -> None:
    for each in results[target]:
        assert each.verdict is None
        assert said in each.why_not


def test_the_service_survives_a_few_faults() -> None:
    names = ("drop 20 %", "CRC wrong, some", "counter jumps", "DLC short", "NaN at times")
    # What is left after a short time is not asked here: that is `make faults`.
    done = run_all(
        [shortened(EVERYTHING[name]) for name in names],
        lambda number: udp(60 + number), Jobs(7, 1), seed=1,
    )  # fmt: skip
    for each in done:
        assert each.verdict is not None, each.why_not
        assert each.verdict.failures == (), each.fault.name
    rows = [Row.of(each.fault, "udp", each.verdict) for each in done]
    assert [repr(Row.from_json(row.as_json())) for row in rows] == [repr(row) for row in rows]
