"""`cangauge fit`: recorded logs → model file and report."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from cangauge._extras import extra
from cangauge._files import write_texts_atomic
from cangauge._text import NONE_KNOWN, number, significant, span
from cangauge.cli.options import (
    JsonOption,
    ReadingOptions,
    ReportOption,
    assumed_of,
    check_outputs,
    option_groups,
    suffixed,
    within,
)
from cangauge.cli.output import console, emit_json, note, print_table, progress_shown
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.identify.identification import Identification
    from cangauge.logs.log import Log

FROM_SOC = "from-soc"
AUTO = "auto"
PUBLISHED_DELAYS = "0,10,30,70"
SAME_SUM = 0.02
"""Largest difference between the sum of the cells and the pack's voltage, of the latter: a cell
more or less in 16 makes three times as much."""


@option_groups()
def fit_command(  # noqa: PLR0917 - typer passes options by name
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG", help="Recorded logs or captures of one pack."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="MODEL.json",
            callback=suffixed(".json"),
            help="Model file to write.",
        ),
    ],
    capacity_ah: Annotated[
        str | None,
        typer.Option(
            metavar="A|from-soc",
            help="Charge from 100 to 0 % [Ah], e.g. 51.5; `from-soc` takes the charge per 100 % of"
            " the logs' soc_pct. Default: from a log that runs from full to empty.",
        ),
    ] = None,
    initial_soc: Annotated[
        list[str] | None,
        typer.Option(
            metavar="P|auto",
            help="SoC at the first row [%]; once for all logs, or repeated, once for each in order."
            " Default, and auto: its soc_pct; a log without is estimated together with the curve,"
            " if another log pins it.",
        ),
    ] = None,
    equation: Annotated[
        Literal["knots", "published"],
        typer.Option(
            help="knots: a curve around the typical cell of the chemistry; published: the published"
            " equation by plain least squares."
        ),
    ] = "knots",
    chemistry: Annotated[
        Literal["oxide", "lfp"] | None,
        typer.Option(
            help="Chemistry of the cells: layered oxides or manganese spinel, or iron phosphate."
            " Default: from the volts per cell where their number is known, else oxide."
        ),
    ] = None,
    cells: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            max=2000,
            help="Cells in series. Default: the columns of cells of the first log, if it has all.",
        ),
    ] = None,
    rate_hz: Annotated[
        float, typer.Option(metavar="HZ", help="Rate of the fit [Hz]; faster logs are decimated.")
    ] = 1.0,
    delays: Annotated[
        str,
        typer.Option(metavar="S,S,…", help="Delays of the current [s]; with --equation published."),
    ] = PUBLISHED_DELAYS,
    epsilon: Annotated[
        float,
        typer.Option(
            metavar="E",
            help="Margin ε of the scaled SoC [-], 0 < ε < 0.5; with --equation published.",
        ),
    ] = 0.05,
    t_ref: Annotated[
        float,
        typer.Option(
            metavar="C", help="Reference temperature T_r [°C]; with --equation published."
        ),
    ] = 20.0,
    effects: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ID…|auto|none",
            help="Effects to add to the model, separated by commas, e.g. hysteresis; `auto` adds"
            " those that lower the error of left-out logs significantly. Default: auto from five"
            " logs on.",
        ),
    ] = None,
    *,
    reading: ReadingOptions,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Identify the voltage model of a pack from recorded logs.

    A log has time_s [s], current_a [A] (positive discharges), voltage_v [V], temperature_c [°C]
    and optionally soc_pct [%], or columns of other names (--columns); `cangauge inspect` shows what
    a file holds. The SoC at the start of at least one log must be known.

    Examples
    --------
    `cangauge fit full_discharge.parquet -o pack.json --report pack.html`

    `cangauge fit trip1.csv trip2.csv trip3.csv -o pack.json --capacity-ah from-soc --cells 96`

    `cangauge fit drive.log --vehicle leaf_ze0 -o pack.json --capacity-ah 51.5 --initial-soc 92`

    `cangauge fit trip*.csv -o pack.json --capacity-ah from-soc --effects auto`

    `cangauge fit known.csv other.csv -o pack.json --capacity-ah 60 --initial-soc 92 --initial-soc
    auto`

    Model file and report are written together, or neither.
    """
    from cangauge.identify.effect_search import parse_effect_ids
    from cangauge.identify.fit import fit

    capacity = _capacity(capacity_ah)
    initial = _initial_soc(initial_soc, len(logs))
    within(rate_hz, 0.01, 1000.0, option="--rate-hz", unit="Hz")
    within(epsilon, 1e-4, 0.49, option="--epsilon", unit="")
    within(t_ref, -60.0, 120.0, option="--t-ref", unit="°C")
    effect_ids = parse_effect_ids(effects) if effects else None
    delay_s = parse_delays(delays)
    if equation == "knots":
        _refuse_published_options(delays, epsilon, t_ref)
    check_outputs([output, report], logs)
    with console.status("reading") as status:
        recorded = []
        for path in logs:
            status.update(f"reading {path}")
            recorded.append(reading.load(path))
        if cells is None:
            cells = _cells_of(logs[0], recorded[0], reading)
        with progress_shown("cangauge.identify", status.update):
            result = fit(
                recorded,
                capacity_ah=capacity,
                initial_soc_pct=initial,
                equation=equation,
                chemistry=chemistry,
                cells=cells,
                rate_hz=rate_hz,
                delay_s=delay_s,
                epsilon=epsilon,
                t_ref_c=t_ref,
                effects=effect_ids,
            )
        page = None
        if report is not None:
            status.update("writing the report")
            page = extra("report.fit:fit_report")(result)
    write_texts_atomic(
        {output: result.model.to_json()} | ({report: page} if report and page else {})
    )
    if json_output:
        more: dict[str, object] = {
            "model": str(output),
            "report": report and str(report),
            "assumed": assumed_of(recorded),
        }
        emit_json(result.to_dict() | more)
        return
    _show(result)
    note(f"model: {output}" + (f"\nreport: {report}" if report else ""))


