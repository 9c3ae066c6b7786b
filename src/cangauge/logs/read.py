"""Read a log of any known format, recognised by content, not by suffix."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from os import PathLike
from typing import Final

from cangauge.errors import InputError
from cangauge.logs import canonical, formats
from cangauge.logs.draft import DraftLog
from cangauge.logs.file_content import FileContent
from cangauge.logs.log import Log, TemperatureSource
from cangauge.logs.sign import resolve_sign
from cangauge.logs.units import COLDEST_C, HOTTEST_C, known_temperature_source

KNOWN_LOGS: Final = (
    "canonical Parquet and CSV (time_s, current_a, voltage_v, temperature_c, soc_pct), ANL D3"
    " tests, BMW i3 trips, Arbin, Bitrode and VisuaLCN exports, Battery Data Format"
)

_Reader = Callable[[FileContent], DraftLog]
_TEXT_FORMATS: Final[tuple[tuple[Callable[[FileContent], bool], _Reader], ...]] = (
    (formats.is_bmw_i3, formats.read_bmw_i3),
    (formats.is_d3, formats.read_d3),
    # Before the canonical log, whose names battery-data-standard partly shares.
    (formats.is_cycler, formats.read_cycler),
    (canonical.is_canonical_csv, canonical.read_csv),
)


@dataclass(frozen=True, slots=True)
class LogFile:
    """A file that may be a log, recognised by its beginning.

    Parameters
    ----------
    content : FileContent
    reader : callable or None
        Of its format; None if it is not a log.
    """

    content: FileContent
    reader: _Reader | None

    def read(
        self,
        *,
        temperature_c: float | None = None,
        temperature_source: TemperatureSource | None = None,
    ) -> Log:
        """Read the log; see `read_log`."""
        if self.reader is None:
            raise not_recognised(self, "not a known kind of log", f"known are: {KNOWN_LOGS}")
        if temperature_source is not None:
            known_temperature_source(temperature_source)
        if temperature_c is not None and not COLDEST_C <= temperature_c <= HOTTEST_C:
            raise InputError(
                f"must lie within {COLDEST_C:g} … {HOTTEST_C:g} °C",
                field="--temperature",
                value=temperature_c,
            )
        draft = self.reader(self.content)
        log = Log(**draft.checked(temperature_c))
        if temperature_source is not None:
            log = replace(log, temperature_source=temperature_source)
        return resolve_sign(log, stored_sign_unknown=draft.sign_unknown)


def not_recognised(file: LogFile, problem: str, cure: str) -> InputError:
    """Return the error for a file of unknown format; it quotes the first line of a text."""
    shown = file.content.first_line.strip()
    is_text = bool(shown) and shown.isprintable()
    return InputError(
        problem,
        source=file.content.path,
        field="first line" if is_text else None,
        value=shown[:80] if is_text else None,
        cure=cure,
    )


def open_log(path: str | PathLike[str]) -> LogFile:
    """Read the beginning of a file and find its format.

    Raises
    ------
    InputError
        If the file is absent, empty, damaged or not a regular file.
    """
    content = FileContent(path)
    if content.is_parquet:
        return LogFile(content, canonical.read_parquet)
    readers = (reader for matches, reader in _TEXT_FORMATS if matches(content))
    return LogFile(content, next(readers, None) if content.first_line else None)


def read_log(
    path: str | PathLike[str],
    *,
    temperature_c: float | None = None,
    temperature_source: TemperatureSource | None = None,
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
    return open_log(path).read(temperature_c=temperature_c, temperature_source=temperature_source)
