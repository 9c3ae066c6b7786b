"""Polling over ISO-TP on a real SocketCAN interface."""

from __future__ import annotations

import pytest

from cangauge.bus.open import BusAddress, has_socketcan
from polled_battery import temperature_and_cells_come

pytestmark = pytest.mark.socketcan


def test_a_service_polls_a_battery_on_vcan0() -> None:
    if not has_socketcan("vcan0"):
        pytest.skip("no SocketCAN interface vcan0 on this machine (see tests/socketcan)")
    temperature_and_cells_come(BusAddress("socketcan", "vcan0"))
