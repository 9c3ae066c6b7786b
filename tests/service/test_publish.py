"""Published frames: bits, protection and times."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from typing import Any

import can
import cantools
import crccheck.crc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge._resources import shared_file
from cangauge.bus.publish import PackReport, SocPublisher, SocReader
from cangauge.errors import InputError
from cangauge.estimation.cells import UNKNOWN
from cangauge.settings import FrameIds
from cangauge.types import CellReport, Estimate, Health, Power, Reason, Status

NAN = math.nan
# Step, and the ends to which a value is clipped: the codes next to that of "not available".
SENT = {
    "soc_pct": (0.01, 0.0, 163.82),
    "soc_std_pct": (0.05, 0.0, 102.3),
    "soc_newton_pct": (0.025, 0.0, 102.35),
    "soc_coulomb_pct": (0.025, 0.0, 102.35),
    "residual_v": (0.01, -20.47, 20.47),
    "capacity_ah": (0.05, 0.0, 819.1),
    "capacity_std_ah": (0.05, 0.0, 51.1),
    "resistance_ratio": (0.005, 0.0, 5.11),
    "resistance_std": (0.01, 0.0, 1.26),
    "current_offset_a": (0.02, -20.46, 20.46),
    "discharge_a": (2.0, 0.0, 2044.0),
    "discharge_std_a": (4.0, 0.0, 248.0),
    "charge_a": (2.0, 0.0, 2044.0),
    "charge_std_a": (4.0, 0.0, 248.0),
    "energy_kwh": (0.05, 0.0, 409.5),
    "energy_std_kwh": (0.1, 0.0, 12.6),
    "weakest_soc_pct": (0.1, 0.0, 102.2),
    "weakest_soc_std_pct": (0.2, 0.0, 25.2),
    "cell_spread_pct": (0.2, 0.0, 102.0),
    "sum_error_v": (0.02, -40.94, 40.94),
}
USUAL = dict.fromkeys(SENT, 1.0)


@cache
def database() -> Any:
    return cantools.database.load_file(shared_file("dbc", "soc_estimate.dbc"))


def decoded(message: can.Message) -> dict[str, Any]:
    found: dict[str, Any] = database().decode_message(
        message.arbitration_id, message.data, decode_choices=False
    )
    return found


def estimate(time_s: float = 0.0, **values: object) -> Estimate:
    base = Estimate(time_s, 63.217, 1.5, 62.1, 63.9, 370.0, -0.25, Status.VALID, Reason.NONE, 1)
    return base._replace(**values)


def report(values: dict[str, float] = USUAL) -> PackReport:
    at = values.__getitem__
    health = [at(name) for name in list(SENT)[5:10]]
    energy = [1e3 * at("energy_kwh"), 1e3 * at("energy_std_kwh")]
    cells = [at(name) for name in list(SENT)[16:]]
    return PackReport(
        Health(*health),
        Power(*(at(name) for name in list(SENT)[10:14]), *energy),
        CellReport(96, 17, *cells, 0.06, is_sum_wrong=True),
    )


def frames_of(publisher: SocPublisher, values: dict[str, float] = USUAL) -> list[can.Message]:
    """Return a frame of each kind."""
    one = estimate(**{name: values[name] for name in list(SENT)[:5]})
    pack = publisher.report_frames(report(values))
    return [publisher.estimate_frame(one), publisher.detail_frame(one, 70_000), *pack]


NUMBER = st.floats(-1e4, 1e4) | st.just(NAN)


@given(st.lists(NUMBER, min_size=len(SENT), max_size=len(SENT)))
def test_each_value_is_sent_clipped_and_read_as_the_dbc_decodes_it(values: list[float]) -> None:
    reader, given_values = SocReader(), dict(zip(SENT, values, strict=True))
    read: dict[str, float] = {}
    for message in frames_of(SocPublisher(), given_values):
        _, content = reader.read(message)
        assert content
        read |= content
        for name, value in decoded(message).items():
            if name in SENT:
                assert math.isnan(read[name]) or read[name] == pytest.approx(value)
    for name, (step, low, high) in SENT.items():
        expected = (
            min(max(given_values[name], low), high)
            if given_values[name] == given_values[name]
            else NAN
        )
        assert read[name] == pytest.approx(expected, abs=0.5001 * step, nan_ok=True), name
    assert (read["weakest_cell"], read["samples"]) == (17, 70_000 % 65_536)
    assert read["sum_check"] == (1 if math.isnan(given_values["sum_error_v"]) else 2)


def test_status_reasons_and_age() -> None:
    reasons = Reason.CURRENT_GAP | Reason.CURRENT_MISSING
    first, _ = SocPublisher().publish_periodic(
        estimate(status=Status.DEGRADED, reasons=reasons), 1, 12.9
    )
    values = decoded(first)
    assert (values["status"], values["age_s"]) == (2, 12)
    assert values["reason"] == (1 << 1) | (1 << 15)
    name, read = SocReader().read(first)
    assert name == "soc_estimate"
    assert [read[each] for each in ("status", "reason", "age_s")] == [
        Status.DEGRADED,
        reasons,
        12.0,
    ]
    ages = [decoded(SocPublisher().estimate_frame(estimate(), age_s))["age_s"]
            for age_s in (0.0, 0.99, 1.0, 29.99, 30.0, 1e9)]  # fmt: skip
    assert ages == [0, 0, 1, 29, 30, 30]


def test_unknown_values_have_the_codes_of_the_dbc() -> None:
    reader, publisher = SocReader(), SocPublisher()
    pack = publisher.report_frames(PackReport(Health(*[NAN] * 5), Power(), UNKNOWN))
    unknown = estimate(**dict.fromkeys(list(SENT)[:5], NAN))
    frames = [*publisher.publish_periodic(unknown, 0, NAN), *pack]
    for message in frames:
        layout = database().get_message_by_frame_id(message.arbitration_id)
        _, content = reader.read(message)
        raw = layout.decode(message.data, scaling=False, decode_choices=False)
        for signal in layout.signals:
            if signal.name in SENT or signal.name in {"age_s", "weakest_cell"}:
                ones = -(1 << signal.length - 1) if signal.is_signed else (1 << signal.length) - 1
                assert raw[signal.name] == ones, signal.name
                assert math.isnan(content[signal.name])
    assert decoded(frames[-1])["sum_check"] == 0


def test_counters_crcs_and_damaged_bits_of_each_frame() -> None:
    publisher, reader, lists = SocPublisher(), SocReader(), set()
    for count in range(18):
        for message in frames_of(publisher):
            attributes = database().get_message_by_frame_id(message.arbitration_id).dbc.attributes
            data_ids = bytes.fromhex(attributes["E2EDataIdList"].value)
            lists.add(data_ids)
            assert message.data[1] & 15 == count % 16
            # CRC-8H2F over bytes 1-7, then the data id of this counter.
            covered = bytes([*message.data[1:], data_ids[count % 16]])
            assert crccheck.crc.Crc8Autosar.calc(covered) == message.data[0]
    assert len(lists) == 5
    assert all(len(set(each)) == 16 for each in lists)
    for message in frames_of(publisher):
        for bit in range(64):
            message.data[bit // 8] ^= 1 << bit % 8
            assert not reader.read(message)[1]
            message.data[bit // 8] ^= 1 << bit % 8
    assert reader.refused == 5 * 64


def test_ids_are_configured_differ_and_are_protected() -> None:
    with pytest.raises(InputError, match=r"ids\.soc_detail"):
        FrameIds(soc_estimate=0x100, soc_detail=0x100)
    ids = FrameIds(0x10, 0x11, 0x12, 0x13, 0x14, 0x15)
    frames = frames_of(SocPublisher(ids))
    assert [each.arbitration_id for each in frames] == [0x10, 0x11, 0x13, 0x14, 0x15]
    assert not SocReader().read(frames[0])[1]
    swapped = SocReader(FrameIds(soc_estimate=0x5A1, soc_detail=0x5A0))
    for message in SocPublisher().publish_periodic(estimate(), 7, 0.0):
        assert not swapped.read(message)[1]
    assert swapped.refused == 2


# --- Times


def test_each_beat_has_an_estimate_each_tenth_the_others() -> None:
    publisher, asked = SocPublisher(), list[int]()

    def without_cells() -> PackReport:
        asked.append(1)
        return report()._replace(cells=None)

    beats = [publisher.publish_periodic(estimate(), beat, 0.0, without_cells) for beat in range(30)]
    assert all(frames[0].arbitration_id == 0x5A0 for frames in beats)
    assert [len(frames) for frames in beats] == ([4] + [1] * 9) * 3
    assert len(asked) == 3


@pytest.mark.parametrize("rate_hz", [10.0, 100.0, 12.5])
def test_a_replay_publishes_at_the_rate_of_log_time(rate_hz: float) -> None:
    publisher = SocPublisher()
    times: dict[int, list[float]] = {0x5A0: [], 0x5A1: [], 0x5A2: [], 0x5A3: [], 0x5A4: []}
    for sample in range(int(20.0 * rate_hz)):
        now_s = 1_700_000_000.0 + sample / rate_hz
        for message in publisher.publish(estimate(now_s), sample + 1, report):
            times[message.arbitration_id].append(now_s)
    # Samples do not fall on the grid: it is kept on average, within one sample.
    for frame_id, found in times.items():
        every_s = 0.1 if frame_id == 0x5A0 else 1.0
        assert len(found) == pytest.approx(20.0 / every_s, abs=1)
        assert max(b - a for a, b in pairwise(found)) <= every_s + 1.0 / rate_hz + 1e-6


def test_jitter_does_not_halve_the_rate_and_one_log_time_has_one_estimate() -> None:
    publisher = SocPublisher()
    for sample in range(1000):
        time_s = 100.0 + 0.1 * sample + (0.004 if sample % 2 else -0.004)
        sent = [publisher.publish(estimate(time_s), sample) for _ in range(2)]
        assert [[each.arbitration_id for each in frames].count(0x5A0) for frames in sent] == [1, 0]


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
    assert [len(publisher.publish_periodic(estimate(), 39, 0.0)) for _ in range(4)] == [2, 1, 1, 1]


def test_no_pack_has_a_negative_capacity_resistance_or_energy() -> None:
    wrong = PackReport(Health(-1885.0, 3.0, -0.11, 0.02, 0.5, 0.1), Power(10.0, energy_wh=-463e3))
    shown = wrong.to_dict()
    assert shown["health"]["capacity_ah"] is None
    assert shown["health"]["capacity_std_ah"] is None
    assert shown["health"]["resistance_ratio"] is None
    assert shown["health"]["offset_a"] == 0.5
    assert shown["power"]["energy_wh"] is None
    assert shown["power"]["discharge_a"] == 10.0
