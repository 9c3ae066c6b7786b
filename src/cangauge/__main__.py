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
    if sys.argv[1:2] == ["run"] and hasattr(signal, "SIGHUP"):
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
        from cangauge.service.lifecycle import has_terminal  # noqa: PLC0415 - for `run` only

        if has_terminal():  # closing the terminal ends the start as well
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGHUP])
    from cangauge.cli.app import main as command_line  # noqa: PLC0415 - takes a second

    command_line()


if __name__ == "__main__":
    main()
