"""PCAP and PCAPNG: frames that tcpdump, Wireshark or dumpcap captured on a SocketCAN interface.

Read here: no maintained library reads both formats within bounds (dpkt trusts every length in the
file and was last released in 2022, python-pcapng reads PCAPNG only, scapy is under the GPL).

Sources: pcap-savefile(5) of libpcap; the PCAPNG specification of the IETF's opsawg
(draft-ietf-opsawg-pcapng); LINKTYPE_CAN_SOCKETCAN, LINKTYPE_LINUX_SLL and LINKTYPE_LINUX_SLL2 of
the registry of link-layer header types of tcpdump.org.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

import can
from can.interfaces.socketcan.constants import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CANFD_BRS,
    CANFD_ESI,
    MSK_ARBID,
)
from can.io.generic import BinaryIOMessageReader

from cangauge.bus.readers import CaptureReader
from cangauge.errors import InputError

_CAN, _SLL, _SLL2 = 227, 113, 276
"""Link types: SocketCAN, and cooked captures of the interface `any`, versions 1 and 2."""
_ARPHRD_CAN: Final = 280
_SLL_CAN, _SLL_CAN_FD = 0x000C, 0x000D
_OUTGOING: Final = 4
_MAX_BLOCK: Final = 1024 * 1024
"""Largest packet or block that is read [bytes]: libpcap keeps 256 kB of a packet."""
_FDF, _XL = 0x04, 0x80
"""Bits that mark a frame of CAN FD in its flags, and one of CAN XL in its fifth byte."""


class _Interface(NamedTuple):
    """An interface of the capture: its link type, and how its stamps count."""

    link: int
    name: str | int
    ticks_per_s: int
    offset_s: int


class PcapReader(CaptureReader, BinaryIOMessageReader):
    """PCAP, classic and PCAPNG, of SocketCAN interfaces."""

    name = "PCAP"
    unit = "packets"

    @classmethod
    def matches(cls, head: bytes) -> bool:
        """Return whether it is a PCAP or PCAPNG file."""
        return head[:4] in _MAGICS or head.startswith(_SECTION_MARK)

    def read(self) -> Iterator[can.Message]:
        """Yield the frames; other packets are counted in a remark."""
        self._order = "<"
        self._place = 0
        other = 0
        magic = self._exactly(4)
        packets = self._blocks() if magic == _SECTION_MARK else self._records(magic)
        for interface, time_s, packet in packets:
            message = self._message(interface, packet)
            if message is None:
                other += 1
                continue
            message.timestamp = time_s
            yield message
        if other and not self.frames:
            raise InputError(
                f"none of its {other} packets is a CAN frame",
                source=self.source,
                cure="capture on the CAN interface, as by tcpdump -i can0 -w drive.pcap",
            )
        if other:
            self.remarks.append(f"{other} packets that are no CAN frames omitted")

    def _exactly(self, size: int) -> bytes:
        data = self.raw.read(size)
        self._place += len(data)
        if len(data) < size:
            raise EOFError(f"it ends in a header or a packet, at byte {self._place}")
        return data

    # --- Classic PCAP

    def _records(self, magic: bytes) -> Iterator[tuple[_Interface, float, bytes]]:
        self._order, ticks_per_s = _MAGICS[magic]
        *_, link = struct.unpack(self._order + "HHiIII", self._exactly(20))
        # The upper bits state the length of a checksum at the end of each packet.
        interface = _Interface(link & 0x03FFFFFF, 0, ticks_per_s, 0)
        header = struct.Struct(self._order + "IIII")
        while start := self.raw.read(1):
            self._place += 1
            seconds, ticks, size, _ = header.unpack(start + self._exactly(header.size - 1))
            if size > _MAX_BLOCK:
                raise ValueError(f"a packet of {size} bytes before byte {self._place}")
            yield interface, seconds + ticks / ticks_per_s, self._exactly(size)

    # --- PCAPNG

    def _blocks(self) -> Iterator[tuple[_Interface, float, bytes]]:
        interfaces: list[_Interface] = []
        unstamped = 0
        kind = _SECTION_MARK
        while True:
            size_bytes = self._exactly(4)
            if kind == _SECTION_MARK:
                mark = self._exactly(4)
                if mark not in _ORDERS:
                    raise ValueError("a section of unknown byte order")
                self._order, interfaces, left = _ORDERS[mark], [], 12
            else:
                left = 8
            size = struct.unpack(self._order + "I", size_bytes)[0]
            if not left + 4 <= size <= _MAX_BLOCK or size % 4:
                raise ValueError(f"a block of {size} bytes before byte {self._place}")
            body = self._exactly(size - left)[:-4]
            number = struct.unpack(self._order + "I", kind)[0]
            if number == 1:
                interfaces.append(_interface(self._order, body, len(interfaces)))
            elif number in {2, 6}:
                yield self._packet(number, body, interfaces)
            elif number == 3:
                unstamped += 1
            start = self.raw.read(1)
            if not start:
                break
            self._place += 1
            kind = start + self._exactly(3)
        if unstamped:
            self.remarks.append(f"{unstamped} packets without time stamp omitted")

    def _packet(
        self, kind: int, body: bytes, interfaces: list[_Interface]
    ) -> tuple[_Interface, float, bytes]:
        layout = "IIIII" if kind == 6 else "HxxIIII"  # 2: the obsolete packet block
        number, high, low, size, _ = struct.unpack_from(self._order + layout, body)
        if number >= len(interfaces):
            raise ValueError(f"a packet of interface {number}, which is not described")
        if size > len(body) - 20:
            raise ValueError(f"a packet of {size} bytes in a block of {len(body)}")
        interface = interfaces[number]
        seconds, ticks = divmod(high << 32 | low, interface.ticks_per_s)
        time_s = seconds + interface.offset_s + ticks / interface.ticks_per_s
        return interface, time_s, body[20 : 20 + size]

    # --- Packets

    def _message(self, interface: _Interface, packet: bytes) -> can.Message | None:
        """Return the frame of a packet; None if it holds none."""
        # In a cooked capture the id has the byte order of the capturing host, which is the file's.
        channel, is_rx, order = interface.name, True, ">"
        if interface.link == _SLL and len(packet) >= 16:
            way, hardware, _, _, protocol = struct.unpack_from(">HHH8sH", packet)
            packet, order = packet[16:], self._order
        elif interface.link == _SLL2 and len(packet) >= 20:
            protocol, channel, hardware, way = struct.unpack_from(">HxxIHB", packet)
            packet, order = packet[20:], self._order
        elif interface.link == _CAN:
            way, hardware, protocol = 0, _ARPHRD_CAN, _SLL_CAN
        else:
            return None
        if hardware != _ARPHRD_CAN or protocol not in {_SLL_CAN, _SLL_CAN_FD}:
            return None
        is_rx = way != _OUTGOING
        if len(packet) < 8 or packet[4] & _XL:
            return None
        number, length, flags = struct.unpack_from(order + "IBB", packet)
        is_fd = protocol == _SLL_CAN_FD or bool(flags & _FDF) or length > 8
        is_remote = bool(number & CAN_RTR_FLAG) and not is_fd
        data = b"" if is_remote else packet[8 : 8 + length]
        if length > (64 if is_fd else 8) or (not is_remote and len(data) < length):
            self.skip(None)
            return None
        return can.Message(
            arbitration_id=number & MSK_ARBID,
            is_extended_id=bool(number & CAN_EFF_FLAG),
            is_remote_frame=is_remote,
            is_error_frame=bool(number & CAN_ERR_FLAG),
            is_fd=is_fd,
            bitrate_switch=is_fd and bool(flags & CANFD_BRS),
            error_state_indicator=is_fd and bool(flags & CANFD_ESI),
            is_rx=is_rx,
            channel=channel,
            dlc=length,
            data=data,
        )


_MAGICS: Final = {
    b"\xd4\xc3\xb2\xa1": ("<", 1_000_000),
    b"\xa1\xb2\xc3\xd4": (">", 1_000_000),
    b"\x4d\x3c\xb2\xa1": ("<", 1_000_000_000),
    b"\xa1\xb2\x3c\x4d": (">", 1_000_000_000),
}
_SECTION_MARK: Final = b"\x0a\x0d\x0d\x0a"
_ORDERS: Final = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}


def _interface(order: str, body: bytes, number: int) -> _Interface:
    """Return an interface by its description block."""
    link = struct.unpack_from(order + "H", body)[0]
    name: str | int = number
    ticks_per_s, offset_s = 1_000_000, 0
    place = 8
    while place + 4 <= len(body):
        code, size = struct.unpack_from(order + "HH", body, place)
        value = body[place + 4 : place + 4 + size]
        place += 4 + (size + 3) // 4 * 4
        if code == 0:
            break
        if code == 2 and value:
            name = value[:64].rstrip(b"\0").decode("utf-8", errors="replace")
        elif code == 9 and value:
            ticks_per_s = 1 << (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
        elif code == 14 and len(value) == 8:
            offset_s = struct.unpack(order + "q", value)[0]
    return _Interface(link, name, ticks_per_s, offset_s)
