"""Options of `cangauge run` for whoever operates the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RecordOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Record the frames received (.log, .csv, .blf, .mf4): `cangauge estimate` on them"
        " gives the live numbers, bit for bit. A kill loses the last half second; of an .mf4 the"
        " whole part. A full disk costs frames of the recording, never the estimate. A recording"
        " that is there stays: the next run's is FILE-0001, FILE-0002, …",
    ),
]
RecordPartMbOption = Annotated[
    float | None,
    typer.Option(
        metavar="MB",
        help="Begin a new file after so much [MB]: NAME-RUN-PART. The name NAME-RUN stands"
        " for all parts.",
    ),
]
RecordPartSOption = Annotated[
    float | None, typer.Option(metavar="S", help="Begin a new file after so long [s].")
]
RecordKeepMbOption = Annotated[
    float | None,
    typer.Option(metavar="MB", help="Remove the oldest files of the recording beyond this [MB]."),
]
HttpOption = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="Serve /status, /healthz and /metrics there (extra `metrics`), e.g. 127.0.0.1:9464."
        " Anything but loopback requires a token.",
    ),
]
HttpTokenFileOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="File with the bearer token that requests must have; or in CANGAUGE_HTTP_TOKEN.",
    ),
]
StatusSocketOption = Annotated[
    str | None,
    typer.Option(
        metavar="PATH|auto|off",
        help="Unix socket for `cangauge status`. Default: auto, in the user's runtime folder.",
    ),
]
LogFormatOption = Annotated[
    str | None,
    typer.Option(metavar="text|json", help="Events on stderr, one a line. Default: text."),
]
LogLevelOption = Annotated[
    str | None, typer.Option(metavar="debug|info|warning|error", help="Default: info.")
]
