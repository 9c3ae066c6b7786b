"""Kinds of SocketCAN error frames (linux/can/error.h)."""

from __future__ import annotations

import can
import pytest

from cangauge.bus.connection import error_kinds


@pytest.mark.parametrize(
    ("classes", "data", "kinds"),
    [
        (0x000, b"", ["unspecified"]),
        (0x200, b"\0" * 8, ["unspecified"]),  # counters alone
        (0x001, b"\0" * 8, ["transmit_timeout"]),
        (0x008 | 0x080, b"\0" * 8, ["protocol", "bus_error"]),
        (0x020, b"\0" * 8, ["no_acknowledge"]),
        (0x040, b"\0" * 8, ["bus_off"]),
        (0x100, b"\0" * 8, ["restarted"]),
        (0x004, b"\x00\x01", ["controller_receive_overflow"]),
        (0x004, b"\x00\x30", ["receive_passive", "transmit_passive"]),
        (0x004, b"\x00\x40", ["error_active"]),
        (0x004, b"\x00\x00", ["controller"]),
        (0x004, b"", ["controller"]),
        (0x044, b"\x00\x20", ["bus_off", "transmit_passive"]),
    ],
)
def test_classes_and_states_have_their_kinds(classes: int, data: bytes, kinds: list[str]) -> None:
    message = can.Message(
        arbitration_id=classes, is_extended_id=False, is_error_frame=True, data=data
    )
    assert error_kinds(message) == kinds
