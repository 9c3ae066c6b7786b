"""Channels with times of their own as a log: a row for each value of the current."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

from cangauge._dataframes import arrow_table
from cangauge._files import Head
from cangauge._typing import FloatArray
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import UnknownColumnsError, choose_columns
from cangauge.logs.draft import DraftLog
from cangauge.logs.table import ArrowTable, draft_of_table

DRIVING = ("current", "voltage")
"""Quantities whose values are not held for long."""


class Channels(ABC):
    """Channels of a file, chosen by their headings as the columns of a table.

    `time` is the heading of their times, `remarks` are for the user.
    """

    time: str
    remarks: list[str]

    @property
    @abstractmethod
    def headings(self) -> Sequence[str]:
        """The names of the channels."""

    @abstractmethod
    def rows_of(self, current: list[str], voltage: list[str]) -> FloatArray:
        """Return the times of the log's rows [s], by the channels of current and voltage."""

    @abstractmethod
    def at(self, name: str, rows_s: FloatArray, quantity: str) -> FloatArray:
        """Return a channel at the rows; its quantity is "" where the log has none of it."""

    def draft(self, head: Head, given: ColumnMap | None) -> DraftLog:
        """Return the draft of the channels that the user names, or of those with plain headings.

        Raises
        ------
        InputError
            If a channel is not found, or holds no values.
        """
        source = str(head.path)
        headings = [self.time, *(name for name in self.headings if name != self.time)]
        choice = choose_columns(headings, (), given)
        if not choice.is_complete:
            raise UnknownColumnsError(source, headings, choice, given)
        names = {
            quantity: [headings[place] for place in column.places]
            for quantity, column in choice.chosen.items()
        }
        quantities = {name: quantity for quantity, each in names.items() for name in each}
        rows_s = self.rows_of(names["current"], names["voltage"])

        def read(wanted: list[str]) -> Any:
            columns = {
                name: self.at(name, rows_s, quantities.get(name, ""))
                for name in wanted
                if name != self.time
            }
            return arrow_table({self.time: rows_s, **columns})

        table = ArrowTable(headings, read)
        draft = draft_of_table(table, given, name=head.name, source=source)
        draft.remarks.extend(self.remarks)
        return draft
