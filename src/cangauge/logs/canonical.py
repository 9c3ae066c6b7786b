"""The canonical log as Parquet, CSV and Arrow table.

Columns in any case and order: `time_s`, `current_a` (positive = discharge), `voltage_v`,
`temperature_c`, optional `soc_pct`. `temperature_source`, the location of the temperature sensor,
is metadata of the schema or a column that repeats the word; it is omitted when unknown.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from cangauge._dataframes import arrow_table
from cangauge._files import Head, atomic_path
from cangauge.errors import InputError
from cangauge.logs.log import SOURCE, SOURCE_KEY, Log
from cangauge.logs.table import ArrowTable
from cangauge.logs.text import MAX_COLUMNS, MAX_ROWS


def parquet_table(head: Head) -> ArrowTable:
    """Return a Parquet file as a table that is read by column.

    Raises
    ------
    InputError
        If it is damaged, or larger than a log may be.
    """

    def read(names: list[str]) -> Any:
        with _opened(head) as file:
            table = file.read(columns=names)
            table.validate(full=True)  # damaged indices may exceed a dictionary
            return table

    with _opened(head) as file:
        rows, columns = file.metadata.num_rows, file.metadata.num_columns
        for what, count, limit in (("rows", rows, MAX_ROWS), ("columns", columns, MAX_COLUMNS)):
            if count > limit:
                problem = f"more than the {limit} {what} that a log may have"
                raise InputError(problem, source=head.path, value=count, cure="split it")
        table = table_of_schema(file.schema_arrow, read, str(head.path))
        return replace(table, decimal_mark=head.decimal_mark)


@contextmanager
def _opened(head: Head) -> Iterator[Any]:
    with head.open() as unpacked:
        stream = unpacked if unpacked.seekable() else pa.BufferReader(unpacked.read())
        try:
            yield pq.ParquetFile(stream, page_checksum_verification=True)
        except (pa.ArrowException, OSError, ValueError) as error:
            reason = (str(error) or type(error).__name__).splitlines()[0]
            problem = f"the Parquet file is cut off or damaged ({reason})"
            raise InputError(problem, source=head.path, cure="export again") from error


def table_of_schema(schema: Any, read: Any, source: str) -> ArrowTable:
    """Return a table of an Arrow schema with the temperature source of its metadata."""
    metadata: dict[bytes, bytes] = schema.metadata or {}
    word = metadata.get(SOURCE_KEY, b"").decode("utf-8", errors="replace")
    return ArrowTable(schema.names, read, word, source)


def write_log(log: Log, path: str | PathLike[str]) -> None:
    """Write a canonical log as `.parquet` or `.csv`, all or nothing; values read back exactly.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is absent or not writable.
    """
    table = log.to_arrow()
    if Path(path).suffix.lower() == ".csv" and log.temperature_source != "unknown":
        table = table.append_column(SOURCE, [[log.temperature_source] * len(log)])
    write_table(table, path)


def write_table(columns: Mapping[str, Any] | pa.Table, path: str | PathLike[str]) -> None:
    """Write a table or arrays as `.parquet` or `.csv`, all or nothing; NaN becomes missing."""
    table = columns if isinstance(columns, pa.Table) else arrow_table(columns)
    suffix = Path(path).suffix.lower()
    suffix = ".bdf" if ".bdf" in Path(Path(path).name.lower()).suffixes else suffix
    if suffix not in {".parquet", ".pq", ".csv"}:
        cure = "use .parquet or .csv"
        raise InputError("unknown suffix for a table", source=path, value=suffix, cure=cure)
    with atomic_path(path) as part:
        if suffix != ".csv":
            pq.write_table(table, part, write_page_checksum=True)
            return
        with part.open("wb") as file:
            file.write((",".join(table.column_names) + "\n").encode())
            options = pacsv.WriteOptions(include_header=False, quoting_style="needed")
            pacsv.write_csv(table, file, options)
