"""Results for people: rich tables on stdout."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text


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
