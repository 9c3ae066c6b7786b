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
from cangauge.bus.recording import capture_samples, capture_to_log
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.model.published import leaf_2012_model_file
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.offline import estimate_capture
from live import succeeds


def frames_of(payload: bytes) -> list[bytes]:
    """Return the frames of a sender of ISO 15765-2."""
    if len(payload) < 8:
        return [bytes([len(payload)]) + payload]
    first = bytes([0x10 | len(payload) >> 8, len(payload) & 0xFF]) + payload[:6]
    rest = [payload[at : at + 7] for at in range(6, len(payload), 7)]
    return [first, *(bytes([0x20 | n & 15]) + part for n, part in enumerate(rest, 1))]


def extended(payload: bytes, address: int) -> list[bytes]:
    """Return the frames of a sender with extended addressing: a byte less each."""
    if len(payload) < 7:
        return [bytes([address, len(payload)]) + payload]
    first = bytes([address, 0x10 | len(payload) >> 8, len(payload) & 0xFF]) + payload[:5]
    rest = [payload[at : at + 6] for at in range(5, len(payload), 6)]
    return [first, *(bytes([address, 0x20 | n & 15]) + part for n, part in enumerate(rest, 1))]


@given(st.binary(min_size=1, max_size=600), st.integers(0x40, 0xFF) | st.none())
def test_any_reply_is_put_together(payload: bytes, address: int | None) -> None:
    reassembler = Reassembler()
    frames = frames_of(payload) if address is None else extended(payload, address)
    found = [reassembler.take(frame, 0.01 * n) for n, frame in enumerate(frames)]
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


BMW = """VERSION ""
NS_ :
BS_:
BU_: SME
BO_ 274 PACK: 8 SME
 SG_ U : 0|16@1+ (0.1,0) [0|0] "V" SME
 SG_ I : 16|16@1- (0.1,0) [0|0] "A" SME
BO_ {key} SOC_REPLY: 9 SME
 SG_ soc : 31|16@0+ (0.1,0) [0|0] "%" SME
BO_ 1085 OTHER: 8 SME
 SG_ temp : 0|8@1+ (1,-40) [0|0] "degC" SME
"""
UDS_KEY = 1 << 31 | 0x607DDBC
"""Of a reply 62 DD BC on 0x607, as BMW's battery sends it to the tester 0xF1."""


@pytest.mark.parametrize(
    ("identifier", "remark"),
    [(0xDDBC, ""), (0xDDBD, "soc: SOC_REPLY was never seen in 120 frames of 0x607")],
)
def test_a_reply_with_extended_addressing_gives_the_soc_or_is_said_to_be_absent(
    tmp_path: Path, identifier: int, remark: str
) -> None:
    (tmp_path / "a.dbc").write_text(BMW.format(key=UDS_KEY))
    (tmp_path / "a.toml").write_text(
        'dbc = "a.dbc"\ncurrent = "I"\nvoltage = "U"\nsoc = "soc"\n'
        'temperature = { signal = "temp", message = "OTHER" }\n[messages.SOC_REPLY]\nuds = true\n'
    )
    reply = b"\x62" + identifier.to_bytes(2, "big") + (786).to_bytes(2, "big") + bytes(4)
    with can.CanutilsLogWriter(tmp_path / "a.log") as log:
        for row in range(600):
            amps = 100 if row % 20 < 10 else 300
            pack = (3700 - amps // 10).to_bytes(2, "little") + amps.to_bytes(2, "little")
            frames = [(274, pack + bytes(4))]
            frames += [(0x607, each) for each in extended(reply, 0xF1) if row % 10 == 0]
            for number, data in frames:
                log(can.Message(0.1 * row, number, data=data, is_extended_id=False, channel="can0"))
    given = (tmp_path / "a.log", "--map", tmp_path / "a.toml", "--temperature", "20")
    found = succeeds("inspect", *given, "--json").json["log"]
    said = [each for each in found["remarks"] if each.startswith("soc: ")]
    assert said == ([remark] if remark else [])
    if not remark:
        assert found["soc"]["first_pct"] == pytest.approx(78.6)
    car = Vehicle.load(map=tmp_path / "a.toml")
    samples = capture_samples(tmp_path / "a.log", car)
    missing = "temperature: OTHER was never seen: no frames of 0x43D"
    assert missing in samples.remarks
    estimated = estimate_capture(tmp_path / "a.log", car, leaf_2012_model_file())
    said = [each for each in estimated.recorded.remarks if "never" in each]
    assert said == [missing, *([remark] if remark else [])]
