"""Options, reading and input checks shared by the commands that take a log or a capture."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_type_hints

import typer

from cangauge._files import check_writable, require_suffix
from cangauge.cli.output import note
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.bus.captures import Capture
    from cangauge.bus.vehicle import Vehicle
    from cangauge.logs.column_map import ColumnMap
    from cangauge.logs.draft import Sign
    from cangauge.logs.log import Log
    from cangauge.logs.read import LogFile

# The service shares these options, but needs neither pyarrow nor the readers: imports are deferred.

RECOGNISED_BY = 50_000
"""Frames by which the preset of a capture is looked for: half a minute of a busy bus."""
AUTO = "auto"
ALARM = 0.05
"""`cangauge.diagnosis.ALARM`: a help page imports nothing that computes."""
_Value = TypeVar("_Value", bound=float | None)


def suffixed(*suffixes: str) -> Callable[[typer.CallbackParam, Path | None], Path | None]:
    """Return the callback of an option for a file to write: it must have one of these suffixes."""

    def check(param: typer.CallbackParam, value: Path | None) -> Path | None:
        if value is not None:
            require_suffix(value, *suffixes, field=param.opts[-1])
        return value

    return check


ColumnsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME=HEADING,…",
        help="For a table of other headings: time, current, voltage, temperature, soc, each"
        " NAME=HEADING[UNIT]:FACTOR; unit and factor only where the heading leaves them open."
        " 'current=I_batt[mA]:-1' (mA, discharge negative); 'time=Date+Time' joins two columns;"
        " 'temperature=T1+T2' averages; '#3' is the third column. See docs/logs.md.",
    ),
]
JsonOption = Annotated[
    bool,
    typer.Option("--json", help="Print exactly one JSON object on stdout, also for an error."),
]
ModelOption = Annotated[
    Path, typer.Option("-m", "--model", metavar="MODEL", help="Model file of `cangauge fit`.")
]
CapacityOption = Annotated[
    float | None,
    typer.Option(
        "--capacity-ah", metavar="A", help="Charge from 100 to 0 % [Ah]. Default: the model's."
    ),
]
AlarmOption = Annotated[
    float,
    typer.Option(metavar="P", help="Report a fault where the probability of none is at most this."),
]
ReportOption = Annotated[
    Path | None,
    typer.Option(
        "--report",
        metavar="FILE.html",
        callback=suffixed(".html", ".htm"),
        help="Write a report as one self-contained page.",
    ),
]


@dataclass(frozen=True, slots=True)
class ReadingOptions:
    """The options of every command that reads a log or a capture."""

    vehicle: Annotated[
        str | None,
        typer.Option(
            metavar="PRESET",
            help="For a capture: the car's preset (a DBC and a map that ship with cangauge).",
        ),
    ] = None
    dbc: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="For a capture: the bus's DBC; needs --map."),
    ] = None
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map",
            metavar="FILE",
            help="For a capture: which signals of the DBC are current, voltage and temperature.",
        ),
    ] = None
    columns: ColumnsOption = None
    sign: Annotated[
        str | None,
        typer.Option(
            metavar="charge|discharge",
            help="What a positive current in the file does. Default: as its format defines it,"
            " else found from the data.",
        ),
    ] = None
    temperature: Annotated[
        float | None,
        typer.Option(metavar="C", help="Constant temperature [°C], where the input has none."),
    ] = None

    @property
    def names_vehicle(self) -> bool:
        """Whether an option for captures is given."""
        return (self.vehicle, self.dbc, self.map_file) != (None, None, None)

    def car(self) -> Vehicle:
        """Return the vehicle that decodes a capture; may raise InputError."""
        from cangauge.bus.vehicle import Vehicle

        return Vehicle.load(self.vehicle, self.dbc, self.map_file, temperature_c=self.temperature)

    def given_columns(self) -> ColumnMap | None:
        """Return the columns of `--columns`; may raise InputError."""
        from cangauge.logs.column_map import ColumnMap

        return None if self.columns is None else ColumnMap.of(self.columns, "--columns")

    def mapped_columns(self) -> ColumnMap | None:
        """Return the columns of the map file; may raise InputError."""
        from cangauge.bus.mapping import columns_of_map

        return None if self.map_file is None else columns_of_map(self.map_file)

    def open(self, path: Path) -> LogFile | Capture:
        """Open a log by these columns, or any recording by its content; may raise InputError."""
        from cangauge.bus.recording import open_recording

        return open_recording(
            path,
            columns=self.given_columns(),
            mapped=self.mapped_columns(),
            sign=cast("Sign | None", self.sign),
        )

    def load(self, path: Path, used: Sequence[str] = ()) -> Log:
        """Read a log, or decode a capture; print the reader's remarks on stderr.

        Parameters
        ----------
        path : Path
        used : sequence of str
            Columns of a log that the command reads besides.

        Returns
        -------
        Log
            Positive current discharges, where the format defines the sign.

        Raises
        ------
        InputError
            If the input cannot be read or has a single row, an option has an unknown value, or the
            data show clearly that positive current charges, unless `sign` states it.
        """
        from cangauge.bus.recording import log_of, refuse_single_row
        from cangauge.logs.read import LogFile
        from cangauge.logs.sign import require_discharge_positive

        recording, car = self.open(path), None
        if not isinstance(recording, LogFile):
            car = self.car_of(path)
        elif self.names_vehicle and self.mapped_columns() is None:
            note(f"{path}: a log, not a capture: --vehicle, --dbc and --map do not apply to it")
        if isinstance(recording, LogFile):
            recording = replace(recording, used=tuple(used))
        log = log_of(recording, car, temperature_c=self.temperature)
        refuse_single_row(log)
        if self.sign is None:
            require_discharge_positive(log, is_capture=car is not None)
        note_reading(log)
        return log

    def car_of(self, capture: Path) -> Vehicle:
        """Return the vehicle; without one, raise an InputError that names the preset to give."""
        from cangauge.bus.recording import capture_without_vehicle
        from cangauge.inspect.capture import inspect_capture

        if self.names_vehicle:
            return self.car()
        error = capture_without_vehicle(capture)
        matching = inspect_capture(capture, frames=RECOGNISED_BY).matching
        hint = f" (--vehicle {matching[0]} matches it)" if len(matching) == 1 else ""
        raise InputError(error.problem, source=capture, cure=f"{error.cure}{hint}")


def option_groups(*omitted: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Replace each parameter of a command that is a dataclass of options by those options.

    Parameters
    ----------
    *omitted : str
        Fields that are no options of this command, but keep their defaults.
    """

    def spread(command: Callable[..., None]) -> Callable[..., None]:
        groups: dict[str, tuple[type, list[str]]] = {}
        parameters: list[inspect.Parameter] = []
        for parameter in inspect.signature(command, eval_str=True).parameters.values():
            kind = parameter.annotation
            if not (isinstance(kind, type) and is_dataclass(kind)):
                parameters.append(parameter)
                continue
            hints = get_type_hints(kind, include_extras=True)
            offered = [each for each in fields(kind) if each.name not in omitted]
            groups[parameter.name] = kind, [each.name for each in offered]
            parameters += [
                parameter.replace(name=each.name, default=each.default, annotation=hints[each.name])
                for each in offered
            ]

        def run(**given: Any) -> None:
            for name, (kind, names) in groups.items():
                given[name] = kind(**{each: given.pop(each) for each in names})
            command(**given)

        return with_signature(run, command, parameters)

    return spread


