"""The fuzzer itself finds hangs, crashes, errors and growth; otherwise a clean table is void."""

from __future__ import annotations

from random import Random

import faulty_targets as faulty
import pytest

from cangauge.errors import InputError
from fuzzing.mutate import mutate_json
from fuzzing.supervise import Share, Tally, fuzz, input_of, try_one
from fuzzing.target import FindingError, Target, attempt
from fuzzing.targets import targets


def test_hangs_deaths_errors_and_growth_are_found() -> None:
    done: list[int] = []
    tallies = fuzz(
        [Share("faulty", 0, 30), Share("faulty", 30, 60)],
        seed=1,
        workers=2,
        progress=lambda _, inputs: done.append(inputs),
        module="faulty_targets",
        hang_s=3.0,
    )
    tally = tallies["faulty"]
    found = {example.number: what for (what, _), example in tally.findings.items()}
    assert found == {
        faulty.HANGS: "hung",
        faulty.DIES: "died with exit code -9",
        faulty.RAISES: "KeyError",
        faulty.GROWS: "too much memory",
    }
    assert (tally.inputs, tally.accepted, tally.refused) == (60, 30, 27)
    assert sum(done) == 58


def test_a_message_that_is_no_line_is_a_finding() -> None:
    def run(_: bytes) -> bool:
        error = InputError("fine")
        error.args = ("two\nlines",)
        raise error

    target = Target("x", lambda _: b"", run, 1.0)
    with pytest.raises(FindingError):
        attempt(target, b"")


def test_slow_ones_are_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fuzzing.supervise.SLOW_S", 0.02)
    tally = Tally()
    try_one(Target("x", lambda _: b"", lambda _: sum(range(3_000_000)) > 0, 1.0), b"", 5, tally)
    assert ("too slow", "x") in tally.findings


@pytest.mark.parametrize("target", targets(), ids=lambda target: target.name)
def test_the_same_seed_and_number_are_the_same_input(target: Target) -> None:
    assert [input_of(target, 3, n) for n in range(5)] == [input_of(target, 3, n) for n in range(5)]
    assert len({input_of(target, 3, n) for n in range(20)}) > 10
    assert input_of(target, 3, 1) != input_of(target, 4, 1)


def test_numbers_that_no_float_can_hold_can_be_mutated() -> None:
    mutants = [mutate_json(Random(seed), {"x": 10**400}) for seed in range(300)]  # noqa: S311
    assert {"x": 10**401} in mutants
