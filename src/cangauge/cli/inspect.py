"""`cangauge inspect`: the contents of a log or capture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cangauge._extras import extra
from cangauge._files import write_texts_atomic
from cangauge.cli.options import (
    JsonOption,
    ReadingOptions,
    ReportOption,
    assumed_of,
    check_outputs,
    option_groups,
)
from cangauge.cli.output import PlainConsole, emit_json, note
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.inspect.capture import CaptureInspection
    from cangauge.inspect.log import LogInspection

PIPED_WIDTH = 140
"""Width of the tables where stdout is no terminal [characters]."""
_NESTED = (Mapping, list, tuple)
_MARKS = {"yes": "[green]yes[/]", "partly": "[yellow]partly[/]", "no": "[red]no[/]"}


@option_groups("temperature_source")
def inspect_command(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="LOG|CAPTURE",
            help="Log (canonical Parquet or CSV, ANL D3 test, BMW i3 trip, cycler export, or any"
            " table with a heading for each column; also gzipped or zipped) or CAN capture.",
            show_default=False,
        ),
    ],
    *,
    reading: ReadingOptions,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Show what a log or capture holds, and the sign of its current.

    Rates, gaps longer than 2 s, ranges, quantization, stuck channels, charge moved [Ah], the
    capacity that the reference SoC implies [Ah per 100 %], resistance from steps of current [Ω],
    and what the log can and cannot identify. The sign of current is found from the data. For a
    capture also frames, CRC and counter errors.

    Examples
    --------
    `cangauge inspect drive.parquet`

    `cangauge inspect TripA01.csv.gz --json`

    `cangauge inspect drive.parquet --report drive.html`

    `cangauge inspect 1C-Discharge.csv --temperature 24`

    `cangauge inspect logger.csv --columns 'time=Stamp,current=I_batt[mA]:-1,voltage=U_batt'`

    `cangauge inspect capture.log --vehicle leaf_ze0`
    """
    # Deferred: the readers and the decoder take half a second to import.
    from cangauge.inspect.capture import inspect_capture
    from cangauge.inspect.log import LogInspection, inspect_log
    from cangauge.logs.read import LogFile

    check_outputs([report], [path])
    recording = reading.open(path)
    assumed: dict[str, list[str]] = {}
    found: LogInspection | CaptureInspection
    if isinstance(recording, LogFile):
        _refuse_options_of_captures(reading, path)
        log = recording.read(temperature_c=reading.temperature)
        assumed = assumed_of([log])
        if log.assumed:
            note(f"{path}: read as {', '.join(log.assumed)}")
        found = of_log = inspect_log(log)
        if report is not None:
            write_texts_atomic({report: extra("report.inspection:inspect_report")(of_log, log)})
            note(f"report: {report}")
    else:
        if report is not None:
            raise InputError(
                "shows a log, and this is a capture",
                source=path,
                field="--report",
                value=str(report),
                cure="omit it, or use cangauge estimate --report",
            )
        found = inspect_capture(path, reading.car() if reading.names_vehicle else None)
    if json_output:
        emit_json(found.to_dict() | {"assumed": assumed})
        return
    console = PlainConsole(highlight=False)
    if not console.is_terminal:
        console = PlainConsole(highlight=False, width=PIPED_WIDTH)
    if isinstance(found, LogInspection):
        _show_log(console, found)
    else:
        _show(console, {key: value for key, value in found.to_dict().items() if key != "log"})
        if found.log is not None:
            _show_log(console, found.log)


def _refuse_options_of_captures(reading: ReadingOptions, path: Path) -> None:
    options = {"--vehicle": reading.vehicle, "--dbc": reading.dbc, "--map": reading.map_file}
    given = {option: str(value) for option, value in options.items() if value is not None}
    if given and not (list(given) == ["--map"] and reading.mapped_columns() is not None):
        option, value = next(iter(given.items()))
        problem = "this is a log; the option is for captures"
        raise InputError(problem, source=path, field=option, value=value, cure="omit it")


