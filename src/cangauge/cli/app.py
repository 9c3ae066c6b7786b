"""The typer application: registers the commands and turns errors into exit codes.

Exit 0: done; 1: failed; 2: bad usage or input.
"""

from __future__ import annotations

import sys

import typer

from cangauge import __version__
from cangauge.cli.demo import demo_command
from cangauge.cli.estimate import estimate_command
from cangauge.cli.fit import fit_command
from cangauge.cli.gap import gap_command
from cangauge.cli.gap_check import gap_check_command
from cangauge.cli.inspect import inspect_command
from cangauge.cli.output import note
from cangauge.cli.replay import replay_command
from cangauge.cli.run import run_command
from cangauge.cli.status import status_command
from cangauge.cli.twin import twin_command
from cangauge.cli.usage import UsageError, usage_line
from cangauge.errors import CangaugeError

app = typer.Typer(
    name="cangauge",
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


app.command("demo")(demo_command)
app.command("fit")(fit_command)
app.command("estimate")(estimate_command)
app.command("gap")(gap_command)
app.command("gap-check")(gap_check_command)
app.command("run")(run_command)
app.command("status")(status_command)
app.command("replay")(replay_command)
app.command("inspect")(inspect_command)
app.command("twin")(twin_command)


def main() -> None:
    """Run the command line and exit with its code."""
    try:
        code = app(standalone_mode=False)
    except CangaugeError as error:
        note(f"error: {error}")
        sys.exit(error.exit_code)
    except UsageError as error:
        if told := usage_line(error):
            note(told)
        sys.exit(2)
    if code == 130:  # what typer makes of Ctrl-C
        note("stopped")
    sys.exit(code or 0)
