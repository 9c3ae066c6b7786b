"""The loop: rates, silence and ends on a simulated clock; senders and failures on buses."""

from __future__ import annotations

import itertools
from pathlib import Path

import can
import numpy as np
import pytest
from simulated import EPOCH_S, GIVEN, SimulatedPort, frames_every, simulate

from cangauge.bus.connection import BusConnection, BusError
from cangauge.bus.open import BusAddress
from cangauge.bus.publish import SocReader
from cangauge.bus.time_source import clock_frame
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.loop import Loop
from cangauge.service.output import Output
from cangauge.service.own_frames import OwnFrames
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.status import Monitor
from cangauge.service.status_client import Snapshot
from cangauge.types import Estimate, Reason, Sample, Status
from live import (
    BrokenBus,
    Rows,
    frames_of,
    leaf_model,
    loop_config,
    network_down,
    never,
    short_log,
    virtual_port,
    virtual_service,
    waits,
)
from selection import nightly_except

GENERIC = Vehicle.load("generic")


@pytest.mark.parametrize(
    ("step_s", "stamp_rate"),
    nightly_except(
        ((0.0007, 1.0), (0.137, 1.0), (100.0, 1.0), (0.02, -3.0)),
        ((0.0007, 1.0), (0.03, 1.0), (0.137, 1.0), (1.0, 1.0), (100.0, 1.0), (0.02, -3.0),
         (0.02, 40.0)),
    ),
)  # fmt: skip
def test_publishes_every_100_ms_at_any_input_rate(step_s: float, stamp_rate: float) -> None:
    seconds = 5 if step_s > 0.001 else 1
    frames = frames_every(step_s, seconds, stamp=lambda at_s: EPOCH_S + stamp_rate * at_s)
    port = simulate(SimulatedPort(frames), seconds + 0.05)
    published = [at_s for at_s, _ in port.published if at_s < seconds + 0.05]
    assert len(published) == 10 * seconds + 1
    for number, at_s in enumerate(published):
        assert 0.1 * number - 1e-9 <= at_s <= 0.1 * number + 0.0101
    reader = SocReader()
    details = [f for _, f in port.sent if reader.read(f)[0] == "soc_detail"]
    assert len(details) == seconds + 1


def test_heartbeat_waits_briefly_for_the_next_sample() -> None:
    port = simulate(SimulatedPort(frames_every(0.1, 5.0, 0.004)), 5.0)
    expected = [pytest.approx(0.1 * number + 0.004) for number in range(1, 10)]
    assert [round(at_s, 3) for at_s, _ in port.published[1:10]] == expected
    reader = SocReader()
    read = [reader.read(frame) for _, frame in port.sent]
    assert [each["samples"] for name, each in read if name == "soc_detail"][:5] == [
        1,
        11,
        21,
        31,
        41,
    ]


def test_a_waiting_current_is_stale_after_a_silence() -> None:
    current = GENERIC.current.key
    frames = [
        (at_s, frame)
        for at_s, frame in frames_every(0.1, 2.1)
        if at_s < 1.95 or frame.arbitration_id == current
    ]
    port = simulate(SimulatedPort(frames), 10.0)
    last = port.published[-1][1]
    assert last.status is Status.INVALID
    assert last.reasons & Reason.INPUT_STALE
    assert last.age_s >= 7.0


def test_missed_heartbeats_are_skipped_on_the_grid() -> None:
    port = SimulatedPort([*frames_every(0.1, 2.0), *frames_every(0.1, 12.0, 9.0)])
    port.suspended_s = (2.0, 5.678)
    simulate(port, 12.0)
    published = [at_s for at_s, _ in port.published]
    steps = [b - a for a, b in itertools.pairwise(published)]
    assert sum(step > 0.2 for step in steps) == 1
    assert min(steps) > 0.02
    assert all(abs(at_s * 10.0 - round(at_s * 10.0)) < 0.11 for at_s in published[-20:])


