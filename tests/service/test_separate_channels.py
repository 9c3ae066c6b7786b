"""UDP channels are separate buses: each group's frames stay in it."""

from __future__ import annotations

import can
import pytest

from cangauge.bus.open import bus_address, open_bus
from cangauge.errors import InputError


@pytest.mark.parametrize("groups", [("239.74.163.51", "239.74.163.52"), ("ff15::51", "ff15::52")])
def test_a_channel_receives_no_frames_of_another(groups: tuple[str, str]) -> None:
    try:
        first, second = (open_bus(bus_address("udp_multicast", each)) for each in groups)
    except InputError:
        pytest.skip("no IPv6 on this machine")
    with first, second:
        second.send(can.Message(arbitration_id=0x42, is_extended_id=False, data=b"hi"))
        own = second.recv(2.0)  # a sender receives its own frames
        assert own is not None
        assert own.arbitration_id == 0x42
        assert first.recv(0.2) is None
