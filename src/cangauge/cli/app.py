"""The `cangauge` command: subcommands, error messages and exit codes.

Exit codes: 0 success, 1 failure, 2 bad usage or input, 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command as build_command

from cangauge._files import FULL
from cangauge._version import __version__
from cangauge.cli.output import emit_json, hold_remarks, note, print_remarks
from cangauge.errors import CangaugeError, InputError, closest, in_our_words

FIRST: Final = (
    "demo",
    "init",
    "inspect",
    "fit",
    "estimate",
    "gap",
    "check",
    "run",
    "status",
    "replay",
)
"""Commands of the main job, in its order; the others follow by name."""


THREADS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables of the linear algebra, set to 1 where the user has not set them."""


def _order(command: EntryPoint) -> tuple[int, str]:
    return (*FIRST, command.name).index(command.name), command.name


COMMANDS: Final = {
    command.name: command for command in sorted(entry_points(group="cangauge.commands"), key=_order)
}
"""The installed commands by name."""


def help_line(command: EntryPoint) -> str:
    """Return the first line of a command's docstring, read without importing its module."""
    spec = find_spec(command.module)
    if spec is None or spec.origin is None:
        return ""
    for node in ast.parse(Path(spec.origin).read_bytes()).body:
        if isinstance(node, ast.FunctionDef) and node.name == command.attr:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    return ""


_CONTEXT: Final = {"help_option_names": ["-h", "--help"]}


class LazyGroup(TyperGroup):
    """Import each command on use only: neither the service nor `--help` needs the plots."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the commands' names."""
        del ctx
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a placeholder of a command for lists: its name and help line."""
        del ctx
        return TyperCommand(cmd_name, help=help_line(COMMANDS[cmd_name]))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the arguments name, or suggest the closest name."""
        if args[0] in COMMANDS:
            return args[0], load_command(args[0]), args[1:]
        if args[0].startswith("-"):
            self.parse_args(ctx, args)  # an unknown option
        raise UsageError(f"no such command: {args[0]}{_suggestion(args[0], COMMANDS)}")


def load_command(name: str) -> Any:
    """Import a command and return it as typer runs it."""
    alone = typer.Typer(
        rich_markup_mode="markdown", add_completion=False, context_settings=_CONTEXT
    )
    alone.command(name)(COMMANDS[name].load())
    return build_command(alone)


app = typer.Typer(
    name="cangauge",
    cls=LazyGroup,
    help="State of charge from CAN frames by an identified voltage model, live and offline."
    " Positive current discharges, everywhere.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings=_CONTEXT,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cangauge {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    del version


def main() -> None:
    """Run the command line and exit with its code."""
    # Before numpy is imported: on thousands of small systems threads wait for each other.
    for name in THREADS:
        os.environ.setdefault(name, "1")
    hold_remarks()
    try:
        code = app(standalone_mode=False, prog_name="cangauge")
        print_remarks()
    except CangaugeError as error:
        code = _failed("" if error.logged else str(error), error.to_dict(), error.exit_code)
    except UsageError as error:
        line, field = _usage(error)
        code = _failed(line, {**CangaugeError(line).to_dict(), "field": field}, 2)
    except ModuleNotFoundError as error:  # of a light install (docs/howto/raspberry-pi.md)
        missing = InputError(
            f"needs {error.name}, which is not installed", cure="pip install cangauge"
        )
        code = _failed(str(missing), missing.to_dict(), missing.exit_code)
    except OSError as error:
        if error.errno not in FULL:
            raise
        # Files are written elsewhere: this is stdout, into a file on a full disk.
        _discard_stdout()
        code = _failed(f"stdout: {error.strerror}", {}, 1)
    except Exception as error:
        # Of a library that is loaded: the words of the C library's loader.
        if not (isinstance(error, MemoryError) or "failed to map segment" in str(error)):
            # A bug: Python prints the traceback and exits with 1.
            _failed("", CangaugeError(f"{type(error).__name__}: {error}").to_dict(), 1)
            raise
        line = "the memory limit is reached; raise it (ulimit -v, MemoryMax=)"
        code = _failed(line, CangaugeError(line).to_dict(), 1)
    if code == 130:  # typer's code for Ctrl-C
        note("stopped")
    sys.exit(code or 0)


# typer bundles click without exporting UsageError: take the base class of BadParameter.
UsageError: Final[type[Any]] = typer.BadParameter.__mro__[1]


def _failed(line: str, error: Mapping[str, Any], exit_code: int) -> int:
    """Print an error on stderr, and with `--json` as JSON on stdout; return the exit code."""
    print_remarks()
    if line:
        note(f"error: {line}")
    # Not from the parser: the error may be one of parsing.
    words = [word.partition("=")[0] for word in takewhile("--".__ne__, sys.argv[1:])]
    if sys.stdout is not None and "--json" in words:
        try:
            emit_json({"error": error, "exit_code": exit_code})
        except OSError:  # a closed pipe or a full disk: the exit code stays that of the failure
            _discard_stdout()
    return exit_code


def _discard_stdout() -> None:
    """Discard what is left for stdout: Python flushes it once more at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _usage(error: Any) -> tuple[str, str | None]:
    """Return a usage error in one line, "" if the help page was shown, and its option."""
    field = getattr(error, "option_name", None)
    parameter = getattr(error, "param", None)
    if field is None and parameter is not None:
        # The help page shows an argument by its metavar.
        is_option = parameter.param_type_name == "option"
        field = "/".join(parameter.opts) if is_option else parameter.metavar or parameter.name
    text = in_our_words(" ".join(error.format_message().split()))
    if options := getattr(error, "possibilities", None):
        text = f"no such option: {field}" + _suggestion(str(field), options)
    if not text or type(error).__name__ == "NoArgsIsHelpError":
        return "", field
    if not text[1:2].isupper():
        text = text[0].lower() + text[1:]
    command = "cangauge" if error.ctx is None else error.ctx.command_path
    return f"{text.rstrip('.')}; see `{command} --help`", field


def _suggestion(word: str, names: Iterable[str]) -> str:
    near = closest(word, names)
    return f". Did you mean {near}?" if near else ""
