"""Options, reading and input checks shared by the commands that take a log or a capture."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sized
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar, cast

import typer

from cangauge._io import check_writable
from cangauge.cli.output import note
from cangauge.errors import InputError
from cangauge.logs import units
from cangauge.logs.log import Log
from cangauge.logs.units import TEMPERATURE_SOURCES, TemperatureSource

if TYPE_CHECKING:
    from cangauge.bus.captures.capture import Capture
    from cangauge.logs.read import LogFile

_Value = TypeVar("_Value", bound=float | None)

VehicleOption = Annotated[
    str | None,
    typer.Option(
        "--vehicle",
        metavar="PRESET",
        help="For a capture: the car's preset (a DBC and a map that ship with cangauge).",
    ),
]
DbcOption = Annotated[
    Path | None,
    typer.Option("--dbc", metavar="FILE", help="For a capture: the bus's DBC; needs --map."),
]
MapOption = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="FILE",
        help="For a capture: which signals of the DBC are current, voltage and temperature.",
    ),
]
TemperatureOption = Annotated[
    float | None,
    typer.Option(
        "--temperature", metavar="C", help="Constant temperature [°C], where the input has none."
    ),
]
TemperatureSourceOption = Annotated[
    str | None,
    typer.Option(
        "--temperature-source",
        metavar="SOURCE",
        help="Location of the temperature sensor, where the input does not state it: "
        f"{', '.join(TEMPERATURE_SOURCES)}.",
    ),
]
ColumnsOption = Annotated[
    str | None,
    typer.Option(
        "--columns",
        metavar="NAME=HEADING,…",
        help="For a table of other headings: time, current, voltage, temperature, soc, each"
        " NAME=HEADING[UNIT]:FACTOR; unit and factor only where the heading leaves them open."
        " 'current=I_batt[mA]:-1' (mA, discharge negative); 'time=Date+Time' joins two columns;"
        " 'temperature=T1+T2' averages; '#3' is the third column. See docs/logs.md.",
    ),
]
SignOption = Annotated[
    str | None,
    typer.Option(
        "--sign",
        metavar="charge|discharge",
        help="What a positive current in the file does. Default: as its format defines it, else"
        " found from the data.",
    ),
]
EndpointOption = Annotated[
    str | None,
    typer.Option(
        "--endpoint",
        metavar="PATH|URL",
        help="Unix socket of the service, or http://HOST:PORT. Default: the service running on this"
        " machine.",
    ),
]
TokenFileOption = Annotated[
    Path | None,
    typer.Option(
        "--token-file",
        metavar="FILE",
        help="File with the bearer token of an HTTP endpoint; or in CANGAUGE_HTTP_TOKEN.",
    ),
]
JsonOption = Annotated[
    bool,
    typer.Option("--json", help="Print exactly one JSON object on stdout, also for an error."),
]
ReportOption = Annotated[
    Path | None,
    typer.Option(
        "--report", metavar="FILE.html", help="Write a report as one self-contained page."
    ),
]


def _drawable(folder: Path | None) -> Path | None:
    """Refuse `--figures` before any long work if nothing could draw them."""
    if folder is None:
        return None
    if find_spec("matplotlib") is None:
        raise InputError(
            "figures are drawn by matplotlib, which is not installed",
            field="--figures",
            value=str(folder),
            cure="pip install 'cangauge[figures]'",
        )
    if not os.path.isdir(folder):  # noqa: PTH112 - False, not an error, for a name too long
        if os.path.exists(folder):  # noqa: PTH110 - likewise
            raise InputError(
                "is a file", field="--figures", value=str(folder), cure="name a folder"
            )
        check_writable(folder)
    return folder


FiguresOption = Annotated[
    Path | None,
    typer.Option(
        "--figures",
        metavar="DIR",
        callback=_drawable,
        help="Write each figure of the report as PNG and SVG (extra `figures`).",
    ),
]


@dataclass(frozen=True, slots=True)
class TableOptions:
    """Options on the columns of a log: `--columns`, `--sign`, and `[columns]` of a map file.

    Parameters
    ----------
    columns : str, optional
    sign : str, optional
    map_file : Path, optional
        Its `[columns]` apply to a log unless `columns` is given.
    """

    columns: str | None = None
    sign: str | None = None
    map_file: Path | None = None

    @property
    def are_given(self) -> bool:
        """Whether the user states columns: the file is then a table, not a capture."""
        return self.columns is not None

    def open(self, path: Path) -> LogFile | Capture:
        """Open a log by these columns, or any recording by its content.

        Raises
        ------
        InputError
            If the file cannot be read, or an option is wrong.
        """
        # Deferred: the service shares these options, but needs neither pyarrow nor the readers.
        from cangauge.bus.mapping import columns_of_map  # noqa: PLC0415
        from cangauge.bus.recording import open_with_columns  # noqa: PLC0415
        from cangauge.logs.column_map import ColumnMap  # noqa: PLC0415

        return open_with_columns(
            path,
            columns=None if self.columns is None else ColumnMap.of(self.columns, "--columns"),
            mapped=None if self.map_file is None else columns_of_map(self.map_file),
            sign=cast("Literal['charge', 'discharge'] | None", self.sign),
        )


def load_log(
    path: Path,
    *,
    vehicle: str | None = None,
    dbc: Path | None = None,
    map_file: Path | None = None,
    temperature_c: float | None = None,
    temperature_source: str | None = None,
    columns: str | None = None,
    sign: str | None = None,
    refuse_inverted: bool = False,
) -> Log:
    """Read a log, or decode a capture by its vehicle; print the reader's remarks on stderr.

    Parameters
    ----------
    path : Path
    vehicle : str, optional
        Preset of the car (captures only).
    dbc, map_file : Path, optional
        DBC and map of signals, in place of a preset (captures only); `[columns]` of the map apply
        to a log.
    temperature_c : float, optional
        Constant temperature [°C].
    temperature_source : str, optional
        Location of the temperature sensor.
    columns, sign : str, optional
        Values of `--columns` and `--sign`.
    refuse_inverted : bool
        Refuse a single row, and a log whose data show clearly that positive current charges, unless
        `sign` states it.

    Returns
    -------
    Log
        Positive current discharges, where the format defines the sign.

    Raises
    ------
    InputError
        If the input cannot be read, an option has an unknown value, or (with `refuse_inverted`)
        the sign of current is inverted.
    """
    # Deferred as in `TableOptions.open`.
    from cangauge.bus.mapping import columns_of_map  # noqa: PLC0415
    from cangauge.bus.recording import log_of  # noqa: PLC0415
    from cangauge.bus.vehicle import Vehicle  # noqa: PLC0415
    from cangauge.logs.read import LogFile  # noqa: PLC0415

    source = known_temperature_source(temperature_source)
    recording = TableOptions(columns, sign, map_file).open(path)
    is_capture = not isinstance(recording, LogFile)
    car = None
    if vehicle is not None or dbc is not None or map_file is not None:
        if is_capture:
            car = Vehicle.load(vehicle, dbc, map_file, temperature_c=temperature_c)
        elif map_file is None or columns_of_map(map_file) is None:
            note(f"{path}: a log, not a capture: --vehicle, --dbc and --map do not apply to it")
    if is_capture and sign is not None:
        raise InputError(
            "this is a capture, whose map states the sign",
            source=path,
            field="--sign",
            value=sign,
            cure="set sign = -1 under [current] of the map file",
        )
    log = log_of(recording, car, temperature_c=temperature_c, temperature_source=source)
    if refuse_inverted:
        refuse_single_row(log)
        if sign is None:
            refuse_inverted_current(log, is_capture=is_capture)
    note_reading(log)
    return log


def note_reading(log: Log) -> None:
    """Print on stderr what was assumed of a log's columns, in one line, and the remarks."""
    if log.assumed:
        note(f"{log.source or log.name}: read as {', '.join(log.assumed)}")
    for remark in log.remarks:
        note(f"{log.source or log.name}: {remark}")