def test_soc_is_unknown_then_old_then_fresh_again() -> None:
    port = SimulatedPort([*frames_every(0.1, 4.0, 1.0), *frames_every(0.1, 40.0, 38.0)])
    simulate(port, loop_config(timeout_s=0.3, duration_s=40.0))
    unknown = [content for at_s, content in port.published if at_s < 0.9]
    assert {each.status for each in unknown} == {Status.INITIALISING}
    assert all(np.isnan(each.soc_pct) and np.isnan(each.age_s) for each in unknown)
    since = {at_s: each for at_s, each in port.published if at_s > 1.1}
    old = {at_s: each for at_s, each in since.items() if each.reasons & Reason.INPUT_STALE}
    # 0.3 s after the last sample, until the next one.
    assert (min(old), max(old)) == (pytest.approx(4.2, abs=0.012), pytest.approx(37.9, abs=0.012))
    assert {each.status for each in old.values()} == {Status.INVALID}
    assert len({each.soc_pct for each in old.values()}) == 1
    assert next(each.age_s for at_s, each in old.items() if at_s > 10.0) == 6.0
    assert {each.age_s for at_s, each in old.items() if at_s > 34.5} == {30.0}
    assert port.published[-1][1].status is Status.DEGRADED  # its delay line is still filling


@pytest.mark.parametrize("interface", ["socketcan", "pcan"])
def test_backlog_is_stale_until_it_is_processed(interface: str) -> None:
    """The service is suspended from 3.0 to 9.0 s, then reads the backlog within two seconds."""
    port = SimulatedPort(frames_every(0.02, 14.0))
    port.address = BusAddress(interface, "can0")
    port.suspended_s = (3.0, 6.0)
    # The backlog is six seconds of fifty samples of two frames, plus what arrives meanwhile.
    port.work_s = lambda since_s: 0.0025 if 9.0 <= since_s < 11.0 else 0.0
    simulate(port, 14.0)
    fresh = [content for at_s, content in port.published if 0.5 < at_s < 3.0 or at_s > 13.0]
    assert not any(each.reasons & Reason.INPUT_STALE for each in fresh)
    behind = [content for at_s, content in port.published if 9.0 < at_s < 9.9]
    assert len(behind) >= 9
    if interface == "socketcan":
        assert {each.status for each in behind} == {Status.INVALID}
        assert all(each.reasons & Reason.INPUT_STALE for each in behind)
        assert behind[0].age_s == 6.0  # falls by three seconds a second
        assert behind[-1].age_s == 3.0
    else:  # without kernel stamps the lag is not known
        assert not any(each.reasons & Reason.INPUT_STALE for each in behind[1:])


def test_a_process_stopped_for_ten_minutes_knows_what_it_missed() -> None:
    """It is stopped at 3 s; the kernel's queue holds one second, and is full for the rest."""
    frames = [*frames_every(0.02, 4.0), *frames_every(0.02, 620.0, from_s=603.1)]
    port = SimulatedPort(frames)
    port.address = BusAddress("socketcan", "can0")
    port.suspended_s = (3.0, 600.0)
    port.work_s = lambda since_s: 0.005 if since_s < 603.5 else 0.0
    simulate(port, 620.0)
    behind = [content for at_s, content in port.published if 603.0 < at_s < 603.3]
    after = [content for at_s, content in port.published if at_s > 615.0]
    assert behind
    assert all(each.status is not Status.VALID for each in behind)
    assert all(each.reasons & Reason.INPUT_STALE for each in behind)
    assert not any(each.reasons & Reason.INPUT_STALE for each in after)
    assert all(each.reasons & Reason.CURRENT_GAP for each in after[-10:])
    assert all(each.status is not Status.VALID for each in after[-10:])


def test_ends_after_duration_or_when_idle() -> None:
    port = simulate(SimulatedPort([]), loop_config(duration_s=0.3, until_idle_s=0.1))
    assert port.since_s == pytest.approx(0.3, abs=0.1)  # idle before the first sample: no end
    frames = frames_every(0.1, 3.0, 1.0)
    port = simulate(SimulatedPort(frames), loop_config(until_idle_s=0.5))
    assert port.since_s == pytest.approx(3.4, abs=0.11)


