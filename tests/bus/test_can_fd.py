"""CAN FD frames of 64 bytes give samples, estimates and recordings."""

from __future__ import annotations

import os
from pathlib import Path

from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.open import bus_address
from fd_pack import estimates_from_64_bytes, fd_frame, fd_vehicle


def test_signals_beyond_byte_8_decode(tmp_path: Path) -> None:
    sample = SampleDecoder(fd_vehicle(tmp_path)).handle(fd_frame(-12.35, 401.23))
    assert sample is not None
    assert abs(sample.current_a + 12.35) < 1e-9
    assert abs(sample.voltage_v - 401.23) < 1e-9


def test_a_service_on_udp_takes_64_bytes(tmp_path: Path) -> None:
    port = 20_000 + (os.getpid() + 77) % 20_000
    address = bus_address("udp_multicast", options={"port": port, "fd": True})
    estimates_from_64_bytes(address, tmp_path)
