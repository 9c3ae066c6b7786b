"""Captures: recorded frames of many tools, read as a stream of messages with stamps in seconds."""

from cangauge.bus.captures.capture import Capture, is_capture, open_capture, read_capture
from cangauge.bus.captures.files import CaptureInfo, Stamps
from cangauge.bus.captures.reader import BinaryReader, CaptureReader, LineReader

__all__ = [
    "BinaryReader",
    "Capture",
    "CaptureInfo",
    "CaptureReader",
    "LineReader",
    "Stamps",
    "is_capture",
    "open_capture",
    "read_capture",
]
