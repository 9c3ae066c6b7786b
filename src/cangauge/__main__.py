"""The command line: `cangauge`, and `python -m cangauge`."""

from __future__ import annotations

import io
import os
import sys


def main() -> None:
    """Run the command line; a service holds SIGHUP before its imports, which take a second."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # closed before the start: a bus or a recording would become stdout
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    if isinstance(sys.stdout, io.TextIOWrapper):  # not what a test or a notebook has in its place
        # In a locale without "±" or "°C" the text is legible; otherwise it would be an error.
        sys.stdout.reconfigure(errors="backslashreplace")
    if sys.argv[1:2] == ["run"]:
        from cangauge.service.lifecycle import hold_hangups  # noqa: PLC0415 - as above

        hold_hangups()
    from cangauge.cli.app import main as command_line  # noqa: PLC0415 - as above

    command_line()


if __name__ == "__main__":
    main()
