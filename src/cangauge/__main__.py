"""The command line: `cangauge`, and `python -m cangauge`."""

from __future__ import annotations

import io
import os
import signal
import sys


def main() -> None:
    """Run the command line; a service ignores SIGHUP, the request to reload, while it loads."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # closed before the start: a bus or a recording would become stdout
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    if isinstance(sys.stdout, io.TextIOWrapper):  # not what a test or a notebook has in its place
        # In a locale without "±" or "°C" the text is legible; otherwise it would be an error.
        sys.stdout.reconfigure(errors="backslashreplace")
    if sys.argv[1:2] == ["run"] and hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    from cangauge.cli.app import main as command_line  # noqa: PLC0415 - takes a second

    command_line()


if __name__ == "__main__":
    main()
