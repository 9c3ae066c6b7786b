"""CAN FD frames of 64 bytes on a real SocketCAN interface."""

from __future__ import annotations

from pathlib import Path

import pytest

from cangauge.bus.open import BusAddress, has_socketcan
from fd_pack import estimates_from_64_bytes

pytestmark = pytest.mark.socketcan


def test_a_service_on_vcan0_takes_64_bytes(tmp_path: Path) -> None:
    if not has_socketcan("vcan0"):
        pytest.skip("no SocketCAN interface vcan0 on this machine (see tests/socketcan)")
    estimates_from_64_bytes(BusAddress("socketcan", "vcan0", {"fd": True}), tmp_path)
