"""The command line: `cangauge`, and `python -m cangauge`."""

from __future__ import annotations

import io
import os
import signal
import sys


def main() -> None:
    """Run the command line; SIGHUP, the request to reload, waits until a service has loaded."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # closed before the start: a bus or a recording would become stdout
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    if isinstance(sys.stdout, io.TextIOWrapper):  # not what a test or a notebook has in its place
        # In a locale without "±" or "°C" the text is legible; otherwise it would be an error.
        sys.stdout.reconfigure(errors="backslashreplace")
    is_at_terminal = any(map(os.isatty, range(3)))  # closing it ends the start as well
    if sys.argv[1:2] == ["run"] and hasattr(signal, "SIGHUP") and not is_at_terminal:
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
    from cangauge.cli.app import main as command_line  # noqa: PLC0415 - takes a second

    command_line()


if __name__ == "__main__":
    main()