def test_checkpoints_come_soon_periodically_and_at_the_end() -> None:
    port, asked = SimulatedPort([]), list[float]()
    settings = loop_config(duration_s=2.6, state_every_s=1.2)
    simulate(port, settings, checkpoint=lambda: asked.append(port.since_s))
    assert asked == [pytest.approx(at_s, abs=0.11) for at_s in (1.0, 2.2, 2.6)]


# --- On a virtual bus


class Failing(Output):
    def __init__(self) -> None:
        self.calls = 0

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        self.calls += 1
        raise RuntimeError("broken")


def test_an_output_of_snapshots_costs_no_estimate_for_each_sample() -> None:
    class Counting(Pipeline):
        read = 0

        @property
        def latest(self) -> Estimate:
            self.read += 1
            return super().latest

    class Snapshots(Output):
        taken = 0

        def on_snapshot(self, _snapshot: Snapshot) -> None:
            self.taken += 1

    port = SimulatedPort(frames_every(0.01, 10.0))
    pipeline, output = Counting(GENERIC, leaf_model(), GIVEN), Snapshots()
    monitor = Monitor(pipeline, port, clock=lambda: port.now_s)  # type: ignore[arg-type] # has what is used
    simulate(port, 10.0, pipeline, outputs=[output], monitor=monitor)
    assert pipeline.samples > 900
    assert output.taken >= 40
    assert pipeline.read < 200


def test_a_failing_output_and_an_idle_replay_clock_are_told_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    pipeline, failing, rows = Pipeline(GENERIC, leaf_model()), Failing(), Rows([])
    with virtual_port("fails", pipeline.filters) as port, virtual_port("fails") as sender:
        loop = Loop(port, pipeline, loop_config(), outputs=[failing, rows])
        for frame in [*[clock_frame(5_000_000)] * 3, *frames_of(short_log(2.0))]:
            sender.send(frame)
        loop.run(lambda: pipeline.samples == 20)
    # It is called no more, and the others are.
    assert (failing.calls, len(rows.rows)) == (1, 20)
    told = [each.getMessage() for each in caplog.records if each.name == "cangauge.service.loop"]
    assert len(told) == 2
    assert any("Failing has ended: RuntimeError('broken')" in line for line in told)
    assert any("--time-source replay-clock" in line for line in told)


def test_a_signal_that_never_comes_is_logged_after_a_minute(
    caplog: pytest.LogCaptureFixture,
) -> None:
    frames = frames_every(1.0, 70.0)  # without a SoC
    for until_s, count in ((59.0, 0), (70.0, 1)):
        caplog.clear()
        simulate(SimulatedPort(frames), until_s)
        said = [each for each in caplog.records if "never" in each.getMessage()]
        assert len(said) == count
    assert said[0].getMessage() == "soc: PACK_SOC was never seen: no frames of 0x403"


UNSIGNED = """BO_ 256 BMS: 4 X
 SG_ PackCurrent : 0|16@1+ (0.01,0) [0|0] "A" X
 SG_ PackVoltage : 16|16@1+ (0.1,0) [0|0] "V" X
"""


