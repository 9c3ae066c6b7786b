"""`cangauge fit`: recorded logs → model file and report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cangauge._extras import extra
from cangauge._files import write_texts_atomic
from cangauge._text import NONE_KNOWN, energy_text, number, significant, span
from cangauge.cli.declare import Written, command
from cangauge.cli.options import ReadingOptions, assumed_of, check_outputs
from cangauge.cli.output import (
    console,
    emit_json,
    note,
    print_table,
    print_values,
    progress_shown,
)
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.identify.identification import Identification
    from cangauge.logs.log import Log

SAME_SUM = 0.02
"""Largest difference between the sum of the cells and the pack's voltage, of the latter: a cell
more or less in 16 makes three times as much."""


@command()
def fit_command(
    logs: list[Path],
    *,
    output: Written,
    capacity_ah: float | Literal["from-soc"] | None = None,
    initial_soc: list[float | Literal["auto"]] | None = None,
    equation: Literal["knots", "published"] = "knots",
    chemistry: Literal["oxide", "lfp"] | None = None,
    cells: int | None = None,
    effects: list[str] | None = None,
    reading: ReadingOptions,
    report: Written | None = None,
    json_output: bool = False,
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

    Parameters
    ----------
    logs : LOG
        Recorded logs or captures of one pack.
    output : -o, --output MODEL.json
        Model file to write.
    capacity_ah : A|from-soc (0.001 … 1e5 Ah)
        Charge from 100 to 0 %, e.g. 51.5; `from-soc` takes the charge per 100 % of the logs'
        soc_pct. Default: from a log that runs from full to empty.
    initial_soc : P|auto (0 … 100 %)
        SoC at the first row; once for all logs, or repeated, once for each in order. Default, and
        auto: its soc_pct; a log without is estimated together with the curve, if another log pins
        it.
    equation : knots|published
        knots: a curve around the typical cell of the chemistry; published: the published equation
        by plain least squares.
    chemistry : oxide|lfp
        Chemistry of the cells: layered oxides or manganese spinel, or iron phosphate. Default: from
        the volts per cell where their number is known, else oxide.
    cells : N (1 … 2000)
        Cells in series. Default: the columns of cells of the first log, if it has all.
    effects : ID…|auto|none
        Effects to add to the model, separated by commas, e.g. hysteresis; `auto` adds those that
        lower the error of left-out logs significantly. Default: auto from five logs on.
    """
    from cangauge.identify.effect_search import parse_effect_ids
    from cangauge.identify.fit import fit

    if initial_soc is not None and len(initial_soc) not in {1, len(logs)}:
        raise InputError(
            f"{len(initial_soc)} values for {len(logs)} logs",
            field="--initial-soc",
            cure="give one for all, or one for each log in order (auto where it is unknown)",
        )
    starts = [None if each == "auto" else each for each in initial_soc or ["auto"]]
    check_outputs([output, report], logs)
    with console.status("reading") as status:
        recorded = []
        for path in logs:
            status.update(f"reading {path}")
            recorded.append(reading.load(path))
        with progress_shown("cangauge.identify", status.update):
            result = fit(
                recorded,
                capacity_ah=capacity_ah,
                initial_soc_pct=starts if len(starts) > 1 else starts[0],
                equation=equation,
                chemistry=chemistry,
                cells=cells or _cells_of(logs[0], recorded[0], reading),
                effects=parse_effect_ids(effects) if effects else None,
            )
        status.update("writing")
        texts = {output: result.model.to_json()}
        if report is not None:
            texts[report] = extra("report.fit:fit_page")(result).html()
        write_texts_atomic(texts)
    if json_output:
        written = {"model": str(output), "report": report and str(report)}
        emit_json(result.to_dict() | written | {"assumed": assumed_of(recorded)})
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


def _show(result: Identification) -> None:
    from cangauge.identify.identification import coefficient_rows, effect_rows, search_rows
    from cangauge.model.voltage_model import BASIS_NAMES

    model, energy = result.model, result.energy
    note(result.verdict)
    for remark in result.remarks:
        note(f"note: {remark}")
    held_out = number(model.noise.voltage_mae_pct, 3, "%") if result.is_held_out else NONE_KNOWN
    print_values(
        f"Model {model.name}",
        {
            "voltage error, MAE": number(result.voltage_mae_pct, 3, "%"),
            "voltage error, RMSE": significant(result.voltage_rmse_v, 3, "V"),
            "voltage error held out, MAE": held_out,
            "SoC from voltage, MAE": number(result.soc_newton_mae_pct, 2, "%"),
            "capacity": number(model.capacity_ah, 2, "Ah"),
            "identified at SoC": span(*model.range.soc_pct, 1, "%"),
            "identified at temperature": span(*model.range.temperature_c, 1, "°C"),
            "rows used": str(sum(len(item.rows) for item in result.fits)),
        },
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
    print_values(
        "Energy at the terminals",
        {
            "driven": energy_text(1e3 * energy.driven_kwh),
            "regenerated": energy_text(1e3 * energy.regenerated_kwh),
            "net": energy_text(1e3 * energy.net_kwh),
            "Joule heat": energy_text(1e3 * energy.heat_kwh),
            "efficiency": number(energy.efficiency_pct, 1, "%"),
        },
    )
