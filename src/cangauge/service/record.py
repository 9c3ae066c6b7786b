"""Recording what was received, so that `estimate` on the recording gives the live numbers.

Only formats that keep whole microseconds whatever the clock does: candump's text (.log) and
python-can's CSV, either also gzipped. ASC and TRC shift or round stamps, BLF cannot go back.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import can

from cangauge.atomic import check_writable
from cangauge.bus.time_source import whole_us
from cangauge.errors import CangaugeError, InputError

EXACT_FORMATS: Final = (".log", ".csv")


class Recorder:
    """Writes frames to a capture file, stamps in whole microseconds.

    The file grows while recording and is readable at any time; one that stood there is replaced.

    Parameters
    ----------
    path : path-like
        `.log` or `.csv`, or either with `.gz`.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is absent or not writable.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        path = Path(path)
        suffixes = [suffix.lower() for suffix in path.suffixes]
        kind = suffixes[-2:-1] if suffixes[-1:] == [".gz"] else suffixes[-1:]
        if not kind or kind[0] not in EXACT_FORMATS:
            raise InputError(
                "this format does not keep time stamps to the microsecond, or is not known",
                source=path,
                field="--record",
                value="".join(suffixes),
                cure="name a .log (candump) or a .csv file",
            )
        check_writable(path)
        self._path = path
        self._logger = can.Logger(path)
        if isinstance(self._logger, can.CanutilsLogWriter):
            # It would raise stamps below the first one, and so hide a clock that was set back.
            self._logger.last_timestamp = 0.0
        self.frames = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._logger.stop()

    def write(self, message: can.Message) -> None:
        """Write a frame as received; its stamp becomes the one that is written."""
        message.timestamp = whole_us(message.timestamp) / 1e6
        try:
            self._logger.on_message_received(message)
        except OSError as error:
            raise CangaugeError(f"{self._path}: recording failed: {error.strerror}") from error
        self.frames += 1
