"""The typer application: registers the commands and turns errors into exit codes.

Exit 0: done; 1: failed; 2: bad usage or input.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_command as made_of

from cangauge import __version__
from cangauge.cli.failure import emit_failure
from cangauge.cli.output import note
from cangauge.cli.usage import UsageError, usage_dict, usage_line
from cangauge.errors import CangaugeError
from cangauge.threads import one_thread

COMMANDS: Final = (
    "demo",
    "fit",
    "estimate",
    "gap",
    "gap-check",
    "run",
    "status",
    "replay",
    "inspect",
    "twin",
)
"""Each is `cangauge.cli.NAME.NAME_command`."""


class LazyGroup(TyperGroup):
    """Imports a command only when it is asked for: the service needs no plots, nor any other."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the commands' names."""
        del ctx
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; None if there is none of that name."""
        del ctx
        if cmd_name not in COMMANDS:
            return None
        name = cmd_name.replace("-", "_")
        alone = typer.Typer(rich_markup_mode="markdown", add_completion=False)
        alone.command(cmd_name)(getattr(import_module(f"cangauge.cli.{name}"), f"{name}_command"))
        return made_of(alone)


app = typer.Typer(
    name="cangauge",
    cls=LazyGroup,
    help="State of charge from CAN frames by an identified voltage model, live and offline."
    " Positive current discharges, everywhere.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    add_completion=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cangauge {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and leave."
    ),
) -> None:
    del version


def main() -> None:
    """Run the command line and exit with its code."""
    one_thread(os.environ)  # no command has been imported yet, nor numpy
    try:
        code = app(standalone_mode=False)
    except CangaugeError as error:
        if not error.told:
            note(f"error: {error}")
        emit_failure(error.to_dict(), error.exit_code)
        sys.exit(error.exit_code)
    except UsageError as error:
        if told := usage_line(error):
            note(told)
        emit_failure(usage_dict(error), 2)
        sys.exit(2)
    except Exception as error:  # a mistake of ours: Python tells where, and exits with 1
        emit_failure(CangaugeError(f"{type(error).__name__}: {error}").to_dict(), 1)
        raise
    if code == 130:  # what typer makes of Ctrl-C
        note("stopped")
    sys.exit(code or 0)
