"""Read and write the canonical log as Parquet or CSV (see `cangauge.logs.arrow` for its columns).

The temperature source is metadata of the schema in Parquet and a column in CSV; both are read in
both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from cangauge._io import MAX_LOG_COLUMNS, MAX_LOG_ROWS, MAX_PARQUET_NAMES, atomic_path
from cangauge.errors import InputError
from cangauge.logs.arrow import (
    SOURCE,
    build_table,
    check_types,
    describe,
    draft_from_table,
    find_fields,
    is_canonical,
    is_text,
)
from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import read_columns, read_plain_numbers
from cangauge.logs.draft import DraftLog
from cangauge.logs.file_content import FileContent, delimiter_of, split_cells
from cangauge.logs.formats import BDF_LABELS
from cangauge.logs.log import Log
from cangauge.logs.table_columns import draft_of_arrow


def read_parquet(content: FileContent) -> DraftLog:
    """Read a canonical log from Parquet.

    Raises
    ------
    InputError
        If it is damaged, lacks a column or holds anything but numbers.
    """
    source = str(content.path)
    with content.open_seekable() as data, _damage_as_input_error(source):
        file = _open_parquet(data)
        schema = file.schema_arrow
        names = schema.names
        if not is_canonical(names):
            return read_any_parquet(content, None)
        places = find_fields(names, source)
        _check_size(file.metadata, source)
        check_types(schema, places, source)
        texts = [names[index] for index in places.values() if is_text(schema.field(index).type)]
        if texts:
            # As dictionaries: a long text repeated in millions of rows is small in the file only.
            file = _open_parquet(data, *texts)
        columns = _ParquetColumns(file)
        return draft_from_table(columns, places, names, name=content.name, source=source)


@contextmanager
def _damage_as_input_error(source: str) -> Iterator[None]:
    try:
        yield
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(
            f"the Parquet file is cut off or damaged ({reason})", source=source, cure="export again"
        ) from error


class _ParquetColumns:
    """The part of a pyarrow.Table that a canonical log needs: one column is held at a time."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self.num_rows, self.schema = file.metadata.num_rows, file.schema_arrow

    def column(self, name: str) -> Any:
        """Read a column.

        Raises
        ------
        ValueError
            If it is damaged.
        """
        table = self._file.read(columns=[name])
        table.validate(full=True)  # damaged indices may exceed a dictionary
        return table.column(0)


def read_any_parquet(content: FileContent, given: ColumnMap | None) -> DraftLog:
    """Read a Parquet file with plain headings, or with the columns of the user.

    Raises
    ------
    InputError
        If it is damaged, or a column is not found or does not hold its quantity.
    """
    source = str(content.path)
    with content.open_seekable() as data, _damage_as_input_error(source):
        file = _open_parquet(data)
        _check_size(file.metadata, source)
        schema = file.schema_arrow
        texts = [each.name for each in schema if is_text(each.type)]

        def read(names: Sequence[str]) -> Any:
            wanted = [name for name in texts if name in names]
            table = _open_parquet(data, *wanted).read(columns=list(names))
            table.validate(full=True)
            return table

        return draft_of_arrow(schema.names, given, name=content.name, source=source, read=read)


def _open_parquet(data: Any, *dictionaries: str) -> Any:
    return pq.ParquetFile(
        data,
        # Files of `write_log` have checksums; others are read without.
        page_checksum_verification=True,
        thrift_string_size_limit=MAX_PARQUET_NAMES,
        thrift_container_size_limit=MAX_PARQUET_NAMES,
        read_dictionary=dictionaries or None,
    )


def _check_size(metadata: Any, source: str) -> None:
    """Raise InputError for a small file of huge content: Parquet compresses runs of one value."""
    for what, count, limit in (
        ("rows", metadata.num_rows, MAX_LOG_ROWS),
        ("columns", metadata.num_columns, MAX_LOG_COLUMNS),
    ):
        if count > limit:
            raise InputError(
                f"more than the {limit} {what} that a log may have",
                source=source,
                value=count,
                cure="split it",
            )


def is_canonical_csv(content: FileContent) -> bool:
    """Return whether the header is a canonical log's, possibly an incomplete one."""
    line = content.first_line
    return is_canonical(split_cells(line, delimiter_of(line) or ","))


def read_csv(content: FileContent) -> DraftLog:
    """Read a canonical log from text with `,`, `;` or tab between the columns.

    Raises
    ------
    InputError
        If it lacks a column or holds anything but numbers.
    """
    line = content.first_line
    delimiter = delimiter_of(line) or ","
    header = split_cells(line, delimiter)
    places = find_fields(header, str(content.path))
    layout: dict[str, Any] = {
        "header": header,
        "delimiter": delimiter,
        "skip_lines": content.head.index(line) + 1,
    }
    plain = None if SOURCE in places else read_plain_numbers(content, places, **layout)
    if plain is not None:
        labels = {field: header[index] for field, index in places.items()}
        draft = DraftLog(content.name, str(content.path), plain, labels)
        describe(draft, pa.array([], pa.string()), header)
        return draft
    columns = read_columns(content, places, **layout)
    values = {field: columns.numbers(field) for field in places if field != SOURCE}
    draft = DraftLog(content.name, str(content.path), values, columns.label)
    describe(draft, columns.text.get(SOURCE, pa.array([], pa.string())), header)
    draft.remarks.extend(columns.remarks)
    return draft


def write_log(log: Log, path: str | PathLike[str]) -> None:
    """Write a canonical log, all or nothing; float64 values read back exactly.

    Parameters
    ----------
    log : Log
    path : path-like
        `.parquet` or `.csv`; `.bdf`, `.bdf.csv` or `.bdf.parquet` for the Battery Data Format,
        which has no SoC.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is absent or not writable.
    """
    if ".bdf" in Path(path).suffixes[-2:]:
        _write(_bdf_table(log), path)
        return
    table = log.to_arrow()
    if Path(path).suffix.lower() == ".csv" and log.temperature_source != "unknown":
        table = table.append_column(SOURCE, [[log.temperature_source] * len(log)])
    _write(table, path)


def _bdf_table(log: Log) -> Any:
    place = "ambient" if log.temperature_source == "room" else "sensor"
    columns = {
        "time_s": log.time_s,
        "voltage_v": log.voltage_v,
        "current_a": 0.0 - log.current_a,  # positive charges
        place: log.temperature_c,
    }
    return build_table({BDF_LABELS[name]: values for name, values in columns.items()})


def write_table(columns: Mapping[str, Any], path: str | PathLike[str]) -> None:
    """Write columns as `.parquet` or `.csv` by suffix, all or nothing; NaN becomes missing.

    Parameters
    ----------
    columns : mapping of str to array of shape (n,)
        numpy or pyarrow arrays of one length.
    path : path-like
        `.parquet` or `.csv`.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is absent or not writable.
    """
    _write(build_table(columns), path)


def _write(table: Any, path: str | PathLike[str]) -> None:
    suffix = Path(path).suffix.lower()
    if suffix not in {".parquet", ".pq", ".csv", ".bdf"}:
        raise InputError(
            "unknown suffix for a table", source=path, value=suffix, cure="use .parquet or .csv"
        )
    with atomic_path(path) as part:
        if suffix in {".csv", ".bdf"}:
            with part.open("wb") as file:
                file.write((",".join(table.column_names) + "\n").encode())
                options = pacsv.WriteOptions(include_header=False, quoting_style="needed")
                pacsv.write_csv(table, file, options)
        else:
            pq.write_table(table, part, write_page_checksum=True)
