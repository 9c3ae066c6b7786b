"""The canonical log as Parquet or CSV: read and write.

Columns `time_s`, `current_a` (positive = discharge), `voltage_v`, `temperature_c`, optional
`soc_pct`, in any case. What the temperature was measured on travels as `temperature_source`: in
Parquet as metadata of the schema, in CSV as a column that repeats the word (both are read in
both). It is left out when it is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from cangauge._io import MAX_LOG_COLUMNS, MAX_LOG_ROWS, MAX_PARQUET_NAMES, atomic_path
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.columns import read_columns
from cangauge.logs.draft import REQUIRED, DraftLog
from cangauge.logs.file_content import FileContent, cells, delimiter_of
from cangauge.logs.log import TEMPERATURE_SOURCES, Log, TemperatureSource

_OPTIONAL: Final = ("soc_pct",)
_SOURCE: Final = "temperature_source"
_METADATA_KEY: Final = b"cangauge.temperature_source"
_CURE: Final = (
    "a log needs time_s, current_a (positive = discharge), voltage_v, temperature_c [s, A, V, °C]"
)


def is_canonical_header(names: list[str]) -> bool:
    """Whether a CSV header looks like a canonical log's, maybe an incomplete one."""
    found = {name.strip().lower() for name in names}
    return len(found & set(REQUIRED)) >= 2


def read_parquet(content: FileContent) -> DraftLog:
    """Read a canonical log from Parquet.

    Parameters
    ----------
    content : FileContent
        The file.

    Raises
    ------
    InputError
        If it is damaged, lacks a column or holds something else than numbers.
    """
    path = content.path
    try:
        file = _open_parquet(content)
        schema = file.schema_arrow
        places = _places(schema.names, path)
        _refuse_large(file.metadata, path)
        for field, index in places.items():
            _check_type(field, schema.field(index), path)
        texts = [schema.names[i] for i in places.values() if _is_text(schema.field(i).type)]
        if texts:
            # A long text, repeated in millions of rows, takes no room in the file.
            file = _open_parquet(content, *texts)
        table = file.read(columns=[schema.names[i] for i in places.values()])
        table.validate(full=True)  # damage can point outside of a dictionary
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(
            f"the Parquet file is cut off or damaged ({reason})", source=path, cure="export again"
        ) from error
    names = schema.names
    if not table.num_rows:
        raise InputError("the log holds no rows", source=path, cure="check the export")
    values = {
        field: _as_numbers(table.column(names[index]), names[index], path)
        for field, index in places.items()
        if field != _SOURCE
    }
    metadata = schema.metadata or {}
    word = metadata.get(_METADATA_KEY, b"unknown").decode("utf-8", errors="replace")
    if _SOURCE in places:
        word = _one_word(table.column(names[places[_SOURCE]]), path)
    labels = {field: names[index] for field, index in places.items()}
    return _draft(content, values, labels, names, word)


def read_csv(content: FileContent) -> DraftLog:
    """Read a canonical log from text with `,`, `;` or tab between the columns.

    Parameters
    ----------
    content : FileContent
        The file.

    Raises
    ------
    InputError
        If it lacks a column or holds something else than numbers.
    """
    line = next(i for i, text in enumerate(content.head) if text.strip())
    delimiter = delimiter_of(content.head[line]) or ","
    header = cells(content.head[line], delimiter)
    places = _places(header, content.path)
    columns = read_columns(content, places, header=header, delimiter=delimiter, skip_lines=line + 1)
    values = {field: columns.numbers(field) for field in places if field != _SOURCE}
    word = _one_word(columns.text[_SOURCE], content.path) if _SOURCE in places else "unknown"
    draft = _draft(content, values, columns.label, header, word)
    draft.remarks.extend(columns.remarks)
    return draft


def write_log(log: Log, path: str | PathLike[str]) -> None:
    """Write a canonical log, all or nothing, with float64 values that read back exactly.

    Parameters
    ----------
    log : Log
    path : path-like
        `.parquet` or `.csv`.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is absent or not writable.
    """
    columns: dict[str, Any] = {name: getattr(log, name) for name in REQUIRED}
    if log.soc_pct is not None:
        columns["soc_pct"] = log.soc_pct
    known = log.temperature_source != "unknown"
    if known and Path(path).suffix.lower() == ".csv":
        columns[_SOURCE] = pa.array([log.temperature_source] * len(log))
    metadata = {_METADATA_KEY: log.temperature_source.encode()} if known else {}
    write_table(columns, path, metadata=metadata)


