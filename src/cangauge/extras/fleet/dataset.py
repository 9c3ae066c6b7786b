"""Results of a fleet: one row per log in Parquet, partitioned by vehicle (hive layout).

    OUT/estimate/vehicle=A17/3f2c….parquet        rows
    OUT/estimate-bad/vehicle=A17/91ab….parquet    logs set aside, with the reason

Finished rows are added in new files, each written whole or not at all, so that a killed run keeps
them. At the end of a run the files of each vehicle become one, with the latest row of each log. A
row stays beside a later failure that does not lie in its log, such as of the storage.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, unquote

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cangauge._files import atomic_path, text_sha256
from cangauge.errors import InputError
from cangauge.extras.fleet.sources import FleetLog, filesystem

_TEXT, _REAL, _WHOLE = pa.string(), pa.float64(), pa.int64()

KEYS: Final = {
    "log": _TEXT,  # URL
    "sha256": _TEXT,  # of its content
    "stamp": _TEXT,  # of its entry in the storage
    "stated": _TEXT,  # of it in a manifest
    "run": _TEXT,  # model, options and version that made the row
    "made_at": pa.timestamp("us", tz="UTC"),
    "seconds": _REAL,  # computing time [s]
}
"""Columns of every row, beside the partition's `vehicle`."""

BAD: Final = {"reason": _TEXT, "kind": _TEXT, "is_final": pa.bool_()}
"""Further columns of a log set aside; one that is not final is tried again by the next run."""

BATCH_ROWS: Final = 4096
"""Rows held at once where a whole table is read."""

Row = Mapping[str, Any]