def assumed_of(logs: Iterable[Log]) -> dict[str, list[str]]:
    """Return what was assumed of the logs' columns, by file, for JSON."""
    return {log.source or log.name: list(log.assumed) for log in logs if log.assumed}


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path]) -> None:
    """Refuse, before any long work, outputs that cannot be written or would overwrite input.

    Parameters
    ----------
    outputs, inputs : iterable of Path
        None stands for an output that is not wanted.

    Raises
    ------
    InputError
        If a folder is missing or not writable, an output is named twice, or is also an input.
    """
    read = {path.resolve() for path in inputs}
    written: set[Path] = set()
    for output in outputs:
        if output is None:
            continue
        place = output.resolve()
        if place in read:
            raise InputError(
                "this output is also an input", source=output, cure="name another file for it"
            )
        # /dev/null may be named twice.
        if place in written and (place.is_file() or not place.exists()):
            raise InputError(
                "two outputs have this name", source=output, cure="name two different files"
            )
        written.add(place)
        check_writable(output)


def within(value: _Value, low: float, high: float, *, option: str, unit: str) -> _Value:
    """Return `value` if it is None or within low … high; else (NaN too) raise InputError."""
    if value is not None and not low <= value <= high:
        raise InputError(
            f"must lie within {low:g} … {high:g} {unit}".rstrip(), field=option, value=value
        )
    return value


def refuse_single_row(recorded: Sized) -> None:
    """Raise InputError for a log of one row: no charge can be counted."""
    if len(recorded) < 2:
        raise InputError(
            "a single row: charge is counted from one row to the next",
            source=getattr(recorded, "source", None),
            cure="give a log of minutes or hours",
        )


def refuse_inverted_current(log: Log, *, is_capture: bool) -> None:
    """Raise InputError if the data show clearly that positive current charges."""
    # Deferred as in `load_log`.
    from cangauge.logs.sign import require_discharge_positive  # noqa: PLC0415

    try:
        require_discharge_positive(log)
    except InputError as error:
        if not is_capture:
            raise
        # Recorded frames are never changed: the map inverts the sign.
        cure = "use the preset of this car, or set sign = -1 under [current] of the map file"
        raise InputError(
            error.problem, source=error.source, field=error.field, cure=cure
        ) from error


def known_temperature_source(given: str | None) -> TemperatureSource | None:
    """Check the value of --temperature-source; raise InputError if it is not a known one."""
    if given is None:
        return None
    return units.known_temperature_source(given, field="--temperature-source")
