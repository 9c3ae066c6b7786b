"""How commands speak: results on stdout, everything else on stderr.

Results for people: rich tables on stdout.
"""

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

# --- How commands speak: results on stdout, everything else on stderr

console = Console(stderr=True, highlight=False)
"""For tables, progress and notes: stderr, so that `--json` alone owns stdout."""


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
    except UnicodeEncodeError:  # a terminal of few letters, a file name that is no text
        text = json.dumps(plain)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy's, which is not worth importing for --help
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# --- Results for people: rich tables on stdout


def print_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on stdout; its first column is set flush left, cells are plain text.

    Parameters
    ----------
    title : str
    head : sequence of str
        Headings; one that begins with "<" is set flush left, without that sign.
    rows : sequence of sequences of str
    """
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    for number, heading in enumerate(head):
        left = number == 0 or heading.startswith("<")
        table.add_column(Text(heading.removeprefix("<")), justify="left" if left else "right")
    for row in rows:
        # Text: a name with brackets is no markup.
        table.add_row(*map(Text, row))
    Console(highlight=False).print(table)
