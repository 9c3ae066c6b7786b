"""Published frames: bits and times."""

from __future__ import annotations

import math
from pathlib import Path

import can
import cantools
import crccheck.crc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.publish import FrameIds, SocDetail, SocEstimate, SocPublisher, SocReader
from cangauge.errors import InputError
from cangauge.types import Estimate, Reason, Status

numbers = st.floats(-1e4, 1e4) | st.just(math.nan)


def estimate(time_s: float = 0.0, **values: object) -> Estimate:
    base = Estimate(time_s, 63.217, 1.5, 62.1, 63.9, 370.0, -0.25, Status.VALID, Reason.NONE, 1)
    return base._replace(**values)


def decoded(project: Path, message: can.Message) -> dict[str, object]:
    database = cantools.database.load_file(project / "dbc" / "soc_estimate.dbc")
    return database.decode_message(message.arbitration_id, message.data, decode_choices=False)


def test_the_dbc_decodes_the_published_frames(project: Path) -> None:
    publisher = SocPublisher()
    first, detail = publisher.beat(
        estimate(status=Status.DEGRADED, reasons=Reason.CURRENT_GAP | Reason.CURRENT_MISSING),
        70_000,
        age_s=12.9,
    )
    assert first.arbitration_id == 0x5A0
    assert detail.arbitration_id == 0x5A1
    values = decoded(project, first)
    assert values["soc_pct"] == pytest.approx(63.217, abs=0.005)
    assert values["soc_std_pct"] == pytest.approx(1.5, abs=0.025)
    assert values["status"] == 2
    assert values["age_s"] == 12
    assert values["reason"] == (1 << 1) | (1 << 15)
    values = decoded(project, detail)
    assert values["soc_newton_pct"] == pytest.approx(62.1, abs=0.0125)
    assert values["soc_coulomb_pct"] == pytest.approx(63.9, abs=0.0125)
    assert values["residual_v"] == pytest.approx(-0.25, abs=0.005)
    assert values["samples"] == 70_000 % 65_536


def test_unknown_values_have_their_codes(project: Path) -> None:
    nan = math.nan
    unknown = estimate(
        soc_pct=nan, soc_std_pct=nan, soc_newton_pct=nan, soc_coulomb_pct=nan, residual_v=nan,
        status=Status.INITIALISING, reasons=Reason.NO_INITIAL_SOC,
    )  # fmt: skip
    publisher = SocPublisher()
    first, detail = publisher.beat(unknown, 0, math.nan)
    values = decoded(project, first)
    assert (values["status"], values["reason"]) == (0, 1 << 10)
    # The "not available" codes of the DBC: 31, 16383 and 2047.
    assert (values["age_s"], values["soc_pct"]) == (31, pytest.approx(16383 * 0.01))
    assert values["soc_std_pct"] == pytest.approx(2047 * 0.05)
    reader = SocReader()
    read = reader.read(first)
    assert isinstance(read, SocEstimate)
    assert math.isnan(read.soc_pct)
    assert math.isnan(read.soc_std_pct)
    assert math.isnan(read.age_s)
    told = reader.read(detail)
    assert isinstance(told, SocDetail)
    assert math.isnan(told.residual_v)
    assert math.isnan(told.soc_newton_pct)


@given(numbers, numbers, numbers)
def test_any_number_is_sent_and_read_back_clipped(soc: float, std: float, residual: float) -> None:
    publisher, reader = SocPublisher(), SocReader()
    given_estimate = estimate(soc_pct=soc, soc_std_pct=std, residual_v=residual)
    read = reader.read(publisher.estimate_frame(given_estimate))
    told = reader.read(publisher.detail_frame(given_estimate, 5))
    assert isinstance(read, SocEstimate)
    assert isinstance(told, SocDetail)
    for value, sent, low, high, step in (
        (read.soc_pct, soc, 0.0, 163.82, 0.01),
        (read.soc_std_pct, std, 0.0, 102.3, 0.05),
        (told.residual_v, residual, -20.47, 20.47, 0.01),
    ):
        if math.isnan(sent):
            assert math.isnan(value)
        else:
            assert value == pytest.approx(min(max(sent, low), high), abs=0.5001 * step)


