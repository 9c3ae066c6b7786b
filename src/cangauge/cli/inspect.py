"""`cangauge inspect`: the contents of a log or capture."""

from __future__ import annotations

import shlex
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console, JustifyMethod
from rich.markup import escape
from rich.table import Table

from cangauge._extras import extra
from cangauge._files import write_texts_atomic
from cangauge._text import rounded
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

_STAMPS_SINCE_1970_S = 1e9
"""Earlier stamps count from the start of the capture or of the logger [s]."""
_GAPS_SHOWN = 5
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
    if isinstance(found, LogInspection):
        _show_log(console, found)
    else:
        _show_capture(console, found)
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
    rate = "one row"
    if timing.rate_hz:
        exact = f"{timing.rate_hz:.4g} Hz (regular)"
        rate = exact if timing.regular else f"about {rounded(timing.rate_hz, 2)} Hz (irregular)"
    console.print(
        f"[bold]{escape(found.name)}[/]: {found.rows} rows, {timing.duration_s / 60.0:.1f} min,"
        f" {rate}, temperature of: {found.temperature_source}"
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
    console.print(f"Sign: {found.sign.sentence}.", markup=False, soft_wrap=not console.is_terminal)
    abilities = Table(title="What this log can identify", title_justify="left")
    for heading in ("quantity", "identifiable", "reason"):
        abilities.add_column(heading)
    for ability in found.abilities[1:]:
        abilities.add_row(ability.topic, _MARKS[ability.verdict], ability.text)
    console.print(abilities)
    for heading, lines in (("Remarks", found.remarks), ("Warning", found.warnings)):
        for line in lines:
            console.print(f"{heading}: {line}", markup=False, soft_wrap=not console.is_terminal)


_COUNTS = {
    "error_frames": "error frames",
    "remote_frames": "remote frames",
    "time_reversals": "stamps that step back",
    "other_ids": "frames of further ids",
}
_FAULTS = {
    "crc_errors": "wrong CRC",
    "frames_lost": "lost",
    "counter_repeats": "repeated",
}
_RANGES = {"current_a": "A", "voltage_v": "V", "temperature_c": "°C", "soc_pct": "%"}


def _show_capture(console: Console, found: CaptureInspection) -> None:
    """Print the frames, the vehicle and the faults of a capture; what is zero is left out."""
    info = found.info
    begins = ""
    if found.start_s > _STAMPS_SINCE_1970_S:
        begins = f", from {datetime.fromtimestamp(found.start_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
    console.print(
        f"[bold]{escape(found.name)}[/]: {info.format}, {info.frames:,} frames of"
        f" {len(found.ids)} ids, {found.duration_s:.1f} s{begins}."
    )
    matching = [preset for preset in found.presets if preset.matches]
    for preset in matching:
        spans = [
            f"{span[0]:.5g} … {span[1]:.5g} {unit}"
            for name, unit in _RANGES.items()
            if (span := getattr(preset, name)) is not None
        ]
        console.print(
            f"Vehicle: {preset.about} (--vehicle {preset.preset}), {preset.samples:,} samples:"
            f" {', '.join(spans)}.",
            markup=False,
            soft_wrap=not console.is_terminal,
        )
    if not matching and found.log is None:
        command = f"cangauge init {shlex.quote(found.source)} -o mycar"
        console.print("No known vehicle. Find its signals:", command, markup=False, soft_wrap=True)
    console.print(_table_of_ids(found))
    counts = {words: getattr(found, name) for name, words in _COUNTS.items()}
    if any(counts.values()):
        shown = ", ".join(f"{count:,} {words}" for words, count in counts.items() if count)
        console.print(f"{shown[0].upper()}{shown[1:]}.")
    for gap in found.gaps[:_GAPS_SHOWN]:
        console.print(f"Silence of {gap.length_s:.3g} s after {gap.start_s - found.start_s:.1f} s.")
    if len(found.gaps) > _GAPS_SHOWN:
        console.print(f"{len(found.gaps) - _GAPS_SHOWN} more silences (--json).")
    for line in info.remarks:
        console.print(f"Remarks: {line}", markup=False, soft_wrap=not console.is_terminal)


def _table_of_ids(found: CaptureInspection) -> Table:
    table = Table(title="Frames", title_justify="left")
    buses = {each.bus for each in found.ids}
    for heading in ("id", "bus", "frames", "bytes", "period [s]", "longest [s]", "faults"):
        if heading != "bus" or len(buses) > 1:
            justify: JustifyMethod = "left" if heading in {"id", "faults"} else "right"
            table.add_column(escape(heading), justify=justify)
    for each in found.ids:
        counts = {words: getattr(each, name) for name, words in _FAULTS.items()}
        faults = [f"{count} {words}" for words, count in counts.items() if count]
        faults += ["two senders"] * each.two_senders
        seconds = ["–" if s is None else f"{s:.3g}" for s in (each.period_s, each.longest_s)]
        table.add_row(
            escape(each.id),
            *([escape(each.bus)] if len(buses) > 1 else []),
            f"{each.frames:,}",
            each.bytes,
            *seconds,
            ", ".join(faults) or ("none" if each.protection else "not protected"),
        )
    return table
