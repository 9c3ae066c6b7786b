"""What several commands share: options of recordings and of the bus, reading, checks of files."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from cangauge._extras import require_extra
from cangauge._files import check_writable, require_suffix, written_name
from cangauge.cli.output import remark
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.bus.captures import Capture
    from cangauge.bus.vehicle import Vehicle
    from cangauge.logs.column_map import ColumnMap
    from cangauge.logs.log import Log
    from cangauge.logs.read import CellColumns, LogFile

# The service shares these options, but needs neither pyarrow nor the readers: imports are deferred.

RECOGNISED_BY = 50_000
"""Frames by which the preset of a capture is looked for: half a minute of a busy bus."""
ALARM = 0.05
"""`cangauge.diagnosis.ALARM`: a help page imports nothing that computes."""


# --- Declaration of arguments and options, as typer reads them


def argument(metavar: str, text: str) -> Any:
    """Return an argument, with the placeholder of its value and its help."""
    return typer.Argument(metavar=metavar, help=text, show_default=False)


def option(
    flags: str,
    metavar: str,
    text: str,
    *,
    within: tuple[float, float] | None = None,
    unit: str = "",
    word: str | None = None,
    suffixes: Sequence[str] = (),
    needs: str | None = None,
) -> Any:
    """Return an option.

    Parameters
    ----------
    flags : str
        Such as "-m, --model".
    metavar : str
        Placeholder of the value.
    text : str
        Help.
    within : tuple of float, optional
        Least and largest number, both allowed; with their `unit`.
    word : str, optional
        May stand in place of a number. The annotation is then `Any`: a float or the word.
    suffixes : sequence of str
        One of which a file to write must have.
    needs : str, optional
        Extra of the package without which the file cannot be written.
    """

    def checked(parameter: typer.CallbackParam, value: Any) -> Any:
        field = parameter.opts[-1]
        if isinstance(value, list):
            return [checked(parameter, each) for each in value]
        if value in {None, word}:
            return value
        if suffixes:
            require_suffix(value, *suffixes, field=field)
            if needs is not None:
                require_extra(needs, field)
            return value
        number = value if isinstance(value, int | float) else _number(value, field, word, unit)
        if within is not None and not within[0] <= number <= within[1]:  # NaN too
            raise InputError(
                f"must lie within {within[0]:g} … {within[1]:g} {unit}".rstrip(),
                field=field,
                value=number,
            )
        return number

    if within is not None:
        bounds = " … ".join(f"{bound:.10g}" for bound in within)
        text = f"{text} (within {f'{bounds} {unit}'.rstrip()})"
    more: dict[str, Any] = {"callback": checked} if within or suffixes else {}
    if word:
        more["parser"] = str
    return typer.Option(*flags.split(", "), metavar=metavar or None, help=text, **more)


def _number(text: str, field: str, word: str | None, unit: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(
            f"neither a number nor {word}",
            field=field,
            value=text,
            cure=f"give a number{f' of {unit}' if unit else ''}, or {word}",
        ) from error


MODEL: Final = option("-m, --model", "MODEL", "Model file of `cangauge fit`.")
CHEMISTRY: Final = option(
    "--chemistry", "oxide|lfp", "Chemistry of the cells. Only without a model."
)
CELLS: Final = option(
    "--cells", "N", "Number of cells in series. Only without a model.", within=(1, 2000)
)
CapacityAh = Annotated[
    float | None,
    option(
        "--capacity-ah",
        "A",
        "Charge from 100 to 0 %. Default: the capacity of the model, if there is one.",
        within=(1e-3, 1e5),
        unit="Ah",
    ),
]
Report = Annotated[
    Path | None,
    option(
        "--report",
        "FILE.html|.htm",
        "Write a report as one self-contained page.",
        suffixes=(".html", ".htm"),
        needs="report",
    ),
]
Json = Annotated[
    bool,
    option("--json", "", "Print exactly one JSON object on stdout, even if the command fails."),
]


def command(
    *omitted: str, keys: Iterable[inspect.Parameter] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return the decorator of a command with options that several commands share.

    A parameter that is a dataclass stands for its fields, and `**options` for keys of the
    configuration.

    Parameters
    ----------
    *omitted : str
        Fields that are no options of this command, but keep their defaults.
    keys : iterable of inspect.Parameter
        The parameters that `**options` stands for.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        groups: dict[str, tuple[type, list[str]]] = {}
        made: list[inspect.Parameter] = []
        for parameter in inspect.signature(function, eval_str=True).parameters.values():
            kind = parameter.annotation
            if parameter.kind is parameter.VAR_KEYWORD:
                made += keys
            elif isinstance(kind, type) and is_dataclass(kind):
                fields = inspect.signature(kind, eval_str=True).parameters.values()
                shared = [field for field in fields if field.name not in omitted]
                groups[parameter.name] = kind, [field.name for field in shared]
                made += [field.replace(kind=field.KEYWORD_ONLY) for field in shared]
            else:
                made.append(parameter)

        def run(**given: Any) -> None:
            for name, (kind, names) in groups.items():
                given[name] = kind(**{each: given.pop(each) for each in names})
            function(**given)

        run.__doc__ = function.__doc__
        run.__signature__ = inspect.Signature(made)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in made}
        return run

    return decorate


@dataclass(frozen=True, slots=True)
class ReadingOptions:
    """The options of every command that reads a log or a capture."""

    vehicle: Annotated[
        str | None,
        option(
            "--vehicle",
            "PRESET",
            "For a capture: preset of the car (DBC and map that ship with cangauge).",
        ),
    ] = None
    dbc: Annotated[
        Path | None,
        option("--dbc", "FILE", "For a capture: DBC of the bus, if the map does not name one."),
    ] = None
    map_file: Annotated[
        Path | None,
        option(
            "--map",
            "FILE",
            "For a capture: map file. It names the signals of current, voltage and temperature,"
            " and their DBC.",
        ),
    ] = None
    columns: Annotated[
        str | None,
        option(
            "--columns",
            "NAME=HEADING,…",
            "For a table with other headings: columns of time, current, voltage, temperature and"
            " soc, each as NAME=HEADING[UNIT]:FACTOR. Unit and factor may be left out if the"
            " heading states them. Examples: 'current=I_batt[mA]:-1' (in mA, discharge negative);"
            " 'time=Date+Time' (joins two columns); 'temperature=T1+T2' (median); '#3' (third"
            " column). See docs/logs.md.",
        ),
    ] = None
    sign: Annotated[
        Literal["charge", "discharge"] | None,
        option(
            "--sign",
            "charge|discharge",
            "Whether positive current in the file charges or discharges the pack. Default:"
            " defined by the format, or found from the data.",
        ),
    ] = None
    temperature: Annotated[
        float | None,
        option("--temperature", "C", "Constant temperature [°C], if the input has none."),
    ] = None

    @property
    def names_vehicle(self) -> bool:
        """Whether an option for captures is given."""
        return (self.vehicle, self.dbc, self.map_file) != (None, None, None)

    def car(self) -> Vehicle:
        """Return the vehicle that decodes a capture; may raise InputError."""
        from cangauge.bus.vehicle import Vehicle

        return Vehicle.load(self.vehicle, self.dbc, self.map_file, temperature_c=self.temperature)

    def mapped_columns(self) -> ColumnMap | None:
        """Return the columns of the map file; may raise InputError."""
        from cangauge.bus.mapping import columns_of_map

        return None if self.map_file is None else columns_of_map(self.map_file)

    def open(self, path: Path) -> LogFile | Capture:
        """Open a log by these columns, or any recording by its content; may raise InputError."""
        from cangauge.bus.recording import open_recording
        from cangauge.logs.column_map import ColumnMap

        columns = None if self.columns is None else ColumnMap.of(self.columns, "--columns")
        return open_recording(path, columns=columns, mapped=self.mapped_columns(), sign=self.sign)

    def note_log(self, path: Path) -> None:
        """Print on stderr that options for captures do not apply to a log."""
        if self.names_vehicle and self.mapped_columns() is None:
            remark(f"{path}: a log, not a capture: --vehicle, --dbc and --map do not apply to it")

    def load(self, path: Path, used: Sequence[str] = ()) -> Log:
        """Read a log, or decode a capture; print the reader's remarks on stderr.

        `used` are columns that the command reads besides. Raises InputError if the input cannot be
        read or has a single row, or if the data show clearly that positive current charges and
        `sign` does not state it.
        """
        from cangauge.bus.recording import log_of, refuse_single_row
        from cangauge.logs.read import LogFile
        from cangauge.logs.sign import require_discharge_positive

        recording = self.open(path)
        car = None
        if isinstance(recording, LogFile):
            self.note_log(path)
            recording = replace(recording, read_besides=tuple(used))
        else:
            car = self.car_of(path)
        log = log_of(recording, car, temperature_c=self.temperature)
        refuse_single_row(log)
        if self.sign is None:
            require_discharge_positive(log, is_capture=car is not None)
        note_reading(log)
        return log

    def load_all(
        self, paths: Iterable[Path], show: Callable[[str], None], used: Sequence[str] = ()
    ) -> list[Log]:
        """Read logs as `load` does; `show` is called with a line of progress for each."""
        logs = []
        for path in paths:
            show(f"reading {path}")
            logs.append(self.load(path, used))
        return logs

    def cells_of(self, log: Log) -> CellColumns | None:
        """Return the cell voltages beside a log in its file; None for a capture or without any."""
        from cangauge.logs.read import LogFile

        recording = self.open(Path(log.source))
        return recording.cells(log.time_s) if isinstance(recording, LogFile) else None

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


def note_reading(log: Log) -> None:
    """Print on stderr what was assumed of a log's columns, in one line, and the remarks."""
    assumed = [f"read as {', '.join(log.assumed)}"] if log.assumed else []
    for text in (*assumed, *log.remarks):
        remark(f"{log.source or log.name}: {text}")


