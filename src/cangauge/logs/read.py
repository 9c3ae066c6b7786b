"""`read_log`: any log file that cangauge knows → canonical log, by content, not by suffix."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path

from cangauge.errors import InputError
from cangauge.logs import canonical
from cangauge.logs import formats as bmw_i3
from cangauge.logs import formats as cycler
from cangauge.logs import formats as d3
from cangauge.logs.draft import DraftLog
from cangauge.logs.file_content import FileContent, cells, delimiter_of, read_file_content
from cangauge.logs.log import TEMPERATURE_SOURCES, Log, TemperatureSource
from cangauge.logs.sign import resolve_sign
from cangauge.logs.units import COLDEST_C, HOTTEST_C

_KNOWN = (
    "known are: canonical Parquet and CSV (time_s, current_a, voltage_v, temperature_c, soc_pct),"
    " ANL D3 tests, BMW i3 trips, Arbin, Bitrode and VisuaLCN exports; and, with --vehicle or"
    " --dbc and --map, CAN captures: candump, CRTD, ASC, BLF, TRC, MF4, CSV"
)
_NEITHER = "not a known kind of log, nor of capture"


class CaptureGivenError(InputError):
    """A CAN capture was given where a log is read: it needs a vehicle to become one."""


def read_log(
    path: str | PathLike[str],
    *,
    temperature_source: TemperatureSource | None = None,
    temperature_c: float | None = None,
) -> Log:
    """Read a log of any known format, plain, gzipped or in a zip.

    Nothing is repaired silently: `Log.remarks` tells what was dropped, converted or assumed.

    Parameters
    ----------
    path : path-like
    temperature_source : {"cell", "pack", "coolant", "room", "unknown"}, optional
        What the temperature was measured on, where the file does not say it or is wrong.
    temperature_c : float, optional
        Constant temperature [°C], for a file that holds none.

    Returns
    -------
    Log
        Positive current discharges.

    Raises
    ------
    InputError
        File absent, empty, damaged or of no known format; missing column; wrong unit; time that
        runs backwards; missing values where no rule drops them.
    CaptureGivenError
        A CAN capture (an InputError too).
    """
    if temperature_source is not None and temperature_source not in TEMPERATURE_SOURCES:
        raise InputError(
            "not a known temperature source",
            field="temperature_source",
            value=temperature_source,
            cure=f"use one of: {', '.join(TEMPERATURE_SOURCES)}",
        )
    if _is_recording_in_parts(Path(path)):
        raise _capture_given(Path(path))
    if temperature_c is not None and not COLDEST_C <= temperature_c <= HOTTEST_C:
        raise InputError(
            f"must lie within {COLDEST_C:g} … {HOTTEST_C:g} °C",
            field="--temperature",
            value=temperature_c,
        )
    content = read_file_content(path)
    draft = _read(content)
    log = draft.to_log(temperature_c)
    if temperature_source is not None:
        log = replace(log, temperature_source=temperature_source)
    return resolve_sign(log, stored_sign_unknown=draft.sign_unknown)


def _read(content: FileContent) -> DraftLog:
    if content.is_parquet:
        return canonical.read_parquet(content)
    line = next((text for text in content.head if text.strip()), "")
    if bmw_i3.is_bmw_i3_header(line):
        return bmw_i3.read_bmw_i3(content)
    if d3.is_d3_header(line):
        return d3.read_d3(content)
    if canonical.is_canonical_header(cells(line, delimiter_of(line) or ",")):
        return canonical.read_csv(content)
    layout = cycler.find_layout(content) if line else None
    if layout is not None:
        return cycler.read_cycler(content, layout)
    raise _unknown(content, line)


def _unknown(content: FileContent, line: str) -> InputError:
    if _is_capture(content.path):
        return _capture_given(content.path)
    shown = line.strip()
    if not shown or not shown.isprintable():
        return InputError(_NEITHER, source=content.path, cure=_KNOWN)
    return InputError(
        _NEITHER,
        source=content.path,
        field="first line",
        value=shown[:80],
        cure=_KNOWN,
    )


def _capture_given(path: Path) -> CaptureGivenError:
    return CaptureGivenError(
        "this is a CAN capture, not a log",
        source=path,
        cure="give --vehicle, or --dbc and --map",
    )


def _is_recording_in_parts(path: Path) -> bool:
    try:
        if path.exists():
            return False
    except OSError:  # a name that is too long
        return False
    # Imported here: as below.
    from cangauge.bus.captures.files import parts_of_run  # noqa: PLC0415

    return bool(parts_of_run(path)) and _is_capture(path)


def _is_capture(path: Path) -> bool:
    # Imported here: python-can is slow to import, and only an unknown file needs it.
    from cangauge.bus.captures.capture import is_capture  # noqa: PLC0415

    return is_capture(path)
