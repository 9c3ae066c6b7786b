"""The harness on services broken on purpose and on the real one, over UDP."""

from __future__ import annotations

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import forkserver
from pathlib import Path

import fakes
import pytest

from faults import frames as alter
from faults.catalogue import EVERYTHING, shortened
from faults.criteria import Observation, Row
from faults.fault import Fault
from faults.frames import Profile
from faults.line import udp
from faults.process import Process, Target, prepare
from faults.run import REPEATS, Jobs, Result, run_all

BRIEF = Profile("brief", 75.0, 60.0, (12.0, 42.0), 8.0)
"""7.5 s; the fakes have no delay line to fill."""

GONE = Fault("gone", "no frame for four seconds", BRIEF, frames=alter.drop())


BROKEN: list[tuple[Target, str]] = [
    (fakes.always_valid, "current"),
    (fakes.silent_after_a_fault, "nothing published after the fault"),
    (fakes.drifts_after_a_fault, "SoC 2.0 % off with σ 1.0 %, valid after recovery"),
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
def results() -> dict[Target, list[Result]]:
    """Undisturbed run and fault of every fake, in parallel on separate buses."""

    def one(number: int) -> list[Result]:
        target = FAKES[number]
        # These have no valid undisturbed run, and a repetition would take as long.
        repeats = 0 if target in (fakes.hard_to_stop, fakes.never_valid) else REPEATS
        found = run_all(
            [GONE], lambda line: udp(5 * number + line), Jobs(2, 1), 1, target=target,
            repeats=repeats,
        )  # fmt: skip
        return list(found)

    with ThreadPoolExecutor(len(FAKES)) as pool:
        return dict(zip(FAKES, pool.map(one, range(len(FAKES))), strict=True))


def test_correct_service_passes(results: dict[Target, list[Result]]) -> None:
    for each in results[fakes.honest]:
        assert each.verdict is not None
        assert each.verdict.failures == ()
    assert results[fakes.honest][1].verdict.worst_status == "invalid"  # type: ignore[union-attr] # not None


@pytest.mark.parametrize(("target", "failure"), BROKEN)
def test_broken_service_fails(
    results: dict[Target, list[Result]], target: Target, failure: str
) -> None:
    _, gone = results[target]
    assert gone.verdict is not None
    assert failure in " ".join(gone.verdict.failures)


@pytest.mark.parametrize(("target", "failure"), NO_REFERENCE)
def test_without_undisturbed_run_nothing_is_judged(
    results: dict[Target, list[Result]], target: Target, failure: str
) -> None:
    for each in results[target]:
        assert each.verdict is None
        assert failure in each.reason


def test_real_service_passes_some_faults() -> None:
    names = ("drop 20 %", "CRC wrong, some", "counter jumps", "DLC short", "NaN at times")
    # Short profiles; `make faults` runs the full ones.
    done = run_all(
        [shortened(EVERYTHING[name]) for name in names],
        lambda number: udp(60 + number), Jobs(7, 1), seed=1,
    )  # fmt: skip
    for each in done:
        assert each.verdict is not None, each.reason
        assert each.verdict.failures == (), each.fault.name


def test_verdicts_fall_one_by_one_and_no_run_begins_after_the_end_of_the_time() -> None:
    faults = [replace(GONE, name=name) for name in ("first", "second")]
    found = run_all(
        faults, lambda line: udp(80 + line), Jobs(1, 1), 1, target=fakes.honest,
        until_s=time.monotonic() + 2.0,
    )  # fmt: skip
    undisturbed = next(found)
    at_s = time.monotonic()
    first, second = found
    assert undisturbed.verdict is not None
    assert time.monotonic() - at_s < 5.0
    for each in (first, second):
        assert each.verdict is None
        assert each.reason == "no time was left for it"
        assert json.loads(json.dumps(Row.of(each.fault, "udp", None, each.reason).as_json()))


def test_run_that_the_machine_delays_is_repeated_and_then_void(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    delayed = []

    def late(fault: Fault, *_arguments: object) -> Observation:
        delayed.append(fault.name)
        return Observation(late_s=2.0)

    monkeypatch.setattr("faults.run.run_fault", late)
    found = list(run_all([GONE], lambda line: udp(90 + line), Jobs(1, 1), 1, repeats=2))
    assert delayed.count("gone") == delayed.count("undisturbed") == 3
    for each in found:
        assert each.verdict is None
        assert each.reason == "the machine delayed its frames by 2.0 s"


def test_status_at_the_end_is_right_while_other_processes_start(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # multiprocessing asks for the status of all its processes wherever one starts; the status
    # is in a pipe, and of two threads that read it the second finds none.
    read, readers = forkserver.read_signed, []

    def first_slowly(pipe: int) -> int:
        readers.append(pipe)
        if len(readers) == 1:
            time.sleep(0.5)
        return read(pipe)

    process = Process([], tmp_path / "first.txt", fakes.waits)
    process.start()
    while not process.output():
        time.sleep(0.01)
    monkeypatch.setattr(forkserver, "read_signed", first_slowly)
    stopping = threading.Thread(target=process.stop)
    stopping.start()
    while not readers:
        time.sleep(0.01)
    other = Process([], tmp_path / "other.txt", fakes.waits)
    other.start()
    stopping.join()
    other.kill()
    assert process.incidents == []
