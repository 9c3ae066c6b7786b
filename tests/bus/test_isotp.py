"""Replies over ISO-TP that others poll become signals; hostile and broken ones do not."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge._resources import shared_file
from cangauge.bus.captures import open_capture
from cangauge.bus.database import load_dbc
from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.isotp import Reassembler
from cangauge.bus.recording import capture_to_log
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.replay.encoder import FrameEncoder


def frames_of(payload: bytes) -> list[bytes]:
    """Return the frames of a sender of ISO 15765-2."""
    if len(payload) < 8:
        return [bytes([len(payload)]) + payload]
    first = bytes([0x10 | len(payload) >> 8, len(payload) & 0xFF]) + payload[:6]
    rest = [payload[at : at + 7] for at in range(6, len(payload), 7)]
    return [first, *(bytes([0x20 | n & 15]) + part for n, part in enumerate(rest, 1))]


@given(st.binary(min_size=1, max_size=600))
def test_any_reply_is_put_together(payload: bytes) -> None:
    reassembler = Reassembler()
    found = [reassembler.take(frame, 0.01 * n) for n, frame in enumerate(frames_of(payload))]
    assert found[-1] == payload
    assert found[:-1] == [None] * (len(found) - 1)


@given(st.lists(st.tuples(st.binary(max_size=8), st.floats(-1e3, 1e3)), max_size=40))
def test_any_frames_are_survived(frames: list[tuple[bytes, float]]) -> None:
    reassembler = Reassembler()
    for data, time_s in frames:
        reply = reassembler.take(data, time_s)
        assert reply is None or len(reply) <= 4095


@pytest.mark.parametrize(
    "fault", ["missing", "swapped", "late", "doubled", "interrupted", "restarted"]
)
def test_a_broken_reply_is_given_up(fault: str) -> None:
    frames = [(data, 0.01 * n) for n, data in enumerate(frames_of(bytes(range(40))))]
    if fault == "missing":
        del frames[2]
    elif fault == "swapped":
        frames[2], frames[3] = frames[3], frames[2]
    elif fault == "late":
        frames = [*frames[:3], *((data, time_s + 5.0) for data, time_s in frames[3:])]
    elif fault == "doubled":
        frames.insert(3, frames[2])
    elif fault == "interrupted":
        frames.insert(3, (b"\x01\x61", 0.025))  # another reply, in a single frame
    else:
        frames = frames[:3] + frames
    reassembler = Reassembler()
    found = [reassembler.take(*frame) for frame in frames]
    assert found[-1] == (bytes(range(40)) if fault == "restarted" else None)


def test_a_reply_gives_the_temperature_of_samples() -> None:
    decoder = SampleDecoder(Vehicle.load("leaf_ze1_polled"))
    reply = bytes.fromhex("6104020114 01ff14 020c13 020e13 13 3f ffffffffff".replace(" ", ""))
    for n, data in enumerate(frames_of(reply)):
        message = can.Message(
            timestamp=1.0 + 0.01 * n, arbitration_id=0x7BB, is_extended_id=False, data=data
        )
        assert decoder.handle(message) is None
    assert decoder.health["temperature"].value_at(1.1) == 20.0
    assert {each["can_id"] for each in decoder.vehicle.filters} == {0x1DB, 0x55B, 0x7BB}


def test_replies_cannot_be_sent() -> None:
    with pytest.raises(InputError, match="ISO-TP"):
        FrameEncoder(Vehicle.load("leaf_ze1_polled"))


@pytest.mark.real
def test_polled_replies_of_a_40_kwh_leaf(shared_data: Path) -> None:
    path = shared_data / "leaf_can" / "EV-CANeplus2.log.gz"
    log = capture_to_log(path, Vehicle.load("leaf_ze1_polled"))
    assert set(np.unique(log.temperature_c)) <= {18.0, 19.0, 20.0}
    assert log.temperature_source == "pack"
    leaf = load_dbc(shared_file("dbc", "nissan_leaf.dbc"))
    reassembler, volts, cells, packs = Reassembler(), [], [], []
    for message in open_capture(path):
        if message.arbitration_id != 0x7BB:
            continue
        reply = reassembler.take(message.data, message.timestamp)
        if reply is None or reply[1] not in {1, 2, 4}:
            continue
        owner = leaf.get_message_by_frame_id(0x7BB << 16 | reply[0] << 8 | reply[1])
        values = owner.decode(reply[: owner.length], scaling=True)
        if reply[1] == 1:
            volts.append(values["reply_voltage_v"])
        elif reply[1] == 2:
            cells.append([values[f"CELL_{cell:02d}"] for cell in range(1, 97)])
            packs.append(values["reply_pack_v"])
        else:
            probes = [values[f"probe_{n}_c"] for n in range(1, 5)]
            assert 18 <= min(probes) <= max(probes) <= 20
    assert volts == pytest.approx([371.78, 368.63, 393.13, 393.85, 390.58])
    assert np.sum(cells, axis=1) == pytest.approx(packs, abs=0.05)
    assert np.shape(cells) == (4, 96)
    assert 3.7 < np.min(cells) < np.max(cells) < 4.2