def note_starts(logs: Iterable[Log], initial_soc_pct: float, capacity_ah: float | None) -> None:
    """Print on stderr where a given SoC at the first row is doubtful: off the log's, a fraction.

    `capacity_ah` counts a first SoC that comes later back to the first row [Ah]; None: it is taken
    as that of the first row.
    """
    from cangauge.model.coulomb_counting import DIFFERENT_PCT, soc_at_first_row

    for log in logs:
        doubts = []
        own_pct = soc_at_first_row(log, capacity_ah or math.inf)
        if own_pct is not None and abs(own_pct - initial_soc_pct) >= DIFFERENT_PCT:
            doubts.append(f"its own SoC is {own_pct:.1f} %")
        if 0.0 < initial_soc_pct <= 1.0:
            doubts.append(f"a fraction is given in percent, as {100.0 * initial_soc_pct:g}")
        if doubts:
            remark(
                f"warning: {log.name}: the initial SoC is {initial_soc_pct:g} % as given;"
                f" {', and '.join(doubts)}"
            )


def assumed_of(logs: Iterable[Log]) -> dict[str, list[str]]:
    """Return what was assumed of the logs' columns, by file, for JSON."""
    return {log.source or log.name: list(log.assumed) for log in logs if log.assumed}


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path]) -> None:
    """Refuse, before any long work, outputs that cannot be written or would overwrite input.

    None stands for an output that is not wanted.
    """
    read = {Path(os.path.realpath(path)) for path in inputs}
    written: set[Path] = set()
    for output in filter(None, outputs):
        place = written_name(output)
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


# --- Options of the commands on a bus, made from the keys of `RunConfig`


def config_parameters(*names: str) -> list[inspect.Parameter]:
    """Return the options of keys, such as "channel", as typer reads them; without names of all."""
    from cangauge.service.config import config_keys, default_of

    made = []
    for name, key in config_keys().items():
        if "option" not in key or (names and name not in names):
            continue
        # Texts, which the configuration checks: a number may be the word auto.
        kind: Any = list[str] if name == "bus_options" else str
        first, dot, more = key["description"].partition(". ")
        unit = f" [{key['unit']}]" if "unit" in key else ""
        text = f"{first.removesuffix('.')}{unit}.{dot[1:]}{more}"
        if default := default_of(key):
            text += f" Default: {default}."
        option = typer.Option(*key["option"].split(", "), metavar=key["metavar"], help=text)
        made.append(
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation=Annotated[kind | None, option],
            )
        )
    return made


def config_values(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return given options as keys of a configuration; InputError if a bus option is wrong."""
    from cangauge.bus.open import parse_bus_options

    return {**options, "bus_options": parse_bus_options(options["bus_options"] or [])}
