"""What python-can's interfaces do differently, as far as the service must know it."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Final, Literal

from cangauge.bus.open import BusAddress

Stamps = Literal["kernel", "sender", "driver"]

_LINUX: Final = sys.platform == "linux"


@dataclass(frozen=True)
class InterfaceFacts:
    """What an interface does.

    Parameters
    ----------
    stamps : {"kernel", "sender", "driver"}
        Who stamps a received frame. "kernel": when it came in, however late it is read
        (SO_TIMESTAMPNS). "sender": when it was sent (within one process). "driver": whatever
        python-can's driver for it gives, the adapter's own clock or the moment of reading.
    echoes : bool
        Whether one's own frames come back.
    has_error_classes : bool
        Whether error frames tell their kinds as SocketCAN's do.
    """

    stamps: Stamps
    echoes: bool
    has_error_classes: bool


UNKNOWN_INTERFACE: Final = InterfaceFacts("driver", echoes=False, has_error_classes=False)


def interface_facts(address: BusAddress) -> InterfaceFacts:
    """Return what the interface of an address does."""
    asked = bool(address.options.get("receive_own_messages", False))
    if address.interface == "socketcan":
        return InterfaceFacts("kernel", echoes=asked, has_error_classes=True)
    if address.interface == "udp_multicast":
        # Elsewhere python-can stamps when it reads.
        stamps: Stamps = "kernel" if _LINUX else "driver"
        return InterfaceFacts(stamps, echoes=True, has_error_classes=False)
    stamps = "sender" if address.interface == "virtual" else "driver"
    return InterfaceFacts(stamps, echoes=asked, has_error_classes=False)
