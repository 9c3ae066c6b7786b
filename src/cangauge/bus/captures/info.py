"""What a capture file is and what reading it noticed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Stamps = Literal["us", "ms", "none"]
"""Resolution of time stamps: microseconds or finer, whole milliseconds, or no stamps at all."""


@dataclass(frozen=True, slots=True)
class CaptureInfo:
    """What reading a capture showed, so far.

    Parameters
    ----------
    format : str
        Name of the format.
    stamps : {"us", "ms", "none"}
    frames : int
        Frames read, error and remote frames included.
    malformed : int
        Lines or frames that were skipped because they make no sense.
    first_malformed : int or None
        Number of the first such line, from 1.
    cut_off : bool
        Whether the file ends in the middle of something.
    remarks : tuple of str
        What a user should know, in words.
    """

    format: str
    stamps: Stamps
    frames: int = 0
    malformed: int = 0
    first_malformed: int | None = None
    cut_off: bool = False
    remarks: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "format": self.format,
            "stamps": self.stamps,
            "frames": self.frames,
            "malformed": self.malformed,
            "first_malformed": self.first_malformed,
            "cut_off": self.cut_off,
            "remarks": list(self.remarks),
        }
