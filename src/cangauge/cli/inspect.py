"""`cangauge inspect`: what a log or a capture holds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from cangauge.cli.options import JsonOption
from cangauge.cli.output import emit_json
from cangauge.errors import InputError
from cangauge.inspect.log import LogInspection, inspect_log
from cangauge.logs.read import CaptureGivenError, read_log

if TYPE_CHECKING:
    from cangauge.inspect.capture import CaptureInspection

PIPED_WIDTH = 140
"""Columns of the tables where stdout is no terminal that has a width."""
_MARKS = {"yes": "[green]yes[/]", "partly": "[yellow]partly[/]", "no": "[red]no[/]"}


def inspect_command(  # noqa: PLR0917  # typer fills the arguments by name
    path: Annotated[
        Path,
        typer.Argument(
            metavar="LOG|CAPTURE",
            help="Log (canonical Parquet or CSV, ANL D3 test, BMW i3 trip, cycler export; also"
            " gzipped or zipped) or CAN capture.",
            show_default=False,
        ),
    ],
    vehicle: Annotated[
        str | None, typer.Option(help="Preset of the car, for a capture.", metavar="PRESET")
    ] = None,
    dbc: Annotated[
        Path | None, typer.Option(help="DBC of the car, for a capture.", metavar="FILE")
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", help="Mapping of its signals, with --dbc.", metavar="FILE"),
    ] = None,
    temperature: Annotated[
        float | None,
        typer.Option(help="Constant temperature [°C], where the file holds none.", metavar="T"),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Tell what a log or capture holds, and find the sign of current from the data.

    Rates, gaps longer than 2 s, ranges, steps of quantisation, stuck channels, charge moved [Ah],
    the capacity that the reference SoC implies [Ah per 100 %], resistance seen in steps [Ω], and
    what the log can and cannot identify. For a capture also frames, CRC and counter errors.

    For example:

    `cangauge inspect drive.parquet`

    `cangauge inspect TripA01.csv.gz --json`

    `cangauge inspect 1C-Discharge.csv --temperature 24`

    `cangauge inspect capture.log --vehicle leaf_ze0`
    """
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=PIPED_WIDTH)
    try:
        log = read_log(path, temperature_c=temperature)
    except CaptureGivenError:
        found = _inspect_capture(path, vehicle, dbc, map_file, temperature)
        if json_output:
            emit_json(found.to_dict())
        else:
            _show(console, {k: v for k, v in found.to_dict().items() if k != "log"})
            if found.log is not None:
                _show_log(console, found.log)
        return
    for option, given in (("--vehicle", vehicle), ("--dbc", dbc), ("--map", map_file)):
        if given is not None:
            raise InputError(
                f"{path} is a log and no capture", field=option, value=str(given), cure="leave it"
            )
    inspection = inspect_log(log)
    if json_output:
        emit_json(inspection.to_dict())
    else:
        _show_log(console, inspection)


def _inspect_capture(
    path: Path,
    vehicle: str | None,
    dbc: Path | None,
    map_file: Path | None,
    temperature_c: float | None,
) -> CaptureInspection:
    # Imported here: python-can and cantools are slow to import, and logs do without.
    from cangauge.bus.vehicle import Vehicle  # noqa: PLC0415
    from cangauge.inspect.capture import inspect_capture  # noqa: PLC0415

    car = None
    if vehicle is not None or dbc is not None or map_file is not None:
        car = Vehicle.load(vehicle, dbc, map_file, temperature_c=temperature_c)
    return inspect_capture(path, car)


def _show_log(console: Console, found: LogInspection) -> None:
    timing, charge, soc = found.timing, found.charge, found.soc
    rate = f"{timing.rate_hz:.4g} Hz" if timing.rate_hz else "one row"
    console.print(
        f"[bold]{found.name}[/]: {found.rows} rows, {timing.duration_s / 60.0:.1f} min,"
        f" {rate} ({'regular' if timing.regular else 'irregular'}),"
        f" temperature of: {found.temperature_source}"
    )
    table = Table()
    for heading in ("channel", "minimum", "median", "maximum", "unit", "step", "missing"):
        table.add_column(heading, justify="left" if heading in {"channel", "unit"} else "right")
    for name, channel in found.channels.items():
        table.add_row(
            name,
            f"{channel.minimum:.5g}",
            f"{channel.median:.5g}",
            f"{channel.maximum:.5g}",
            channel.unit,
            "constant" if channel.levels == 1 else _number(channel.quantum),
            str(channel.missing or ""),
        )
    console.print(table)
    console.print(
        f"Charge: {charge.discharged_ah:.4g} Ah taken out, {charge.charged_ah:.4g} Ah put in,"
        f" net {charge.net_ah:+.4g} Ah."
    )
    if soc is not None:
        console.print(
            f"Reference SoC: {soc.first_pct:.1f} → {soc.last_pct:.1f} %,"
            f" in {100.0 * soc.coverage:.1f} % of the rows."
        )
    console.print(f"Sign: {found.sign.sentence}.", markup=False)
    abilities = Table(title="What this log can identify", title_justify="left")
    for heading in ("what", "can", "because"):
        abilities.add_column(heading)
    for ability in found.abilities[1:]:
        abilities.add_row(ability.topic, _MARKS[ability.verdict], ability.text)
    console.print(abilities)
    for heading, lines in (("Remarks", found.remarks), ("Look at", found.warnings)):
        for line in lines:
            console.print(f"{heading}: {line}", markup=False)


def _number(value: float | None) -> str:
    return "none seen" if value is None else f"{value:.4g}"


def _show(console: Console, found: Mapping[str, Any], title: str = "") -> None:
    """Show a nested result: plain values first, then tables and lists under their names."""
    plain = {key: value for key, value in found.items() if not isinstance(value, Mapping | list)}
    if plain:
        _show_rows(console, title, [{"": key, " ": value} for key, value in plain.items()])
    for key, value in found.items():
        if isinstance(value, Mapping):
            _show(console, value, f"{title} {key}".strip())
        elif isinstance(value, list) and value and all(isinstance(row, Mapping) for row in value):
            _show_rows(console, f"{title} {key}".strip(), value)
        elif isinstance(value, list):
            for line in value:
                console.print(f"{key}: {line}", markup=False)


def _show_rows(console: Console, title: str, rows: list[dict[str, Any]]) -> None:
    headings = list(dict.fromkeys(key for row in rows for key in row))
    named = any(heading.strip() for heading in headings)
    table = Table(title=title.replace("_", " "), title_justify="left", show_header=named)
    for heading in headings:
        table.add_column(heading.replace("_", " "))
    for row in rows:
        table.add_row(*(_shown(row.get(heading)) for heading in headings))
    console.print(table)


def _shown(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
