"""`cangauge monitor`: watch a running service in the terminal, also over SSH."""

from __future__ import annotations

import os
import sys
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Final

import typer

from cangauge._text import number, printable
from cangauge.cli.options import EndpointOption, TokenFileOption
from cangauge.cli.output import print_table
from cangauge.cli.status import USABLE, status_rows
from cangauge.errors import CangaugeError, InputError

if TYPE_CHECKING:
    from cangauge.service.status_feed import StatusFeed, View

LINE_EVERY_S: Final = 1.0
"""Interval of the lines where stdout is no terminal [s]."""


def monitor_command(
    endpoint: EndpointOption = None,
    token_file: TokenFileOption = None,
    once: Annotated[
        bool, typer.Option("--once", help="Print one snapshot as text, and exit.")
    ] = False,
) -> None:
    """Watch a running service in the terminal: values, charts, status with its reasons.

    It may be started before the service, waits for it, and connects again. Where stdout is no
    terminal it prints a line a second. Keys: p pause, r range of the charts, ? help, q quit.
    Needs the extra `monitor`, except for `--once` and for lines.

    Exit code 0; 2: bad usage. With `--once` as for `cangauge status`: 1 if the SoC is invalid or
    unknown, or no service runs.

    Examples
    --------
    `cangauge monitor`

    `cangauge monitor --endpoint http://192.168.1.7:9464 --token-file token`

    `cangauge monitor --once`
    """
    from cangauge.service.status_feed import StatusFeed

    feed = StatusFeed(endpoint, token_file)
    if once:
        feed.poll()
        _print_once(feed.view())
        return
    try:
        feed.poll()
    except InputError:
        raise  # waiting does not mend it
    except CangaugeError:
        feed.try_poll()
    if not sys.stdout.isatty():
        with feed:
            _print_lines(feed)
        return
    # textual is an extra, and slow to import.
    from cangauge.cli.monitor_screen import MonitorScreen

    with feed:
        MonitorScreen(feed).run()


def _print_once(view: View) -> None:
    from cangauge.service.status_client import NotRunningError

    status = view.status
    if status is None:
        raise NotRunningError(view.problem)
    print_table(f"cangauge at {view.place}", ("", "<"), status_rows(status))
    if status["status"] not in USABLE:
        raise typer.Exit(1)


def _print_lines(feed: StatusFeed) -> None:
    """Print a line a second until stopped or the reader of stdout goes."""
    try:
        while True:
            stamp = datetime.now(UTC).isoformat(timespec="seconds")
            sys.stdout.write(printable(f"{stamp} {status_line(feed.view())}") + "\n")
            sys.stdout.flush()
            time.sleep(LINE_EVERY_S)
    except BrokenPipeError:
        # `cangauge monitor | head`: Python flushes stdout once more at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def status_line(view: View) -> str:
    """Return a view in one line."""
    from cangauge.service.status_feed import alarm

    trouble = alarm(view)
    status = view.status
    if status is None or not view.is_answered:
        return trouble
    estimate, sample = status["estimate"], status["sample"] or {}
    parts = [
        f"SoC {number(estimate['soc_pct'], 2)} ± {number(estimate['soc_std_pct'], 2, '%')}",
        status["status"],
        number(sample.get("current_a"), 1, "A"),
        number(sample.get("voltage_v"), 1, "V"),
        number(sample.get("temperature_c"), 1, "°C"),
        f"{number(view.frames_per_s, 0)} frames/s",
        *(each.replace("_", " ") for each in status["reasons"]),
        *filter(None, [trouble]),
    ]
    return ", ".join(parts)
