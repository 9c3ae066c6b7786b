"""What `--json` prints of a command that failed: one object too, so that it can be parsed.

Wrong usage (an option that there is not, an argument that misses): in one line, for `--json`.

The typer application: registers the commands and turns errors into exit codes.

Exit 0: done; 1: failed; 2: bad usage or input.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_command as made_of

from cangauge import __version__
from cangauge._resources import one_thread
from cangauge.cli.output import emit_json, note
from cangauge.errors import CangaugeError

# --- What `--json` prints of a command that failed: one object too, so that it can be parsed


def emit_failure(error: Mapping[str, Any], exit_code: int) -> None:
    """Print `{"error": {…}, "exit_code": …}` on stdout if the command line asks for `--json`.

    Parameters
    ----------
    error : mapping
        As of `CangaugeError.to_dict`.
    exit_code : int
        What the process will exit with.
    """
    if not _json_asked(sys.argv[1:]) or sys.stdout is None:
        return
    try:
        emit_json({"error": error, "exit_code": exit_code})
    except OSError:
        # Nobody reads stdout, or its disk is full. The exit code stays that of the failure, also
        # when Python flushes stdout once more at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _json_asked(arguments: Sequence[str]) -> bool:
    """Whether `--json` is among them: what is wrong may be the very line that says so."""
    options = arguments[: arguments.index("--")] if "--" in arguments else arguments
    return any(word.partition("=")[0] == "--json" for word in options)


# --- Wrong usage (an option that there is not, an argument that misses): in one line, for `-…

# typer brings its own copy of click: the base of its errors is reached through the one it exports.
UsageError: Final[type[Exception]] = typer.BadParameter.__mro__[1]


def usage_line(error: Any) -> str:
    """Return what is wrong with the command line and which help tells more; "" if help was shown.

    Parameters
    ----------
    error : UsageError
    """
    text = " ".join(error.format_message().split()).replace("Input should be", "must be")
    if not text or type(error).__name__ == "NoArgsIsHelpError":
        return ""
    if not text[1:2].isupper():
        text = text[0].lower() + text[1:]
    command = "cangauge"
    if error.ctx is not None and error.ctx.parent is not None:
        command = f"cangauge {error.ctx.info_name}"
    return f"error: {text.rstrip('.')}; see `{command} --help`"


def usage_dict(error: Any) -> dict[str, Any]:
    """Return what `CangaugeError.to_dict` does; the option or argument is the field.

    Parameters
    ----------
    error : UsageError
    """
    field = getattr(error, "option_name", None)
    parameter = getattr(error, "param", None)
    if field is None and parameter is not None:
        # An argument has no spelling of its own: help shows it by its metavar.
        is_option = parameter.param_type_name == "option"
        field = "/".join(parameter.opts) if is_option else parameter.metavar or parameter.name
    return {**CangaugeError(usage_line(error).removeprefix("error: ")).to_dict(), "field": field}


# --- The typer application: registers the commands and turns errors into exit codes

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
        if not error.logged:
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
