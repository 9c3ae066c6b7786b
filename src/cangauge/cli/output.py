"""Output of the commands: results on stdout, as JSON or tables; everything else on stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

console = Console(stderr=True, highlight=False)
"""Console for progress and notes: stderr, since stdout is for results."""


def note(text: str) -> None:
    """Print one line on stderr."""
    sys.stderr.write(text.rstrip() + "\n")
    sys.stderr.flush()


def emit_json(result: Mapping[str, Any]) -> None:
    """Print exactly one JSON object on stdout; NaN and infinities become null."""
    plain = _plain(result)
    text = json.dumps(plain, ensure_ascii=False)
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


def print_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table of plain text on stdout; its first column is left-aligned.

    Parameters
    ----------
    title : str
    head : sequence of str
        Headings; a leading "<" (not shown) left-aligns the column.
    rows : sequence of sequences of str
    """
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for number, heading in enumerate(head):
        left = number == 0 or heading.startswith("<")
        table.add_column(Text(heading.removeprefix("<")), justify="left" if left else "right")
    for row in rows:
        # Text: brackets in names are not markup.
        table.add_row(*map(Text, row))
    Console(highlight=False).print(table)