def test_counters_count_and_any_damaged_bit_is_refused() -> None:
    publisher, reader = SocPublisher(), SocReader()
    counters = [publisher.estimate_frame(estimate()).data[1] & 15 for _ in range(18)]
    assert counters == [*range(16), 0, 1]
    good = bytes(publisher.estimate_frame(estimate()).data)
    for bit in range(64):
        broken = publisher.estimate_frame(estimate())
        broken.data = bytearray(good)
        broken.data[bit // 8] ^= 1 << bit % 8
        assert reader.read(broken) is None
    assert reader.refused == 64


def test_crcs_agree_with_an_independent_library(project: Path) -> None:
    database = cantools.database.load_file(project / "dbc" / "soc_estimate.dbc")
    publisher = SocPublisher()
    for _ in range(20):
        for message in publisher.beat(estimate(), 7, 0.0):
            attributes = database.get_message_by_frame_id(message.arbitration_id).dbc.attributes
            data_ids = list(bytes.fromhex(attributes["E2EDataIdList"].value))
            # CRC-8H2F over bytes 1-7, then the data id of this counter.
            covered = bytes([*message.data[1:], data_ids[message.data[1] & 15]])
            assert crccheck.crc.Crc8Autosar.calc(covered) == message.data[0]


def test_frames_under_a_swapped_id_are_refused() -> None:
    swapped = SocReader(FrameIds(soc_estimate=0x5A1, soc_detail=0x5A0))
    for message in SocPublisher().beat(estimate(), 7, 0.0):
        assert swapped.read(message) is None
    assert swapped.refused == 2


def test_each_beat_has_an_estimate_each_tenth_a_detail() -> None:
    publisher = SocPublisher()
    beats = [publisher.beat(estimate(), beat, 0.0) for beat in range(40)]
    assert all(frames[0].arbitration_id == 0x5A0 for frames in beats)
    assert [beat for beat, frames in enumerate(beats) if len(frames) == 2] == [0, 10, 20, 30]


def test_an_age_is_sent_in_whole_seconds_up_to_30() -> None:
    publisher, reader = SocPublisher(), SocReader()
    told = []
    for age_s in (0.0, 0.99, 1.0, 29.99, 30.0, 31.0, 1e9):
        read = reader.read(publisher.estimate_frame(estimate(), age_s))
        assert isinstance(read, SocEstimate)
        told.append(read.age_s)
    assert told == [0.0, 0.0, 1.0, 29.0, 30.0, 30.0, 30.0]


@pytest.mark.parametrize("rate_hz", [10.0, 100.0, 12.5])
def test_a_replay_publishes_at_the_rate_of_log_time(rate_hz: float) -> None:
    publisher = SocPublisher()
    times: dict[int, list[float]] = {0x5A0: [], 0x5A1: []}
    for sample in range(int(20.0 * rate_hz)):
        now_s = 1_700_000_000.0 + sample / rate_hz
        for message in publisher.publish(estimate(now_s), sample + 1):
            times[message.arbitration_id].append(now_s)
    # Samples do not fall on the grid: it is kept on average, within one sample.
    for frame_id, every_s in ((0x5A0, 0.1), (0x5A1, 1.0)):
        assert len(times[frame_id]) == pytest.approx(20.0 / every_s, abs=1)
        steps = [b - a for a, b in zip(times[frame_id], times[frame_id][1:], strict=False)]
        assert max(steps) <= every_s + 1.0 / rate_hz + 1e-6


def test_jitter_does_not_halve_the_rate() -> None:
    publisher = SocPublisher()
    sent = 0
    for sample in range(1000):
        jitter = 0.004 if sample % 2 else -0.004
        sent += any(
            message.arbitration_id == 0x5A0
            for message in publisher.publish(estimate(100.0 + 0.1 * sample + jitter), sample)
        )
    assert sent == 1000


def test_samples_of_one_log_time_send_one_estimate() -> None:
    publisher = SocPublisher()
    for sample in range(2000):
        sent = [publisher.publish(estimate(0.1 * sample), sample) for _ in range(2)]
        estimates = [[each.arbitration_id for each in frames].count(0x5A0) for frames in sent]
        assert estimates == [1, 0]


def test_samples_are_acknowledged_at_a_fixed_interval() -> None:
    publisher = SocPublisher(acknowledge_every=4)
    told = [
        sample
        for sample in range(1, 40)
        for message in publisher.publish(estimate(0.001 * sample), sample)
        if message.arbitration_id == 0x5A1
    ]
    assert told == list(range(1, 40, 4))
    # The next beat acknowledges the remaining samples; later beats have none.
    assert len(publisher.beat(estimate(), 39, 0.0)) == 2
    assert [len(publisher.beat(estimate(), 39, 0.0)) for _ in range(3)] == [1, 1, 1]


def test_ids_must_differ() -> None:
    with pytest.raises(InputError, match=r"ids\.soc_detail"):
        FrameIds(soc_estimate=0x100, soc_detail=0x100)
    frame = SocPublisher(FrameIds(0x10, 0x11, 0x12)).estimate_frame(estimate())
    assert frame.arbitration_id == 0x10
    assert SocReader().read(frame) is None