def write_table(
    columns: Mapping[str, Any],
    path: str | PathLike[str],
    *,
    metadata: Mapping[bytes, bytes] | None = None,
) -> None:
    """Write columns as `.parquet` or `.csv` by suffix, all or nothing; NaN becomes missing.

    Parameters
    ----------
    columns : mapping of str to array of shape (n,)
        numpy or pyarrow arrays of one length.
    path : path-like
        `.parquet` or `.csv`.
    metadata : mapping of bytes to bytes, optional
        For the Parquet schema; a CSV cannot hold it.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is absent or not writable.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in {".parquet", ".pq", ".csv"}:
        raise InputError(
            "the suffix does not say what to write",
            source=path,
            value=suffix,
            cure="name a .parquet or a .csv file",
        )
    table = pa.table({name: _missing_for_nan(values) for name, values in columns.items()})
    with atomic_path(path) as part:
        if suffix == ".csv":
            with part.open("wb") as file:
                file.write((",".join(table.column_names) + "\n").encode())
                options = pacsv.WriteOptions(include_header=False, quoting_style="needed")
                pacsv.write_csv(table, file, options)
        else:
            table = table.replace_schema_metadata(dict(metadata or {}))
            pq.write_table(table, part, write_page_checksum=True)


def _missing_for_nan(values: Any) -> Any:
    is_float = isinstance(values, np.ndarray) and np.issubdtype(values.dtype, np.floating)
    return pa.array(values, from_pandas=True) if is_float else values


def _places(names: list[str], path: object) -> dict[str, int]:
    """Return the index of each column that is there, by canonical name."""
    places: dict[str, int] = {}
    for field in (*REQUIRED, *_OPTIONAL, _SOURCE):
        found = [i for i, name in enumerate(names) if name.strip().lower() == field]
        if len(found) > 1:
            raise InputError(
                f"{len(found)} columns have this name",
                source=str(path),
                field=field,
                cure="rename or drop all but one",
            )
        if found:
            places[field] = found[0]
    # Temperature may be given by the user instead: `DraftLog.to_log` asks for it.
    missing = [field for field in REQUIRED if field not in places and field != "temperature_c"]
    if missing:
        shown = ", ".join(names[:12]) + (", …" if len(names) > 12 else "")
        raise InputError(
            f"this column is missing (the file has: {shown})",
            source=str(path),
            field=missing[0],
            cure=_CURE,
        )
    return places


def _draft(
    content: FileContent,
    values: dict[str, FloatArray],
    labels: dict[str, str],
    names: list[str],
    word: str,
) -> DraftLog:
    remarks = []
    known = {*REQUIRED, *_OPTIONAL, _SOURCE}
    extra = [name for name in names if name and name.strip().lower() not in known]
    if extra:
        shown = ", ".join(extra[:6]) + (", …" if len(extra) > 6 else "")
        remarks.append(f"{len(extra)} other columns ignored: {shown}")
    if word not in TEMPERATURE_SOURCES:
        raise InputError(
            "what the temperature was measured on is not a known word",
            source=content.path,
            field=_SOURCE,
            value=word,
            cure=f"use one of: {', '.join(TEMPERATURE_SOURCES)}",
        )
    return DraftLog(content, values, labels, cast("TemperatureSource", word), remarks=remarks)


def _open_parquet(content: FileContent, *words: str) -> Any:
    return pq.ParquetFile(
        pa.BufferReader(content.data),
        # Checksums are there in files that we wrote; others are read without.
        page_checksum_verification=True,
        thrift_string_size_limit=MAX_PARQUET_NAMES,
        thrift_container_size_limit=MAX_PARQUET_NAMES,
        read_dictionary=words or None,
    )


def _refuse_large(metadata: Any, path: object) -> None:
    """Refuse what a small file can unpack to: runs of one value take no room in it."""
    for what, count, limit in (
        ("rows", metadata.num_rows, MAX_LOG_ROWS),
        ("columns", metadata.num_columns, MAX_LOG_COLUMNS),
    ):
        if count > limit:
            raise InputError(
                f"more than the {limit} {what} that a log may have",
                source=str(path),
                value=count,
                cure="cut it into parts",
            )


def _check_type(field: str, column: Any, path: object) -> None:
    kind, types = column.type, pa.types
    good = _is_text(kind) or types.is_null(kind)
    what, cure = "words", f"store it as one of: {', '.join(TEMPERATURE_SOURCES)}"
    if field != _SOURCE:
        numbers = (types.is_integer, types.is_floating, types.is_decimal)
        good = good or any(is_kind(kind) for is_kind in numbers)
        what, cure = "numbers", "store it as floating point"
    if not good:
        raise InputError(
            f"the column does not hold {what}",
            source=str(path),
            field=column.name,
            value=str(kind)[:60],
            cure=cure,
        )


def _is_text(kind: Any) -> bool:
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _as_numbers(column: Any, label: str, path: object) -> FloatArray:
    try:
        numbers = pc.cast(column, pa.float64(), safe=False)
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            "the column does not hold numbers",
            source=str(path),
            field=label,
            value=str(column.type),
            cure="store it as floating point",
        ) from error
    return np.asarray(numbers.to_numpy(), dtype=np.float64)


def _one_word(column: Any, path: object) -> str:
    words = {str(word).strip().lower() for word in pc.unique(column).to_pylist() if word}
    words.discard("")
    if len(words) > 1:
        raise InputError(
            "the column must hold one word throughout",
            source=str(path),
            field=_SOURCE,
            value=sorted(words)[:3],
        )
    return words.pop() if words else "unknown"
