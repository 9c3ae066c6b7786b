"""Read a log of any known format, recognised by content, not by suffix."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, Final

from cangauge.errors import InputError
from cangauge.logs import arrow, canonical, formats, measurement, table, table_columns
from cangauge.logs.column_map import ColumnMap, missing_quantities, shown_headings, suggestion
from cangauge.logs.draft import DraftLog, Sign
from cangauge.logs.file_content import FileContent
from cangauge.logs.foreign import foreign_format
from cangauge.logs.log import Log, TemperatureSource
from cangauge.logs.sign import resolve_sign
from cangauge.logs.units import COLDEST_C, HOTTEST_C, known_temperature_source

KNOWN_LOGS: Final = (
    "canonical Parquet and CSV (time_s, current_a, voltage_v, temperature_c, soc_pct), ANL D3"
    " tests, BMW i3 trips, Arbin, Bitrode and VisuaLCN exports, Battery Data Format, MF4"
    " signals, MCAP samples, any table with plain headings"
)

_Reader = Callable[[FileContent], DraftLog]
_TEXT_FORMATS: Final[tuple[tuple[Callable[[FileContent], bool], _Reader], ...]] = (
    (formats.is_bmw_i3, formats.read_bmw_i3),
    (formats.is_d3, formats.read_d3),
    # Before the canonical log, whose names battery-data-standard partly shares.
    (formats.is_cycler, formats.read_cycler),
    (canonical.is_canonical_csv, canonical.read_csv),
    (table.is_table, table.read_table),
)


@dataclass(frozen=True, slots=True)
class LogFile:
    """A file that may be a log, recognised by its beginning.

    Parameters
    ----------
    content : FileContent
    reader : callable or None
        Of its format; None if it is not a log.
    sign : {"charge", "discharge"}, optional
        What a positive current in the file does, as the user states it.
    used : tuple of str
        Columns that the caller reads besides those of a log.
    """

    content: FileContent
    reader: _Reader | None
    sign: Sign | None = None
    used: tuple[str, ...] = ()

    @property
    def is_any_table(self) -> bool:
        """Whether the file is a table of plain headings, not of a format that defines them."""
        return self.reader is table.read_table

    def read(
        self,
        *,
        temperature_c: float | None = None,
        temperature_source: TemperatureSource | None = None,
    ) -> Log:
        """Read the log; see `read_log`."""
        if self.reader is None:
            raise not_recognised(self, "not a known kind of log", f"known are: {KNOWN_LOGS}")
        if self.sign is not None and self.sign not in {"charge", "discharge"}:
            raise InputError(
                "not a sign",
                field="--sign",
                value=self.sign,
                cure="say what a positive current does: charge or discharge",
            )
        if temperature_source is not None:
            known_temperature_source(temperature_source)
        if temperature_c is not None and not COLDEST_C <= temperature_c <= HOTTEST_C:
            raise InputError(
                f"must lie within {COLDEST_C:g} … {HOTTEST_C:g} °C",
                field="--temperature",
                value=temperature_c,
            )
        draft = self.reader(self.content)
        if self.sign is not None:
            draft.state_sign(self.sign)
        log = Log(**draft.checked(temperature_c, self.used))
        if temperature_source is not None:
            log = replace(log, temperature_source=temperature_source)
        is_stated = self.sign is not None
        log = resolve_sign(log, stored_sign_unknown=draft.sign_unknown, is_stated=is_stated)
        arrow.free_unused()
        return log


def not_recognised(file: LogFile, problem: str, cure: str) -> InputError:
    """Return the error for a file of unknown format: its columns if it is a table."""
    foreign = foreign_format(file.content.magic)
    if foreign is not None:
        return InputError(
            f"{problem}: it is {foreign[0]}", source=file.content.path, cure=foreign[1]
        )
    headings, choice = table.likely_table(file.content, None)
    if len(headings) >= 3 and not table.is_of_frames(headings):
        return InputError(
            f"{problem}: no plain heading of {missing_quantities(choice)}"
            f" (found: {shown_headings(headings)})",
            source=file.content.path,
            cure=f"name the columns, e.g. {suggestion(headings, choice)}"
            f" (see {table_columns.DOCS})",
        )
    shown = file.content.first_line.strip()
    is_text = bool(shown) and shown.isprintable()
    return InputError(
        problem,
        source=file.content.path,
        field="first line" if is_text else None,
        value=shown[:80] if is_text else None,
        cure=f"{cure}; other tables: --columns ({table_columns.DOCS})",
    )


def open_log(
    path: str | PathLike[str],
    *,
    columns: ColumnMap | Mapping[str, Any] | str | None = None,
    sign: Sign | None = None,
) -> LogFile:
    """Read the beginning of a file and find its format.

    Parameters
    ----------
    path : path-like
    columns : ColumnMap, mapping or str, optional
        Columns of a table; its format is then not looked for.
    sign : {"charge", "discharge"}, optional
        What a positive current in the file does.

    Raises
    ------
    InputError
        If the file is absent, empty, damaged or not a regular file.
    """
    content = FileContent(path)
    if columns is not None:
        given = ColumnMap.of(columns)
        read_any = _reader_by_columns(content)
        return LogFile(content, lambda file: read_any(file, given), sign)
    if content.is_parquet:
        return LogFile(content, canonical.read_parquet, sign)
    # With CAN frames they are captures.
    if content.is_mf4:
        is_capture = measurement.has_mf4_frames(content.path)
        return LogFile(content, None if is_capture else measurement.read_mf4, sign)
    if content.is_mcap:
        is_capture = measurement.has_mcap_frames(content.path)
        return LogFile(content, None if is_capture else measurement.read_mcap, sign)
    readers = (reader for matches, reader in _TEXT_FORMATS if matches(content))
    return LogFile(content, next(readers, None) if content.first_line else None, sign)


def _reader_by_columns(content: FileContent) -> Callable[[FileContent, ColumnMap], DraftLog]:
    if content.is_parquet:
        return canonical.read_any_parquet
    if content.is_mf4:
        return measurement.read_mf4
    return measurement.read_mcap if content.is_mcap else table.read_table


def read_log(
    path: str | PathLike[str],
    *,
    temperature_c: float | None = None,
    temperature_source: TemperatureSource | None = None,
    columns: ColumnMap | Mapping[str, Any] | str | None = None,
    sign: Sign | None = None,
) -> Log:
    """Read a log of any known format, plain, gzipped or in a zip.

    `Log.remarks` lists what was dropped, converted or assumed.

    Parameters
    ----------
    path : path-like
    temperature_c : float, optional
        Constant temperature [°C], in place of the file's.
    temperature_source : {"cell", "pack", "coolant", "room", "unknown"}, optional
        Location of the temperature sensor, in place of the file's own.
    columns : mapping or str, optional
        Columns of a table: "time=t,current=I[mA]:-1", or {"current": "I[mA]"}; `ColumnMap.of`.
    sign : {"charge", "discharge"}, optional
        What a positive current in the file does; by default as the format defines it, or found
        from the data.

    Returns
    -------
    Log
        Positive current discharges.

    Raises
    ------
    InputError
        File absent, empty, damaged or of no known format; missing column; wrong unit; time that
        runs backwards; missing values where no rule drops them.
    """
    file = open_log(path, columns=columns, sign=sign)
    return file.read(temperature_c=temperature_c, temperature_source=temperature_source)


def as_log(log: Any) -> Log:
    """Return a log for a `Log`, a path, or a data frame (`Log.from_dataframe`)."""
    if isinstance(log, Log):
        return log
    if isinstance(log, str | PathLike):
        return read_log(log)
    return Log.from_dataframe(log)


_INDEX: Final = "__index_level_"
"""Beginning of the column name of an unnamed pandas index."""


def _with_time_index(frame: Any) -> Any:
    """Return the table with an unnamed index of times as its column `time`."""
    names = frame.column_names
    kinds = {each.name: str(each.type) for each in frame.schema}
    times = [name for name in names if name.startswith(_INDEX) and "timestamp" in kinds[name]]
    if len(times) != 1 or "time" in names or "time_s" in {name.lower() for name in names}:
        return frame
    return frame.rename_columns(["time" if name == times[0] else name for name in names])


def log_of_arrow(
    frame: Any,
    *,
    name: str,
    temperature_c: float | None,
    temperature_source: TemperatureSource | None,
    columns: ColumnMap | Mapping[str, Any] | str | None = None,
    sign: Sign | None = None,
) -> Log:
    """Return the log of an Arrow table; see `Log.from_dataframe`."""
    frame = _with_time_index(frame)
    names = [each for each in frame.column_names if not each.startswith(_INDEX)]
    frame = frame.select(names)
    if columns is None and arrow.is_canonical(names):
        places = arrow.find_fields(names, name)
        arrow.check_types(frame.schema, places, name)
        draft = arrow.draft_from_table(frame, places, names, name=name, source="")
    else:
        given = None if columns is None else ColumnMap.of(columns)
        draft = table_columns.draft_of_arrow(frame, given, name=name, source="")
    if temperature_source is not None:
        draft.temperature_source = known_temperature_source(temperature_source)
    if sign is not None:
        draft.state_sign(sign)
    log = Log(**draft.checked(temperature_c))
    if columns is None and sign is None and not draft.sign_unknown:
        return log
    return resolve_sign(log, stored_sign_unknown=draft.sign_unknown, is_stated=sign is not None)
