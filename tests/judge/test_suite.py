"""The conformance suite for gauges: real processes on a bus, one drive."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from cangauge.errors import CangaugeError
from cangauge.extras.judge import suite
from cangauge.extras.judge.suite import FAULTS, Drive, run_suite
from live import in_process, leaf_model
from synthetic import synthetic_log

EXAMPLES = Path(__file__).parents[2] / "examples"
COUNTER = [
    sys.executable, str(EXAMPLES / "gauge_coulomb.py"),
    "{interface}", "{channel}", "{port}", "{capacity_ah}", "{soc}",
]  # fmt: skip
FILTER = [
    sys.executable, str(EXAMPLES / "gauge_filterpy.py"),
    "{interface}", "{channel}", "{port}", "{model}", "{soc}",
]  # fmt: skip
FAULT = {fault.name: fault for fault in FAULTS}


@pytest.fixture(scope="module")
def drive() -> Drive:
    log = synthetic_log(hours=0.15, rate_hz=1.0, start_pct=80.0, end_pct=70.0, noise_v=0.3)
    return log, leaf_model()


def test_a_counter_has_the_errors_of_its_faults(drive: Drive) -> None:
    wanted = [FAULT[name] for name in ("none", "offset +2 A", "start -20 %")]
    none, offset, start = run_suite(COUNTER, [drive], wanted)
    assert none["worst_pct"] < 0.5
    size_a = 2.0 * drive[1].capacity_ah / 60.0
    drift_pct = 100.0 * size_a * drive[0].duration_s / 3600.0 / drive[1].capacity_ah
    assert offset["worst_pct"] == pytest.approx(drift_pct, abs=0.2)
    assert start["mae_pct"] == pytest.approx(20.0, abs=0.3)
    assert start["recovery_s"] == np.inf
    assert none["cover_2sigma"] is None
    assert none["silent"] == 0.0


def test_the_card_has_a_row_for_each_fault(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "simulated_drives", lambda: [drive])
    wanted = [FAULT["none"], FAULT["start -20 %"]]
    monkeypatch.setattr(suite.run_suite, "__defaults__", (wanted, print))
    card = in_process("judge", "--suite", "--", *COUNTER)
    none, start = (
        line.split() for line in card.out.splitlines() if "none" in line or "-20" in line
    )
    assert (none[0], none[-2:]) == ("none", ["–", "0"])
    assert "never" in start


def test_a_filter_recovers_and_states_its_error(drive: Drive) -> None:
    none, start = run_suite(FILTER, [drive], [FAULT["none"], FAULT["start -20 %"]])
    assert none["mae_pct"] < 3.0
    assert start["recovery_s"] < drive[0].duration_s
    assert start["cover_2sigma"] is not None


MUTE = """
import can, sys, time
interface, channel, port = sys.argv[1:]
options = {} if interface == "socketcan" else {"port": int(port)}
with can.Bus(interface=interface, channel=channel, **options) as bus:
    for _ in range(600):
        bus.send(can.Message(arbitration_id=0x5A0, is_extended_id=False, data=bytes(8)))
        bus.recv(0.1)
        while bus.recv(1.0) is None:
            bus.send(can.Message(arbitration_id=0x5A0, is_extended_id=False, data=bytes(8)))
        time.sleep(60.0)
"""


def test_a_mute_gauge_scores_nothing(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(suite, "ANSWER_WITHIN_S", 1.0)
    command = [sys.executable, "-c", MUTE, "{interface}", "{channel}", "{port}"]
    (none,) = run_suite(command, [drive], FAULTS[:1])
    assert none["silent"] > 0.9
    assert none["recovery_s"] == np.inf


def test_a_program_that_says_nothing_is_named(drive: Drive) -> None:
    command = [sys.executable, "-c", "import sys; sys.exit('no licence')"]
    with pytest.raises(CangaugeError, match=r"ended before publishing SOC_ESTIMATE.*no licence"):
        run_suite(command, [drive], FAULTS[:1])
    ended = in_process("judge", "--suite", "--data", ".", "--", "x")
    assert (ended.code, "give both" in ended.err) == (2, True)


def test_there_are_twenty_faults_of_the_count(drive: Drive) -> None:
    assert len({fault.name for fault in FAULTS}) == 21
    log, capacity_ah = drive[0], drive[1].capacity_ah
    for fault in FAULTS[1:]:
        is_current = not np.array_equal(fault.current_a(log, capacity_ah), log.current_a)
        is_cut = not fault.sent(log).all()
        assert is_current or is_cut or fault.start_pct, fault.name
