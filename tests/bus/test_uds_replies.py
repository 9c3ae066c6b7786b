"""Replies to ReadDataByIdentifier are told apart by the whole data identifier."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError

DBC = """BO_ 256 BMS: 8 X
 SG_ I : 0|16@1- (0.1,0) [0|0] "A" X
 SG_ U : 16|16@1+ (0.1,0) [0|0] "V" X

BO_ {} Reply: 4 X
 SG_ T : 24|8@1+ (1,-40) [0|0] "degC" X
"""
MAP = 'dbc = "a.dbc"\ncurrent = "I"\nvoltage = "U"\ntemperature = "T"\n[messages.Reply]\n'


def load(folder: Path, number: int, kind: str) -> Vehicle:
    (folder / "a.dbc").write_text(DBC.format(number))
    (folder / "a.toml").write_text(f"{MAP}{kind} = true\n")
    return Vehicle.load(map=folder / "a.toml")


def test_a_reply_of_another_identifier_is_not_decoded(tmp_path: Path) -> None:
    vehicle = load(tmp_path, 1 << 31 | 0x7EC0101, "uds = true\nrequest_id = 0x7E4\nisotp")
    decoder = SampleDecoder(vehicle)
    for second, low in enumerate([1, 5, 1]):
        data = bytes([4, 0x62, 1, low, 61 + second])
        decoder.handle(can.Message(second, 0x7EC, is_extended_id=False, data=data))
        assert decoder.health["temperature"].latest == [21.0, 21.0, 23.0][second]
    (target,) = vehicle.poll_targets
    assert target.request == b"\x22\x01\x01"


@pytest.mark.parametrize(
    ("number", "kind", "problem"),
    [(1 << 31 | 0x7EC6201, "isotp", r"differ in two further bytes.*uds = true"),
     (0x7BB, "isotp", "needs an extended id"), (0x7EC, "uds", "needs an extended id"),
     (0x7F0, "j1939", "needs an extended id")],
)  # fmt: skip
def test_an_id_that_is_none_of_its_kind_is_refused(
    tmp_path: Path, number: int, kind: str, problem: str
) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        load(tmp_path, number, kind)
    assert caught.value.field == f"messages.Reply.{kind}"


def test_a_reply_that_no_request_has_is_not_asked_for(tmp_path: Path) -> None:
    number = 1 << 31 | 0x7BB2104  # 21 04 is the request
    assert load(tmp_path, number, "isotp").poll_targets == []
    with pytest.raises(InputError, match="begins with 21 answers no request") as caught:
        load(tmp_path, number, "request_id = 0x79B\nisotp")
    assert caught.value.field == "messages.Reply.request_id"
