"""Options, reading and input checks shared by the commands that take a log or a capture."""

from __future__ import annotations

from collections.abc import Iterable, Sized
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from cangauge._io import check_writable
from cangauge.cli.output import note
from cangauge.errors import InputError
from cangauge.logs import units
from cangauge.logs.log import Log
from cangauge.logs.units import TEMPERATURE_SOURCES, TemperatureSource

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


def load_log(
    path: Path,
    *,
    vehicle: str | None = None,
    dbc: Path | None = None,
    map_file: Path | None = None,
    temperature_c: float | None = None,
    temperature_source: str | None = None,
    refuse_inverted: bool = False,
) -> Log:
    """Read a log, or decode a capture by its vehicle; print the reader's remarks on stderr.

    Parameters
    ----------
    path : Path
    vehicle : str, optional
        Preset of the car (captures only).
    dbc, map_file : Path, optional
        DBC and map of signals, in place of a preset (captures only).
    temperature_c : float, optional
        Constant temperature [°C].
    temperature_source : str, optional
        Location of the temperature sensor.
    refuse_inverted : bool
        Refuse a single row, and a log whose data show clearly that positive current charges.

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
    # Deferred: the service shares these options, but needs neither pyarrow nor the readers.
    from cangauge.bus.recording import log_of, open_recording  # noqa: PLC0415
    from cangauge.bus.vehicle import Vehicle  # noqa: PLC0415
    from cangauge.logs.read import LogFile  # noqa: PLC0415

    source = known_temperature_source(temperature_source)
    recording = open_recording(path)
    is_capture = not isinstance(recording, LogFile)
    car = None
    if vehicle is not None or dbc is not None or map_file is not None:
        if is_capture:
            car = Vehicle.load(vehicle, dbc, map_file, temperature_c=temperature_c)
        else:
            note(f"{path}: a log, not a capture: --vehicle, --dbc and --map do not apply to it")
    log = log_of(recording, car, temperature_c=temperature_c, temperature_source=source)
    if refuse_inverted:
        refuse_single_row(log)
        refuse_inverted_current(log, is_capture=is_capture)
    for remark in log.remarks:
        note(f"{log.source or log.name}: {remark}")
    return log


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
