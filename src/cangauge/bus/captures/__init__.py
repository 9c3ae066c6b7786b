"""Captures: recorded frames of many tools, read as a stream of messages with stamps in seconds."""

from cangauge.bus.captures.capture import Capture, is_capture, open_capture, read_capture
from cangauge.bus.captures.files import CaptureInfo, Stamps

__all__ = ["Capture", "CaptureInfo", "Stamps", "is_capture", "open_capture", "read_capture"]
