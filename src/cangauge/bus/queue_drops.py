"""Frames that the kernel dropped because the receive queue of a bus's socket was full.

python-can asks for no such count. SO_RXQ_OVFL tells it beside the next frame that is received, so
only to whoever owns the receive call, and never if no more frames come. The same counter of the
socket can be read at any time by SO_MEMINFO (Linux 4.12 and later), on any socket: that is what is
done here, beside python-can and without touching how it receives.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
from typing import Final

import can

_SO_MEMINFO: Final = 55
_MEMINFO: Final = struct.Struct("=9I")
_DROPS: Final = 8
"""Place of SK_MEMINFO_DROPS among the numbers."""


def queue_drops(bus: can.BusABC) -> int | None:
    """Return the frames dropped since the bus was opened (modulo 2³²).

    None where nobody counts: other systems than Linux, and buses that are no sockets.
    """
    if sys.platform != "linux":
        return None
    try:
        # The driver keeps its socket to itself; a duplicate of the descriptor is the same socket.
        descriptor = os.dup(bus.fileno())
    except (OSError, NotImplementedError, ValueError):
        return None
    try:
        own = socket.socket(fileno=descriptor)
    except OSError:  # no socket: a device, an event of a driver
        os.close(descriptor)
        return None
    with own:
        try:
            answer = own.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        except OSError:
            return None
    if len(answer) < _MEMINFO.size:
        return None
    return int(_MEMINFO.unpack(answer)[_DROPS])