def with_signature(
    run: Callable[..., None], command: Callable[..., None], parameters: list[inspect.Parameter]
) -> Callable[..., None]:
    """Give a function the help page of a command and the parameters that typer reads."""
    run.__doc__ = command.__doc__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def note_reading(log: Log) -> None:
    """Print on stderr what was assumed of a log's columns, in one line, and the remarks."""
    remarks = [f"read as {', '.join(log.assumed)}"] if log.assumed else []
    for remark in (*remarks, *log.remarks):
        note(f"{log.source or log.name}: {remark}")


def note_starts(logs: Iterable[Log], initial_soc_pct: float, capacity_ah: float | None) -> None:
    """Print on stderr why a given SoC at the first row of logs is doubtful."""
    from cangauge.model.coulomb_counting import doubt_of_start

    for log in logs:
        if (doubt := doubt_of_start(log, initial_soc_pct, capacity_ah)) is not None:
            note(f"warning: {doubt}")


def assumed_of(logs: Iterable[Log]) -> dict[str, list[str]]:
    """Return what was assumed of the logs' columns, by file, for JSON."""
    return {log.source or log.name: list(log.assumed) for log in logs if log.assumed}


def check_outputs(
    outputs: Iterable[Path | None], inputs: Iterable[Path], made: Path | None = None
) -> None:
    """Refuse, before any long work, outputs that cannot be written or would overwrite input.

    Parameters
    ----------
    outputs, inputs : iterable of Path
        None stands for an output that is not wanted.
    made : Path, optional
        A folder that the command makes, of outputs; made after the check.

    Raises
    ------
    InputError
        If a folder is missing or not writable, an output is named twice, or is also an input.
    """
    read = {path.resolve() for path in inputs}
    written: set[Path] = set()
    for output in filter(None, outputs):
        place, problem, cure = output.resolve(), "", "name two different files"
        if place in read:
            problem, cure = "this output is also an input", "name another file for it"
        # /dev/null may be named twice.
        elif place in written and (place.is_file() or not place.exists()):
            problem = "two outputs have this name"
        if problem:
            raise InputError(problem, source=output, cure=cure)
        written.add(place)
        if output.parent != made or made.is_dir():
            check_writable(output)


def within(value: _Value, low: float, high: float, *, option: str, unit: str = "") -> _Value:
    """Return `value` if it is None or within low … high; else (NaN too) raise InputError."""
    if value is not None and not low <= value <= high:
        raise InputError(
            f"must lie within {low:g} … {high:g} {unit}".rstrip(), field=option, value=value
        )
    return value


def number_unless(
    word: str, text: str, low: float, high: float, *, option: str, unit: str = ""
) -> float | None:
    """Return None for `word`, else the number that `text` states, within low … high.

    Raises
    ------
    InputError
        If it is neither the word nor such a number.
    """
    if text == word:
        return None
    try:
        value = float(text)
    except ValueError as error:
        cure = f"give a number{f' of {unit}' if unit else ''}, or {word}"
        raise InputError(
            f"neither a number nor {word}", field=option, value=text, cure=cure
        ) from error
    return within(value, low, high, option=option, unit=unit)
