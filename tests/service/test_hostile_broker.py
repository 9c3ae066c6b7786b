"""A broker that sends what nobody asked for is left before it fills the memory."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress

import pytest
from watched import Watched

from cangauge.service.config import MqttConfig
from live import PATIENCE_S, waits
from served import Served

SENT_AT_MOST = 512 << 20
"""What the broker would like to send [bytes]."""
BUFFERS = 64 << 20
"""What the buffers of two sockets may hold [bytes]: Linux lets each grow to some 30 MiB."""
LONGEST = (1 << 28) - 1
"""Bytes of the longest message of MQTT."""
PART = bytes(1 << 16)


class HostileBroker:
    """Confirms a connection, then sends parts without end; `taken` are the bytes that were taken.

    Parameters
    ----------
    begin : bytes
        Before the parts.
    head : bytes
        Before each part.
    """

    def __init__(self, begin: bytes, head: bytes) -> None:
        self._begin, self._head = begin, head
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self.taken: int | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        client, _ = self._socket.accept()
        client.settimeout(PATIENCE_S)
        taken = 0
        with client, suppress(OSError):
            client.recv(4096)
            client.sendall(bytes([0x20, 2, 0, 0]) + self._begin)
            while taken < SENT_AT_MOST:
                client.sendall(self._head + PART)
                taken += len(PART)
        self.taken = taken

    def close(self) -> None:
        self._socket.close()
        self._thread.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("begin", "head", "message"),
    [
        (bytes([0x30, 0xFF, 0xFF, 0xFF, 0x7F, 0, 1, 0x61]), b"", LONGEST),
        # QoS 2: kept until its release.
        (b"", bytes([0x34, 0x85, 0x80, 0x04, 0, 1, 0x61, 0, 1]), len(PART)),
    ],
    ids=["a long message", "many messages"],
)
def test_a_broker_that_floods_is_left(begin: bytes, head: bytes, message: int) -> None:
    broker = HostileBroker(begin, head)
    config = MqttConfig(broker="127.0.0.1", port=broker.port, device="bench", every_s=0.2)
    with Served(Watched().monitor.latest, mqtt=config) as served:
        assert waits(lambda: broker.taken is not None)
        assert broker.taken < message + BUFFERS
        assert waits(lambda: served.said("it sent a message without a subscription"))
        assert served.process.poll() is None
    broker.close()