class Dataset:
    """Rows of one kind, and the logs that were set aside.

    Parameters
    ----------
    out : str
        Folder, or fsspec URL.
    kind : str
        Name of the table, such as "estimate".
    columns : mapping of str to pyarrow type
        Columns beside `KEYS`.

    Raises
    ------
    InputError
        If the storage cannot be written.
    """

    def __init__(self, out: str, kind: str, columns: Mapping[str, Any]) -> None:
        self.out, self.kind = out.rstrip("/"), kind
        self._fs, self._root = filesystem(self.out)
        self._is_local = "local" in self._fs.protocol
        self._schemas = {
            kind: pa.schema({**KEYS, **columns}),
            f"{kind}-bad": pa.schema({**KEYS, **BAD}),
        }
        try:
            self._fs.makedirs(self._root, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot be written: {error}", source=out) from error

    @property
    def tables(self) -> tuple[str, str]:
        """Names of the table of rows and of that of the logs set aside."""
        return self.kind, f"{self.kind}-bad"

    def add(self, rows: Sequence[Row], *, bad: bool = False) -> None:
        """Add rows, each with the columns of its table and `vehicle`."""
        by_vehicle: dict[str, list[Row]] = {}
        for row in rows:
            by_vehicle.setdefault(row["vehicle"], []).append(row)
        for vehicle, of_vehicle in by_vehicle.items():
            self._write(self.tables[bad], vehicle, of_vehicle)

    def known(self, run: str, *columns: str) -> dict[str, dict[str, Any]]:
        """Return the rows of a run by log: those done, and those set aside for good.

        Parameters
        ----------
        run : str
        *columns : str
            Columns of the rows beside `stamp`, `stated`, `sha256` and `made_at`.
        """
        found: dict[str, dict[str, Any]] = {}
        for table in self.tables:
            wanted = [name for name in columns if name in self._schemas[table].names]
            extra = ["is_final"] if table != self.kind else []
            for row in self._rows(
                table, [*("log", "stamp", "stated", "sha256", "made_at"), *wanted, *extra],
                pc.field("run") == run,
            ):  # fmt: skip
                earlier = found.get(row["log"])
                if earlier is None or earlier["made_at"] <= row["made_at"]:
                    found[row["log"]] = row
        return {log: row for log, row in found.items() if row.get("is_final", True)}

    def rows(
        self, run: str | None = None, *, bad: bool = False, without: Sequence[str] = ()
    ) -> Iterator[dict[str, Any]]:
        """Yield the rows, of one run if stated, with `vehicle` and without some columns."""
        wanted = None if run is None else pc.field("run") == run
        table = self.tables[bad]
        names = [name for name in self._schemas[table].names if name not in without]
        yield from self._rows(table, names, wanted)

    def settle(self, run: str = "", touched: Sequence[FleetLog] = ()) -> None:
        """Join the files of each vehicle to one, with the latest row of each log.

        Parameters
        ----------
        run : str
        touched : sequence of FleetLog
            Logs of which the storage shows another stamp than the rows of this run, for the same
            content: the rows take the new one.
        """
        stamps: dict[str, dict[tuple[str, str], str]] = {}
        for log in touched:
            stamps.setdefault(log.vehicle, {})[log.url, run] = log.stamp
        files = {table: self._by_vehicle(table) for table in self.tables}
        good, bad = (files[table] for table in self.tables)
        for vehicle in sorted({*good, *bad}):
            of_vehicle = {table: files[table].get(vehicle, []) for table in self.tables}
            if vehicle in bad or vehicle in stamps or len(good[vehicle]) > 1:
                self._settle_vehicle(vehicle, of_vehicle, stamps.get(vehicle, {}))

    def _settle_vehicle(
        self,
        vehicle: str,
        files: Mapping[str, Sequence[str]],
        stamps: Mapping[tuple[str, str], str],
    ) -> None:
        latest: dict[str, dict[str, dict[str, Any]]] = {table: {} for table in self.tables}
        for table, of_table in latest.items():
            for row in self._rows(table, self._schemas[table].names, None, files[table]):
                row["stamp"] = stamps.get((row["log"], row["run"]), row["stamp"])
                before = of_table.get(row["log"])
                if before is None or before["made_at"] <= row["made_at"]:
                    of_table[row["log"]] = row
        good, bad = latest.values()
        for log in good.keys() & bad.keys():
            if bad[log]["made_at"] < good[log]["made_at"]:
                del bad[log]
            elif bad[log]["is_final"]:
                del good[log]
        for table, of_table in latest.items():
            written = self._write(table, vehicle, [*of_table.values()]) if of_table else ""
            for path in files[table]:
                if path != written:
                    with suppress(FileNotFoundError):  # another run has settled it
                        self._fs.rm_file(path)

    def _write(self, table: str, vehicle: str, rows: Sequence[Row]) -> str:
        rows = sorted(rows, key=lambda row: row["log"])
        schema = self._schemas[table]
        columns = {name: [row.get(name) for row in rows] for name in schema.names}
        content = io.BytesIO()
        pq.write_table(pa.table(columns, schema=schema), content)
        # The same rows have the same name: a file that is written again replaces itself.
        keys = "".join(f"{row['log']}{row['run']}{row['made_at']}" for row in rows)
        name = text_sha256(keys)[:16]
        folder = self._folder(table, vehicle)
        path = f"{folder}/{name}.parquet"
        self._fs.makedirs(folder, exist_ok=True)
        if self._is_local:
            with atomic_path(Path(path)) as part:
                part.write_bytes(content.getvalue())
        else:
            self._fs.pipe_file(path, content.getvalue())
        return path

    def _folder(self, table: str, vehicle: str) -> str:
        return f"{self._root}/{table}/vehicle={quote(vehicle, safe='')}"

    def _files(self, table: str) -> list[str]:
        folder = f"{self._root}/{table}"
        self._fs.invalidate_cache()
        try:
            found = self._fs.find(folder)
        except FileNotFoundError:
            return []
        # A run that is killed while it writes leaves a hidden file.
        return sorted(
            path
            for path in found
            if path.endswith(".parquet") and not path.rpartition("/")[2].startswith(".")
        )

    def _by_vehicle(self, table: str) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for path in self._files(table):
            found.setdefault(_vehicle_of(path), []).append(path)
        return found

    def _rows(
        self, table: str, names: Sequence[str], wanted: Any, files: Sequence[str] | None = None
    ) -> Iterator[dict[str, Any]]:
        for path in self._files(table) if files is None else files:
            with suppress(FileNotFoundError):  # another run has settled it
                yield from self._rows_of(path, names, wanted)

    def _rows_of(self, path: str, names: Sequence[str], wanted: Any) -> Iterator[dict[str, Any]]:
        vehicle = _vehicle_of(path)
        with self._fs.open(path, "rb") as file:
            source = pq.ParquetFile(file)
            stored = [name for name in names if name in source.schema_arrow.names]
            if wanted is not None and "run" not in stored:
                stored.append("run")
            for batch in source.iter_batches(BATCH_ROWS, columns=stored):
                part = pa.Table.from_batches([batch])
                chosen = part if wanted is None else part.filter(wanted)
                for row in chosen.to_pylist():
                    yield row | {"vehicle": vehicle}


def _vehicle_of(path: str) -> str:
    return unquote(path.rpartition("/")[0].rpartition("vehicle=")[2])


def reason_of(row: Row) -> str:
    """Return why a log was set aside, without its name."""
    return str(row["reason"]).removeprefix(f"{row['log']}: ")


def by_kind(rows: Iterable[Row]) -> list[tuple[Row, int]]:
    """Return one log, and the number, of those set aside for each kind of reason.

    Reasons of a kind name the same problem of the same field; values and files in them differ.

    Parameters
    ----------
    rows : iterable of mapping
        Each with `log`, `reason`, `kind` (unknown in earlier versions) and maybe `table`.

    Returns
    -------
    list of (row, number)
        The most frequent first.
    """
    first: dict[tuple[str, str], Row] = {}
    counts: Counter[tuple[str, str]] = Counter()
    for row in rows:
        kind = row.get("table", ""), row.get("kind") or reason_of(row)
        first.setdefault(kind, row)
        counts[kind] += 1
    return [(first[kind], number) for kind, number in counts.most_common()]


def keys_of(log: FleetLog, run: str, sha256: str, seconds: float) -> dict[str, Any]:
    """Return the columns that every row of a log has.

    Parameters
    ----------
    log : FleetLog
    run : str
    sha256 : str
    seconds : float
        Computing time [s].
    """
    return {
        "log": log.url,
        "vehicle": log.vehicle,
        "sha256": sha256,
        "stamp": log.stamp,
        "stated": log.stated,
        "run": run,
        "made_at": datetime.now(UTC),
        "seconds": seconds,
    }
