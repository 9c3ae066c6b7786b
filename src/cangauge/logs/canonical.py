"""The canonical log as Parquet, CSV and Arrow table; cell voltages beside it.

Columns in any case and order: `time_s`, `current_a` (positive = discharge), `voltage_v`,
`temperature_c`, optional `soc_pct`. `temperature_source`, the location of the temperature sensor,
is metadata of the schema or a column that repeats the word; it is omitted when unknown.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from cangauge._files import Head, atomic_path
from cangauge.errors import InputError
from cangauge.logs.draft import DraftLog, shown_headings
from cangauge.logs.headings import meaning_of
from cangauge.logs.log import Log
from cangauge.logs.table import ArrowTable, numbers_of
from cangauge.logs.text import MAX_COLUMNS, MAX_ROWS, TextTable
from cangauge.logs.units import REQUIRED, TemperatureSource, known_temperature_source

SOURCE: Final = "temperature_source"
_FIELDS: Final = (*REQUIRED, "soc_pct", SOURCE)
_METADATA_KEY: Final = b"cangauge.temperature_source"
_BDF_COLUMNS: Final = {
    "time_s": "Test Time / s",
    "current_a": "Current / A",
    "voltage_v": "Voltage / V",
    "cell": "Surface Temperature T1 / degC",
    "room": "Ambient Temperature / degC",
}


def is_canonical(names: Sequence[str]) -> bool:
    """Return whether columns have the names of a canonical log's, possibly an incomplete one.

    A temperature of another name is not a missing one: such a table is a logger's own.
    """
    spelled = {name.strip().lower() for name in names}
    others = spelled - {*_FIELDS}
    if "temperature_c" not in spelled and any(map(_is_temperature, others)):
        return False
    return len(spelled & set(REQUIRED)) >= 2


def _is_temperature(name: str) -> bool:
    meaning = meaning_of(name)
    return "temperature" in name or (meaning is not None and meaning.quantity == "temperature")


def canonical_draft(
    table: ArrowTable | TextTable, *, name: str, source: str, word: str = ""
) -> DraftLog:
    """Return the draft of a table with canonical names; `word` is its stated temperature source.

    Raises
    ------
    InputError
        If a column is missing (a temperature may be given), occurs twice, or does not hold numbers.
    """
    where = source or name
    names = list(table.headings)
    lower = [each.strip().lower() for each in names]
    places = {field: lower.index(field) for field in _FIELDS if field in lower}
    for field in _FIELDS:
        if lower.count(field) > 1:
            problem = f"{lower.count(field)} columns have this name"
            cure = "rename or drop all but one"
            raise InputError(problem, source=where, field=field, cure=cure)
        if field in REQUIRED[:3] and field not in places:
            raise InputError(
                f"this column is missing (found: {shown_headings(names)})",
                source=where,
                field=field,
                cure="a log needs time_s, current_a (positive = discharge), voltage_v,"
                " temperature_c [s, A, V, °C]",
            )
    columns = table.columns(list(places.values()))
    draft = DraftLog(name, source, headings=tuple(names))
    for field, place in places.items():
        draft.labels[field] = names[place]
        if field != SOURCE:
            draft.values[field], _ = numbers_of(columns[place], where, names[place])
    if not draft.values["time_s"].size:
        raise InputError("the log holds no rows", source=where, cure="check the export")
    if SOURCE in places:
        word = _only_word(columns[places[SOURCE]], where)
    draft.temperature_source = known_temperature_source(
        word or "unknown", source=where, field=SOURCE
    )
    draft.ignored = tuple(each for each in names if each and each.strip().lower() not in _FIELDS)
    draft.remarks += getattr(table, "remarks", [])
    return draft


def _only_word(column: Any, where: str) -> str:
    words = {str(word).strip().lower() for word in pc.unique(column.cast(pa.string())).to_pylist()}
    words -= {"", "none"}
    if len(words) > 1:
        problem = "the column must hold one word throughout"
        raise InputError(problem, source=where, field=SOURCE, value=sorted(words)[:3])
    return words.pop() if words else ""


# --- Parquet


@contextmanager
def open_parquet(head: Head) -> Iterator[tuple[ArrowTable, str]]:
    """Open a Parquet file as a table that is read by column, with its word of the metadata.

    Raises
    ------
    InputError
        If it is damaged, or larger than a log may be.
    """
    with head.open() as unpacked:
        stream = unpacked if unpacked.seekable() else pa.BufferReader(unpacked.read())
        try:
            file = pq.ParquetFile(stream, page_checksum_verification=True)
            rows, columns = file.metadata.num_rows, file.metadata.num_columns
            for what, count, limit in (("rows", rows, MAX_ROWS), ("columns", columns, MAX_COLUMNS)):
                if count > limit:
                    problem = f"more than the {limit} {what} that a log may have"
                    raise InputError(problem, source=head.path, value=count, cure="split it")
            schema = file.schema_arrow
            table = ArrowTable(schema.names, lambda names: _validated(file, names))
            yield table, word_of(schema)
        except (pa.ArrowException, OSError, ValueError) as error:
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise InputError(
                f"the Parquet file is cut off or damaged ({reason})",
                source=head.path,
                cure="export again",
            ) from error


def word_of(schema: Any) -> str:
    """Return the temperature source of a schema's metadata; "" if it states none."""
    metadata: dict[bytes, bytes] = schema.metadata or {}
    return metadata.get(_METADATA_KEY, b"").decode("utf-8", errors="replace")


def _validated(file: Any, names: list[str]) -> Any:
    table = file.read(columns=names)
    table.validate(full=True)  # damaged indices may exceed a dictionary
    return table


# --- Writing


def build_table(
    columns: Mapping[str, Any], temperature_source: TemperatureSource = "unknown"
) -> Any:
    """Return a pyarrow.Table; NaN becomes null, a known temperature source becomes metadata."""
    arrays = {
        name: pa.array(values, from_pandas=True)
        if isinstance(values, np.ndarray) and np.issubdtype(values.dtype, np.floating)
        else values
        for name, values in columns.items()
    }
    metadata = {_METADATA_KEY: temperature_source} if temperature_source != "unknown" else None
    return pa.table(arrays, metadata=metadata)


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
        place = "room" if log.temperature_source == "room" else "cell"
        columns = {"time_s": log.time_s, "voltage_v": log.voltage_v}
        columns |= {"current_a": 0.0 - log.current_a, place: log.temperature_c}  # positive charges
        write_table({_BDF_COLUMNS[name]: values for name, values in columns.items()}, path)
        return
    table = log.to_arrow()
    if Path(path).suffix.lower() == ".csv" and log.temperature_source != "unknown":
        table = table.append_column(SOURCE, [[log.temperature_source] * len(log)])
    _write(table, path)


def write_table(columns: Mapping[str, Any], path: str | PathLike[str]) -> None:
    """Write arrays of one length as `.parquet` or `.csv`, all or nothing; NaN becomes missing."""
    _write(build_table(columns), path)


def _write(table: Any, path: str | PathLike[str]) -> None:
    suffix = Path(path).suffix.lower()
    if suffix not in {".parquet", ".pq", ".csv", ".bdf"}:
        cure = "use .parquet or .csv"
        raise InputError("unknown suffix for a table", source=path, value=suffix, cure=cure)
    with atomic_path(path) as part:
        if suffix in {".csv", ".bdf"}:
            with part.open("wb") as file:
                file.write((",".join(table.column_names) + "\n").encode())
                options = pacsv.WriteOptions(include_header=False, quoting_style="needed")
                pacsv.write_csv(table, file, options)
        else:
            pq.write_table(table, part, write_page_checksum=True)
