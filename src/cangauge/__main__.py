"""The command line: `cangauge`, and `python -m cangauge`."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; a service holds SIGHUP before its imports, which take a second."""
    if sys.argv[1:2] == ["run"]:
        from cangauge.service.lifecycle import hold_hangups  # noqa: PLC0415 - as above

        hold_hangups()
    from cangauge.cli.app import main as command_line  # noqa: PLC0415 - as above

    command_line()


if __name__ == "__main__":
    main()
