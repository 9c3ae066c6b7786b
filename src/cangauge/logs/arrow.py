"""The columns of a canonical log in an Arrow table or a text header: names, types, values.

Names in any case: `time_s`, `current_a` (positive = discharge), `voltage_v`, `temperature_c`,
optional `soc_pct`. `temperature_source`, the location of the temperature sensor, is metadata of the
schema or a column that repeats the word; it is omitted when unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.draft import DraftLog
from cangauge.logs.headings import meaning_of
from cangauge.logs.units import (
    REQUIRED,
    TEMPERATURE_SOURCES,
    TemperatureSource,
    known_temperature_source,
)

SOURCE: Final = "temperature_source"
_FIELDS: Final = (*REQUIRED, "soc_pct", SOURCE)
_METADATA_KEY: Final = b"cangauge.temperature_source"


def is_canonical(names: Sequence[str]) -> bool:
    """Return whether columns have the names of a canonical log's, possibly an incomplete one.

    A temperature of another name is not a missing one: such a table is a logger's own.
    """
    spelled = {name.strip().lower() for name in names}
    if "temperature_c" not in spelled and any(map(_is_temperature, spelled - {SOURCE})):
        return False
    return len(spelled & set(REQUIRED)) >= 2


def _is_temperature(name: str) -> bool:
    meaning = meaning_of(name)
    return "temperature" in name or (meaning is not None and meaning.quantity == "temperature")


def find_fields(names: Sequence[str], where: str) -> dict[str, int]:
    """Return the index of each canonical column that is present.

    Parameters
    ----------
    names : sequence of str
        Column names of the file or table.
    where : str
        File or table, for messages.

    Raises
    ------
    InputError
        If a column is missing or occurs twice. A missing temperature is allowed: the user may
        give a constant.
    """
    places: dict[str, int] = {}
    for field in _FIELDS:
        found = [i for i, name in enumerate(names) if name.strip().lower() == field]
        if len(found) > 1:
            raise InputError(
                f"{len(found)} columns have this name",
                source=where,
                field=field,
                cure="rename or drop all but one",
            )
        if found:
            places[field] = found[0]
    missing = [field for field in REQUIRED if field not in places and field != "temperature_c"]
    if missing:
        shown = ", ".join(names[:12]) + (", …" if len(names) > 12 else "")
        raise InputError(
            f"this column is missing (found: {shown})",
            source=where,
            field=missing[0],
            cure="a log needs time_s, current_a (positive = discharge), voltage_v, temperature_c"
            " [s, A, V, °C]",
        )
    return places


def check_types(schema: Any, places: Mapping[str, int], where: str) -> None:
    """Raise InputError if a column's Arrow type can hold neither numbers nor, as text, words."""
    types = pa.types
    for field, index in places.items():
        column = schema.field(index)
        kind = column.type
        good = is_text(kind) or types.is_null(kind)
        what, cure = "words", f"store it as one of: {', '.join(TEMPERATURE_SOURCES)}"
        if field != SOURCE:
            numbers = (types.is_integer, types.is_floating, types.is_decimal)
            good = good or any(is_kind(kind) for is_kind in numbers)
            what, cure = "numbers", "store it as floating point"
        if not good:
            raise InputError(
                f"the column does not hold {what}",
                source=where,
                field=column.name,
                value=str(kind)[:60],
                cure=cure,
            )


def is_text(kind: Any) -> bool:
    """Return whether an Arrow type is text, dictionary-encoded or not."""
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    return str(kind) in {"string", "large_string", "string_view"}


def draft_from_table(
    table: Any, places: Mapping[str, int], names: Sequence[str], *, name: str, source: str
) -> DraftLog:
    """Return the draft of a log from an Arrow table whose types are checked.

    Parameters
    ----------
    table : pyarrow.Table
        Holds at least the columns of `places`; anything with `num_rows`, `schema` and `column`.
    places : mapping of str to int
        Index in `names` by canonical field.
    names : sequence of str
        All columns of the file or table.
    name, source : str
        Of the log.
    """
    where = source or name
    if not table.num_rows:
        raise InputError("the log holds no rows", source=where, cure="check the export")
    values = {
        field: _as_float64(table.column(names[index]), names[index], where)
        for field, index in places.items()
        if field != SOURCE
    }
    metadata = table.schema.metadata or {}
    word = metadata.get(_METADATA_KEY, b"unknown").decode("utf-8", errors="replace")
    draft = DraftLog(name, source, values, {field: names[index] for field, index in places.items()})
    words = table.column(names[places[SOURCE]]) if SOURCE in places else pa.array([word])
    describe(draft, words, names)
    return draft


def describe(draft: DraftLog, words: Any, names: Sequence[str]) -> None:
    """Set a draft's temperature source from the column's words, and the ignored columns.

    Raises
    ------
    InputError
        If the words differ, or are no temperature source.
    """
    where = draft.source or draft.name
    distinct = {str(word).strip().lower() for word in pc.unique(_plain(words)).to_pylist() if word}
    distinct.discard("")
    if len(distinct) > 1:
        raise InputError(
            "the column must hold one word throughout",
            source=where,
            field=SOURCE,
            value=sorted(distinct)[:3],
        )
    word = distinct.pop() if distinct else "unknown"
    draft.temperature_source = known_temperature_source(word, source=where, field=SOURCE)
    draft.headings = tuple(names)
    draft.ignored = tuple(name for name in names if name and name.strip().lower() not in _FIELDS)


def build_table(
    columns: Mapping[str, Any], temperature_source: TemperatureSource = "unknown"
) -> Any:
    """Return a pyarrow.Table; NaN becomes null, a known temperature source becomes metadata.

    Parameters
    ----------
    columns : mapping of str to array of shape (n,)
        numpy or pyarrow arrays of one length.
    temperature_source : str
    """
    arrays = {name: _null_for_nan(values) for name, values in columns.items()}
    metadata = {_METADATA_KEY: temperature_source} if temperature_source != "unknown" else None
    return pa.table(arrays, metadata=metadata)


def _null_for_nan(values: Any) -> Any:
    is_float = isinstance(values, np.ndarray) and np.issubdtype(values.dtype, np.floating)
    return pa.array(values, from_pandas=True) if is_float else values


def _as_float64(column: Any, label: str, where: str) -> FloatArray:
    try:
        numbers = pc.cast(_plain(column), pa.float64(), safe=False)
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            "the column does not hold numbers",
            source=where,
            field=label,
            value=str(column.type),
            cure="store it as floating point",
        ) from error
    return np.array(numbers.to_numpy())  # of its own, so that the table can be freed


def free_unused() -> None:
    """Return to the system what pyarrow keeps of freed tables: as much as a long log."""
    pa.default_memory_pool().release_unused()


def _plain(column: Any) -> Any:
    # The text type of polars, which few compute functions of pyarrow accept.
    return column.cast(pa.string()) if str(column.type) == "string_view" else column
