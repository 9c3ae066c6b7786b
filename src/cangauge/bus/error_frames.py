"""What SocketCAN's error frames tell (linux/can/error.h).

The classes are bits of the id, of which python-can hands on the lower eleven: all that name a
kind. What ails the controller stands in byte 1, and one frame may tell several kinds.
"""

from __future__ import annotations

from typing import Final

import can

BUS_OFF: Final = "bus_off"
RESTARTED: Final = "restarted"
UNSPECIFIED: Final = "unspecified"

_CONTROLLER: Final = 0x004
_CLASSES: Final = {
    0x001: "transmit_timeout",
    0x002: "arbitration_lost",
    0x008: "protocol",
    0x010: "transceiver",
    0x020: "no_acknowledge",
    0x040: BUS_OFF,
    0x080: "bus_error",
    0x100: RESTARTED,
}
_CONTROLLER_STATES: Final = {
    0x01: "controller_receive_overflow",
    0x02: "controller_transmit_overflow",
    0x04: "receive_warning",
    0x08: "transmit_warning",
    0x10: "receive_passive",
    0x20: "transmit_passive",
    0x40: "error_active",
}


def error_kinds(message: can.Message) -> list[str]:
    """Return what one error frame of SocketCAN tells; `UNSPECIFIED` where it names no kind."""
    classes = message.arbitration_id
    kinds = [name for bit, name in _CLASSES.items() if classes & bit]
    if classes & _CONTROLLER:
        state = message.data[1] if len(message.data) > 1 else 0
        states = [name for bit, name in _CONTROLLER_STATES.items() if state & bit]
        kinds += states or ["controller"]
    return kinds or [UNSPECIFIED]