def test_a_current_read_unsigned_is_named_with_its_cure(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a.dbc").write_text(UNSIGNED)
    text = 'dbc = "a.dbc"\ncurrent = "PackCurrent"\nvoltage = "PackVoltage"\n'
    (tmp_path / "a.toml").write_text(text + "temperature.fixed_c = 20\n")
    pipeline = Pipeline(Vehicle.load(map=tmp_path / "a.toml"), leaf_model(), GIVEN)
    frames = []
    for row in range(100):
        number = 100 * (row % 15 - 7) % 65536  # −7 … 7 A
        data = number.to_bytes(2, "little") + (3700).to_bytes(2, "little")
        frame = can.Message(
            EPOCH_S + 0.1 * row, arbitration_id=256, data=data, is_extended_id=False
        )
        frames.append((0.1 * row, frame))
    port = simulate(SimulatedPort(frames), 10.0, pipeline)
    said = [each.getMessage() for each in caplog.records if "unsigned" in each.getMessage()]
    assert len(said) == 1
    assert "just below 655.36 A" in said[0]
    assert "state signed = true under [current] of the map file" in said[0]
    assert port.published[-1][1].reasons & Reason.IMPLAUSIBLE_INPUT


@pytest.mark.parametrize(
    ("bus", "say"),
    [
        (BrokenBus([network_down()]), "receiving failed"),
        (BrokenBus([], sending=network_down()), "sending failed"),
    ],
)
def test_a_lost_bus_ends_the_loop_with_one_line_and_saves_the_state(
    bus: BrokenBus, say: str
) -> None:
    port, saved = BusConnection(bus, BusAddress("virtual", "fake")), list[int]()  # type: ignore[arg-type] # has what is used
    loop = Loop(
        port, Pipeline(GENERIC, leaf_model()), loop_config(), checkpoint=lambda: saved.append(1)
    )
    with pytest.raises(BusError, match=f"virtual fake: {say}") as lost:
        loop.run(never)
    assert lost.value.exit_code == 1
    assert saved == [1]


# --- Another sender of the own ids


def test_two_services_with_the_same_ids_notice_each_other() -> None:
    with virtual_service("rivals") as one, virtual_service("rivals") as two:
        for service in (one, two):
            assert waits(lambda: "sends 0x5A" in "".join(service.warnings))  # noqa: B023
        assert waits(lambda: bool(one.pipeline.published.reasons & Reason.DUPLICATE_SENDER))
    for service in (one, two):
        assert service.monitor.foreign >= 3
        assert service.pipeline.counts["frames"] == 0  # they are not input


@pytest.mark.parametrize("echoes", [False, True])
def test_identical_foreign_frames_are_noticed(echoes: bool) -> None:
    own = OwnFrames(echoes=echoes)
    proofs = []
    for number in range(4):
        mine = can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[number])
        own.note_sent(mine, 1.0)
        assert own.is_echo(mine) == echoes
        assert not own.is_echo(mine)
        proofs.append(own.proves_another(1.0 + number))
    assert proofs == [False, False, True, True]
    assert own.is_shared(5.0)
    assert not own.is_shared(60.0)


def test_rare_foreign_frames_prove_nothing_and_a_lost_echo_is_none() -> None:
    own = OwnFrames(echoes=True)
    assert [own.proves_another(10.0 * number) for number in range(4)] == [False] * 4
    for number in range(3):
        own.note_sent(can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[number]), 1.0)
    assert own.is_echo(can.Message(arbitration_id=0x5A0, is_extended_id=False, data=[2]))
    assert own.foreign == 4


def test_false_frames_do_not_move_the_soc() -> None:
    """In the middle third of a drive a second sender puts 300 A and 300 V between the true ones."""
    settings = PipelineSettings(EstimatorSettings(initial_soc_pct=80.0))
    pipeline = Pipeline(GENERIC, leaf_model(), settings, publishes=False)
    encoder, false, frames = FrameEncoder(GENERIC), FrameEncoder(GENERIC), list[can.Message]()
    for sample in samples_of(short_log(300.0)):
        frames += encoder.encode(sample)
        if 100.0 <= sample.time_s < 200.0:
            wrong = sample._replace(current_a=300.0, voltage_v=300.0, time_s=sample.time_s + 0.03)
            frames += false.encode(wrong)
    during, after = list[Estimate](), list[Estimate]()
    for each in sorted(frames, key=lambda each: each.timestamp):
        time_s = each.timestamp
        pipeline.handle(each)
        if 105.0 < time_s < 205.0:
            during.append(pipeline.estimate_now())
        elif time_s > 260.0:
            after.append(pipeline.estimate_now())
    assert all(each.reasons & Reason.DUPLICATE_SENDER for each in during)
    assert all(each.status is Status.INVALID for each in during)
    # 300 V alone would be an empty pack.
    assert max(abs(each.soc_pct - 79.0) for each in during) < 1.0
    assert all(abs(each.soc_pct - 77.2) < 3.0 * each.soc_std_pct for each in after)
    assert max(each.soc_std_pct for each in after) > 1.5 * during[0].soc_std_pct
    assert pipeline.counts["samples"] < 2200
