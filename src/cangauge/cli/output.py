"""Output of the commands: results on stdout, as JSON or tables; everything else on stderr."""

from __future__ import annotations

import json
import logging
import math
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from cangauge._text import printable, printable_json
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
    """Print one line on stderr; on a terminal it is wrapped between words."""
    if sys.stderr is None:
        return
    text = printable(text.rstrip())
    if sys.stderr.isatty():
        lines = text.splitlines()
        columns = max(shutil.get_terminal_size().columns, 40)
        text = "\n".join(textwrap.fill(line, columns, **_HANGING) for line in lines)
    with suppress(OSError):  # a full disk behind it: the exit code reports the failure
        sys.stderr.write(text + "\n")
        sys.stderr.flush()


_HANGING: Final[dict[str, Any]] = {
    "subsequent_indent": "  ",
    "break_long_words": False,
    "break_on_hyphens": False,
    "replace_whitespace": False,
}
"""Paths and values stay whole, to be copied."""


@contextmanager
def progress_shown(logger: str, show: Callable[[str], None] | None = None) -> Iterator[None]:
    """Show the log records of a long computation: decisions (INFO) as lines, each step by `show`.

    Parameters
    ----------
    logger : str
        Name of the logger, such as "cangauge.identify".
    show : callable, optional
        Takes the text of each step, for a status line.
    """
    own, handler = logging.getLogger(logger), _ProgressHandler(show)
    level = own.level
    own.addHandler(handler)
    own.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        own.removeHandler(handler)
        own.setLevel(level)


class _ProgressHandler(logging.Handler):
    def __init__(self, show: Callable[[str], None] | None) -> None:
        super().__init__()
        self._show = show

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.levelno >= logging.INFO:
            note(text)
        if self._show is not None:
            self._show(text)


def emit_json(result: Mapping[str, Any]) -> None:
    """Print exactly one JSON object on stdout; NaN and infinities become null."""
    if sys.stdout is None:
        raise CangaugeError("stdout is closed: the result cannot be printed")
    plain = _plain(result)
    text = printable_json(json.dumps(plain, ensure_ascii=False))
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:  # a terminal without these characters, or an undecodable file name
        text = json.dumps(plain)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy, without its import
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def text_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table of plain text; its first column is left-aligned.

    Parameters
    ----------
    title : str
    head : sequence of str
        Headings; a leading "<" (not shown) left-aligns the column.
    rows : sequence of sequences of str
    """
    table = Table(
        title=Text(printable(title)), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD
    )
    for number, heading in enumerate(head):
        left = number == 0 or heading.startswith("<")
        table.add_column(Text(heading.removeprefix("<")), justify="left" if left else "right")
    for row in rows:
        # Text: brackets in names are not markup.
        table.add_row(*(Text(printable(cell)) for cell in row))
    return table


def print_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table of plain text on stdout; arguments as of `text_table`."""
    PlainConsole(highlight=False).print(text_table(title, head, rows))
