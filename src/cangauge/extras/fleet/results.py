"""Results of a fleet in Parquet: a file of rows for each vehicle (hive layout).

    OUT/estimate/vehicle=A17/rows.parquet        one row a log
    OUT/estimate-bad/vehicle=A17/rows.parquet    logs set aside, with the reason

A file is written whole or not at all, so that a killed run keeps what it has written. A row stays
beside a later failure that does not lie in its log, such as of the storage.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, unquote

import pyarrow as pa
import pyarrow.parquet as pq

from cangauge._files import atomic_path
from cangauge.errors import InputError
from cangauge.extras.fleet.sources import filesystem, is_local

Row = Mapping[str, Any]

_KEYS: Final = {
    "log": pa.string(),  # URL, or the vehicle of a diagnosis
    "task": pa.string(),  # what was computed with it: the log, or all logs of the vehicle
    "stamp": pa.string(),  # of the task's logs in the storage and in a manifest
    "run": pa.string(),  # model, options and version that made the row
}
"""Columns of every row, beside the partition's `vehicle`."""
_BAD: Final = {"reason": pa.string(), "kind": pa.string(), "is_final": pa.bool_()}
"""Further columns of a log set aside; one that is not final is tried again by the next run."""


@dataclass(slots=True)
class Finished:
    """What became of a task: its rows, and the logs that were set aside."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    bad: list[dict[str, Any]] = field(default_factory=list)


class Results:
    """Rows of one kind, and the logs that were set aside.

    Parameters
    ----------
    out : str
        Folder, or fsspec URL.
    kind : str
        Name of the table, such as "estimate".
    columns : mapping of str to pyarrow type
        Columns beside the keys.

    Raises
    ------
    InputError
        If the storage cannot be written.
    """

    def __init__(self, out: str, kind: str, columns: Mapping[str, Any]) -> None:
        self.out, self.kind = out.rstrip("/"), kind
        self._fs, self._root = filesystem(self.out)
        self._schemas = {False: pa.schema({**_KEYS, **columns}), True: pa.schema({**_KEYS, **_BAD})}
        try:
            self._fs.makedirs(self._root, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be written: {error}", source=out) from error

    def rows(self, *, bad: bool = False) -> Iterator[dict[str, Any]]:
        """Yield all rows, or those set aside, with `vehicle`."""
        self._fs.invalidate_cache()
        table = self._table(bad=bad)
        for path in sorted(self._fs.find(table)) if self._fs.exists(table) else ():
            if path.endswith("/rows.parquet"):
                yield from self._read(path)

    def known(self, run: str) -> dict[str, tuple[str, int, int]]:
        """Return stamp, rows and logs set aside of each task that a run has finished."""
        found: dict[str, tuple[str, int, int]] = {}
        retried = set()
        for bad in (False, True):
            for row in self.rows(bad=bad):
                if row["run"] == run:
                    _, good, aside = found.get(row["task"], ("", 0, 0))
                    found[row["task"]] = row["stamp"], good + (not bad), aside + bad
                    if not row.get("is_final", True):
                        retried.add(row["task"])
        return {task: counts for task, counts in found.items() if task not in retried}

    def put(self, vehicle: str, finished: Mapping[str, Finished]) -> None:
        """Write what became of some tasks of a vehicle, in place of what they had before."""
        lost = {r["log"] for done in finished.values() for r in done.bad if not r["is_final"]}
        for bad in (False, True):
            path = f"{self._table(bad=bad)}/vehicle={quote(vehicle, safe='')}/rows.parquet"
            before = list(self._read(path)) if self._fs.exists(path) else []
            rows = [
                row
                for row in before
                if row["task"] not in finished or (not bad and row["log"] in lost)
            ]
            rows += [row for done in finished.values() for row in (done.bad if bad else done.rows)]
            if rows:
                self._write(path, self._schemas[bad], sorted(rows, key=lambda row: row["log"]))
            elif before:
                self._fs.rm_file(path)

    def _table(self, *, bad: bool) -> str:
        return f"{self._root}/{self.kind}{'-bad' if bad else ''}"

    def _read(self, path: str) -> Iterator[dict[str, Any]]:
        vehicle = unquote(path.rpartition("/")[0].rpartition("vehicle=")[2])
        try:
            with self._fs.open(path, "rb") as file:
                table = pq.ParquetFile(file)
                if not set(_KEYS) <= set(table.schema_arrow.names):
                    raise pa.ArrowInvalid("not a table of cangauge fleet")
                for batch in table.iter_batches(4096):
                    yield from (row | {"vehicle": vehicle} for row in batch.to_pylist())
        except pa.ArrowException as error:
            cure = "delete it: its logs are computed again"
            raise InputError(f"damaged: {error}", source=path, cure=cure) from error

    def _write(self, path: str, schema: Any, rows: Sequence[Row]) -> None:
        columns = {name: [row.get(name) for row in rows] for name in schema.names}
        content = io.BytesIO()
        pq.write_table(pa.table(columns, schema=schema), content)
        self._fs.makedirs(path.rpartition("/")[0], exist_ok=True)
        if is_local(self._fs):
            with atomic_path(Path(path)) as part:
                part.write_bytes(content.getvalue())
        else:
            self._fs.pipe_file(path, content.getvalue())
        self._fs.invalidate_cache()


def reason_of(row: Row) -> str:
    """Return why a log was set aside, without its name."""
    return str(row["reason"]).removeprefix(f"{row['log']}: ")


def by_kind(rows: Iterable[Row]) -> list[tuple[Row, int]]:
    """Return one log, and the number, of those set aside for each kind of reason.

    Reasons of a kind name the same problem of the same field; values and files in them differ. The
    most frequent comes first.
    """
    first: dict[tuple[str, str], Row] = {}
    counts: Counter[tuple[str, str]] = Counter()
    for row in rows:
        kind = row.get("table", ""), row.get("kind") or reason_of(row)
        first.setdefault(kind, row)
        counts[kind] += 1
    return [(first[kind], number) for kind, number in counts.most_common()]
