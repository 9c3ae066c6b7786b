"""Output of the commands: results on stdout, as JSON or tables; everything else on stderr."""

from __future__ import annotations

import json
import logging
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TextIO

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.live import Live
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from cangauge._text import NONE_KNOWN, is_numeric, plain, printable, printable_json
from cangauge.errors import CangaugeError


class PlainConsole(Console):
    """A console on which text cannot control the terminal: rich itself passes escapes on."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Yield the segments of a renderable, their control characters written out."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=printable(segment.text))


console = PlainConsole(stderr=True, highlight=False)
"""Console for progress and notes: stderr, since stdout is for results."""


def note(text: str) -> None:
    """Print lines on stderr; on a terminal they are wrapped between words."""
    if sys.stderr is not None:
        with suppress(OSError):  # a full disk behind it: the exit code reports the failure
            _print(text, sys.stderr)


_REMARKS: ContextVar[list[str]] = ContextVar("remarks")


def hold_remarks() -> None:
    """Hold remarks until the result, or the error, of a command is printed."""
    _REMARKS.set([])


def remark(text: str) -> None:
    """Print lines on stderr, below the result of the command."""
    held = _REMARKS.get(None)
    if held is None:
        note(text)
    else:
        held.append(text)


def print_remarks() -> None:
    """Print the remarks that are held."""
    held = _REMARKS.get(None) or []
    for text in held:
        note(text)
    held.clear()


def say(text: str) -> None:
    """Print lines of the result on stdout; on a terminal they are wrapped between words."""
    _print(text, _stdout())


def _stdout() -> TextIO:
    if sys.stdout is None:
        raise CangaugeError("stdout is closed: the result cannot be printed")
    return sys.stdout


def _print(text: str, file: TextIO) -> None:
    lines = printable(text.rstrip()).splitlines()
    if file.isatty():  # paths and values stay whole, to be copied
        wrap = textwrap.TextWrapper(max(shutil.get_terminal_size().columns, 40), "", "  ")
        wrap.break_long_words = wrap.break_on_hyphens = False
        lines = [wrap.fill(line) for line in lines]
    file.write("\n".join(lines) + "\n")
    file.flush()


@contextmanager
def progress(logger: str = "") -> Iterator[Callable[[str], None]]:
    """Yield a function that shows a line on a terminal, in place of the one before.

    Of what a logger says, decisions (INFO) are printed as lines, and each step is shown there.
    """
    with ExitStack() as stack:
        handler = _Progress()
        if console.is_terminal:
            # No refresh thread: redrawn at each call.
            handler.live = Live(console=console, auto_refresh=False, transient=True)
            stack.enter_context(handler.live)
        if logger:
            own = logging.getLogger(logger)
            stack.callback(own.setLevel, own.level)
            stack.callback(own.removeHandler, handler)
            own.addHandler(handler)
            own.setLevel(logging.DEBUG)
        yield handler.show


class _Progress(logging.Handler):
    live: Live | None = None

    def show(self, text: str) -> None:
        if self.live is not None:
            self.live.update(Text(text), refresh=True)

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.INFO:
            note(record.getMessage())
        else:
            self.show(record.getMessage())


def finish(
    result: Mapping[str, Any],
    show: Callable[[], None],
    files: Mapping[str, Path | None] | None = None,
    *,
    as_json: bool,
) -> None:
    """Print a result as one JSON object, or as text by `show`; then name the files written.

    The object also has the names of the files, by what they hold; None: not asked for.
    """
    named = {what: path and str(path) for what, path in (files or {}).items()}
    if as_json:
        emit_json({**result, **named})
        print_remarks()
        return
    show()
    print_remarks()
    for what, path in named.items():
        if path:
            note(f"{what}: {path}")


def emit_json(result: Mapping[str, Any]) -> None:
    """Print exactly one JSON object on stdout; NaN and infinities become null."""
    stdout = _stdout()
    content = plain(result)
    text = printable_json(json.dumps(content, ensure_ascii=False))
    try:
        text.encode(stdout.encoding or "utf-8")
    except UnicodeEncodeError:  # a terminal without these characters, or an undecodable file name
        text = json.dumps(content)
    stdout.write(text + "\n")
    stdout.flush()


def text_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table of plain text; columns of numbers but the first are set flush right."""
    table = Table(
        title=Text(printable(title)), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD
    )
    columns = list(zip(*rows, strict=True)) or [()] * len(head)
    for number, (heading, column) in enumerate(zip(head, columns, strict=True)):
        is_right = number > 0 and is_numeric(column)
        table.add_column(Text(heading), justify="right" if is_right else "left")
    for row in rows:
        # Text: brackets in names are not markup.
        table.add_row(*(Text(printable(cell)) for cell in row))
    return table


def print_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table of plain text on stdout; arguments as of `text_table`."""
    PlainConsole(file=_stdout(), highlight=False).print(text_table(title, head, rows))


def known_rows(values: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return names and values with their units; what is not known is left out."""
    return [(name, text) for name, text in values.items() if not text.startswith(NONE_KNOWN)]


def print_values(title: str, values: Mapping[str, str]) -> None:
    """Print names and values on stdout; what is not known is left out."""
    print_table(title, ("", ""), known_rows(values))
