"""How a service is watched and what it records: the part of its configuration for operators.

Keys of the file, and options of `cangauge run` by the same names::

    record = "record/drive.log"     # .log, .csv, .blf, .mf4
    record_part_mb = 64             # a new file after so much …
    record_part_s = 3600            # … or after so long
    record_keep_mb = 2000           # the oldest files are removed beyond this

    status_socket = "auto"          # a path, or "off"
    http = "127.0.0.1:9464"         # /status, /healthz, /metrics
    http_token_file = "http-token"  # required where http is not loopback
    log_format = "json"             # or "text"
    log_level = "info"
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from cangauge.events import LogFormat, LogLevel
from cangauge.service.address import HttpAddress, http_address
from cangauge.service.record import RecordLimits

OPS_PATHS: Final = ("record", "http_token_file")
"""Keys that are paths, relative to the file that they stand in."""

Megabytes = Annotated[FiniteFloat, Field(gt=0.0, le=1e9)]
PartSeconds = Annotated[FiniteFloat, Field(ge=1.0, le=1e9)]


class OpsConfig(BaseModel):
    """The keys for operators.

    Parameters
    ----------
    record : str, optional
        File to record the frames into.
    record_part_mb, record_part_s : float, optional
        A new file is begun after so many megabytes, or seconds.
    record_keep_mb : float, optional
        The oldest files of the recording are removed beyond so many megabytes.
    http : str, optional
        Where to serve HTTP.
    http_token_file : str, optional
        File with the token that requests must bear.
    status_socket : str
        Path of the unix socket for `cangauge status`; "auto", "off".
    log_format : {"text", "json"}
    log_level : {"debug", "info", "warning", "error"}
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    record: str | None = None
    record_part_mb: Megabytes | None = None
    record_part_s: PartSeconds | None = None
    record_keep_mb: Megabytes | None = None
    http: str | None = None
    http_token_file: str | None = None
    status_socket: str = "auto"
    log_format: LogFormat = "text"
    log_level: LogLevel = "info"

    def http_address(self) -> HttpAddress | None:
        """Return where HTTP is served, None if it is not; may raise InputError."""
        return None if self.http is None else http_address(self.http, self.http_token_file)

    def unix_path(self) -> Path | None:
        """Return the path of the unix socket where one is named."""
        return None if self.status_socket in {"auto", "off"} else Path(self.status_socket)

    def record_limits(self) -> RecordLimits:
        """Return when the recording begins a new file, and what it keeps; may raise InputError."""
        return RecordLimits(
            part_bytes=_bytes(self.record_part_mb),
            part_s=self.record_part_s,
            keep_bytes=_bytes(self.record_keep_mb),
        )


def _bytes(megabytes: float | None) -> int | None:
    return None if megabytes is None else int(megabytes * 1e6)