def _cells_of(path: Path, log: Log, reading: ReadingOptions) -> int | None:
    """Return the number of cells in series that a log's columns of cells prove, or None."""
    import numpy as np

    from cangauge.logs.read import LogFile, read_cells

    if not isinstance(reading.open(path), LogFile):
        return None
    cells = read_cells(path, log.time_s, reading.given_columns())
    if cells is None:
        return None
    ratio = float(np.nanmedian(cells.voltage_v.sum(axis=1) / log.voltage_v))
    return cells.count if abs(ratio - 1.0) <= SAME_SUM else None


def _refuse_published_options(delays: str, epsilon: float, t_ref: float) -> None:
    for option, value, default in (
        ("--delays", delays, PUBLISHED_DELAYS),
        ("--epsilon", epsilon, 0.05),
        ("--t-ref", t_ref, 20.0),
    ):
        if value != default:
            raise InputError(
                "belongs to the published equation",
                field=option,
                value=value,
                cure="add --equation published, or leave it out",
            )


def _capacity(given: str | None) -> float | Literal["from-soc"] | None:
    if given is None:
        return None
    if given == FROM_SOC:
        return "from-soc"
    try:
        return within(float(given), 1e-3, 1e5, option="--capacity-ah", unit="Ah")
    except ValueError as error:
        raise InputError(
            "not a number of Ah",
            field="--capacity-ah",
            value=given,
            cure=f"give it as 51.5, or as {FROM_SOC} to take it from the logs' soc_pct",
        ) from error


def _initial_soc(given: list[str] | None, number: int) -> float | list[float | None] | None:
    """Return the value for all logs, or one for each; None where it is not given."""
    if not given:
        return None
    found: list[float | None] = []
    for text in given:
        try:
            value = None if text == AUTO else float(text)
        except ValueError as error:
            raise InputError(
                "neither a number nor auto", field="--initial-soc", value=text, cure="give it as 80"
            ) from error
        found.append(within(value, 0.0, 100.0, option="--initial-soc", unit="%"))
    if len(found) not in {1, number}:
        raise InputError(
            f"{len(found)} values for {number} logs",
            field="--initial-soc",
            cure="give one for all, or one for each log in order (auto where it is unknown)",
        )
    return found[0] if len(found) == 1 else found


def parse_delays(given: str) -> tuple[float, ...]:
    """Return the value of `--delays` [s]; raise InputError if it is none."""
    cure = "give increasing seconds from 0, such as 0,10,30,70"
    try:
        delays = tuple(float(text) for text in given.split(","))
    except ValueError as error:
        raise InputError(
            "not a list of seconds", field="--delays", value=given, cure=cure
        ) from error
    increasing = all(low < high for low, high in pairwise(delays))
    # Slope resistance and heat are defined by the undelayed current.
    if not (delays[0] == 0.0 and increasing and delays[-1] <= 3600.0):
        raise InputError(
            "delays must begin with 0 and increase to 3600 s at most",
            field="--delays",
            value=given,
            cure=cure,
        )
    return delays


def _show(result: Identification) -> None:
    from cangauge.identify.identification import coefficient_rows, effect_rows, search_rows
    from cangauge.model.voltage_model import BASIS_NAMES

    model, energy = result.model, result.energy
    note(result.verdict)
    for remark in result.remarks:
        note(f"note: {remark}")
    held_out = ["voltage error held out, MAE", number(model.noise.voltage_mae_pct, 3), "%"]
    print_table(
        f"Model {model.name}",
        ["", "value", "<unit"],
        [
            ["voltage error, MAE", number(result.voltage_mae_pct, 3), "%"],
            ["voltage error, RMSE", significant(result.voltage_rmse_v, 3), "V"],
            *([held_out] if result.is_held_out else []),
            ["SoC from voltage, MAE", number(result.soc_newton_mae_pct, 2), "%"],
            ["capacity", number(model.capacity_ah, 2), "Ah"],
            ["identified at SoC", span(*model.range.soc_pct, 1), "%"],
            ["identified at temperature", span(*model.range.temperature_c, 1), "°C"],
            ["rows used", str(sum(len(item.rows) for item in result.fits)), ""],
        ],
    )
    head, rows = coefficient_rows(model.coefficients)
    unknown = {row[0] for row in rows if row[1] == NONE_KNOWN}
    if model.equation == "knots" and unknown & set(BASIS_NAMES):
        unknown |= set(BASIS_NAMES)  # terms of one sum: none is known where one is not
    if shown := [row for row in rows if row[0] not in unknown]:
        print_table("Published equation", head, shown)
    if result.effects is not None and result.effects.steps:
        print_table("Effects", *effect_rows(result))
        print_table("Search for effects", *search_rows(result.effects))
    kwh, unit = (1.0, "kWh") if energy.driven_kwh >= 1.0 else (1e3, "Wh")
    print_table(
        "Energy at the terminals",
        ["", "value", "<unit"],
        [
            ["driven", significant(kwh * energy.driven_kwh, 3), unit],
            ["regenerated", significant(kwh * energy.regenerated_kwh, 3), unit],
            ["net", significant(kwh * energy.net_kwh, 3), unit],
            ["Joule heat", significant(kwh * energy.heat_kwh, 3), unit],
            ["efficiency", number(energy.efficiency_pct, 1), "%"],
        ],
    )