def _show_log(console: Console, found: LogInspection) -> None:
    timing, charge, soc = found.timing, found.charge, found.soc
    rate = f"{timing.rate_hz:.4g} Hz" if timing.rate_hz else "one row"
    console.print(
        f"[bold]{escape(found.name)}[/]: {found.rows} rows, {timing.duration_s / 60.0:.1f} min,"
        f" {rate} ({'regular' if timing.regular else 'irregular'}),"
        f" temperature of: {found.temperature_source}"
    )
    table = Table()
    for heading in ("channel", "minimum", "median", "maximum", "unit", "step", "missing"):
        table.add_column(heading, justify="left" if heading in {"channel", "unit"} else "right")
    for name, channel in found.channels.items():
        step = "none" if channel.quantum is None else f"{channel.quantum:.4g}"
        values = (channel.minimum, channel.median, channel.maximum)
        table.add_row(
            escape(name),
            *(f"{value:.5g}" for value in values),
            escape(channel.unit),
            "constant" if channel.levels == 1 else step,
            str(channel.missing or ""),
        )
    console.print(table)
    console.print(
        f"Charge: {charge.discharged_ah:.4g} Ah discharged, {charge.charged_ah:.4g} Ah charged,"
        f" net {charge.net_ah:+.4g} Ah."
    )
    if soc is not None:
        console.print(
            f"Reference SoC: {soc.first_pct:.1f} → {soc.last_pct:.1f} %,"
            f" in {100.0 * soc.coverage:.1f} % of the rows."
        )
    console.print(f"Sign: {found.sign.sentence}.", markup=False)
    abilities = Table(title="What this log can identify", title_justify="left")
    for heading in ("quantity", "identifiable", "reason"):
        abilities.add_column(heading)
    for ability in found.abilities[1:]:
        abilities.add_row(ability.topic, _MARKS[ability.verdict], ability.text)
    console.print(abilities)
    for heading, lines in (("Remarks", found.remarks), ("Warning", found.warnings)):
        for line in lines:
            console.print(f"{heading}: {line}", markup=False)


def _show(console: Console, found: Mapping[str, Any], title: str = "") -> None:
    """Print a nested result: plain values first, then tables and lists under their names."""
    plain = {key: value for key, value in found.items() if not isinstance(value, _NESTED)}
    if plain:
        _show_rows(console, title, [{"": _label(key), " ": value} for key, value in plain.items()])
    for key, value in found.items():
        name = f"{title} {key}".strip()
        if isinstance(value, Mapping):
            _show(console, value, name)
        elif isinstance(value, list | tuple):
            if rows := [row for row in value if isinstance(row, Mapping)]:
                _show_rows(console, name, rows)
                continue
            for line in value:
                console.print(f"{key}: {line}", markup=False)


def _show_rows(console: Console, title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    headings = list(dict.fromkeys(key for row in rows for key in row))
    named = any(heading.strip() for heading in headings)
    table = Table(title=title.replace("_", " "), title_justify="left", show_header=named)
    for heading in headings:
        table.add_column(escape(_label(heading)))
    for row in rows:
        table.add_row(*(escape(_shown(row.get(heading))) for heading in headings))
    console.print(table)


_UNITS = {"_s": "s", "_a": "A", "_v": "V", "_c": "°C", "_pct": "%"}
_LABELS = {
    "cut_off": "file is cut off",
    "first_malformed": "first malformed line",
    "malformed": "malformed lines",
    "matching_presets": "presets that match",
    "other_ids": "frames of further ids",
    "time_reversals": "stamps that step back",
}


def _label(key: str) -> str:
    """Return a key of the JSON as words with its unit."""
    if key in _LABELS:
        return _LABELS[key]
    for suffix, unit in _UNITS.items():
        if key.endswith(suffix):
            return f"{key.removesuffix(suffix).replace('_', ' ')} [{unit}]"
    return key.replace("_", " ")


def _shown(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.5g}" if isinstance(value, float) else str(value)
