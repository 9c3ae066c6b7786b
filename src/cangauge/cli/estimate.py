"""`cangauge estimate`: a log or capture and a model → SoC at every sample, offline."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cangauge._extras import extra
from cangauge._files import atomic_path
from cangauge._text import NONE_KNOWN, number, rounded, uncertain
from cangauge.cli.options import (
    MODEL,
    CapacityAh,
    Json,
    ReadingOptions,
    Report,
    argument,
    assumed_of,
    check_outputs,
    command,
    note_starts,
    option,
)
from cangauge.cli.output import finish, print_values, progress, remark, say
from cangauge.cli.status import pack_values
from cangauge.types import REASON_WORDS, Reason

if TYPE_CHECKING:
    from cangauge._typing import FloatArray
    from cangauge.estimation.offline import EstimateTable
    from cangauge.estimation.settings import EstimatorSettings
    from cangauge.model.model_file import Model
    from cangauge.service.offline import RecordedEstimate

_ORIGINS = {"given": "given", "log": "from the log's soc_pct", "voltage": "found by the voltage"}
"""How the initial SoC is known."""


@command()
def estimate_command(
    log_path: Annotated[Path, argument("LOG", "Recorded log or capture.")],
    *,
    model: Annotated[Path, MODEL],
    output: Annotated[
        Path,
        option(
            "-o, --output", "OUT.csv|.parquet", "Table of estimates.", suffixes=(".csv", ".parquet")
        ),
    ],
    method: Annotated[
        Literal["ekf", "newton", "coulomb"],
        option(
            "--method",
            "ekf|newton|coulomb",
            "Method that computes soc_pct. ekf: Kalman filter with voltage and charge; newton:"
            " voltage alone; coulomb: counting alone.",
        ),
    ] = "ekf",
    initial_soc: Annotated[
        Any,
        option(
            "--initial-soc",
            "P|auto",
            "SoC at the first sample, e.g. 80. `auto` estimates it from the first voltages."
            " Default for a log: its first soc_pct, counted back to the first row. Default for a"
            " capture, or without soc_pct: auto.",
            within=(0, 100),
            unit="%",
            word="auto",
        ),
    ] = None,
    initial_soc_std: Annotated[
        float,
        option(
            "--initial-soc-std",
            "X",
            "Standard deviation of the initial SoC.",
            within=(0, 100),
            unit="%",
        ),
    ] = 1.0,
    capacity_ah: CapacityAh = None,
    reading: ReadingOptions,
    pack: Annotated[
        Path | None,
        option(
            "--pack",
            "PACK.csv|.parquet",
            "Table of health, power and cells, with one row per second.",
            suffixes=(".csv", ".parquet"),
        ),
    ] = None,
    report: Report = None,
    json_output: Json = False,
) -> None:
    """Estimate the state of charge of a recorded log or capture, offline.

    OUT has one row per sample: time_s [s], soc_pct, soc_std_pct, soc_newton_pct, soc_coulomb_pct
    [%], voltage_model_v, residual_v (measured − model) [V], status (initialising, valid, degraded,
    invalid) and reasons (separated by "; "). An unknown value is empty (CSV) or null (Parquet).
    Positive current discharges.

    PACK has one row per second; for a log over an hour, it has 3,600 rows. Its columns are
    capacity_ah, resistance_ratio, offset_a, discharge_a and charge_a (possible for 10 s) and
    energy_wh (left), each with its standard deviation. energy_to_soc_pct is the SoC at which this
    energy is used up. If the log has cell voltages (columns cell_1_v, cell_2_v, …, or [cells] of
    the map file), PACK also has the weakest cell.

    Examples
    --------
    `cangauge estimate trip.parquet -m pack.json -o soc.csv --report soc.html`

    `cangauge estimate trip.csv -m pack.json -o soc.parquet --initial-soc auto`

    `cangauge estimate drive.log --vehicle leaf_ze0 -m leaf.json -o soc.csv --method newton`
    """
    from cangauge.estimation.settings import EstimatorSettings
    from cangauge.logs.canonical import write_table
    from cangauge.logs.log import Log
    from cangauge.model.model_file import Model
    from cangauge.service.offline import pack_columns

    settings = EstimatorSettings(
        method=method,
        initial_soc_pct=None if initial_soc == "auto" else initial_soc,
        initial_soc_std_pct=initial_soc_std,
        capacity_ah=capacity_ah,
    )
    files = {"output": output, "pack": pack, "report": report}
    check_outputs(files.values(), [log_path, model])
    pack_model = Model.load(model)
    done = estimate_file(
        log_path,
        pack_model,
        settings,
        reading,
        soc_from_log=initial_soc is None,
        keeps_pack=pack is not None,
    )
    page = extra("report.estimate:estimate_page")(done, model).html() if report else ""
    with ExitStack() as all_of_them:
        write_estimates(
            all_of_them.enter_context(atomic_path(output)),
            done.recorded.time_s,
            done.table,
            is_parquet=output.suffix.lower() == ".parquet",
        )
        if report is not None:
            all_of_them.enter_context(atomic_path(report)).write_text(page, encoding="utf-8")
        if pack is not None:
            write_table(pack_columns(done.pack_rows), pack)
    for warning in done.warnings:
        remark(f"warning: {done.recorded.source}: {warning}")
    found = done.to_dict() | {
        "assumed": assumed_of([done.recorded] if isinstance(done.recorded, Log) else [])
    }
    finish(found, partial(_show, done.recorded.name, found, done.table), files, as_json=json_output)


def estimate_file(
    path: Path,
    model: Model,
    settings: EstimatorSettings,
    reading: ReadingOptions,
    *,
    soc_from_log: bool = True,
    keeps_pack: bool = False,
) -> RecordedEstimate:
    """Estimate a log or capture as the command does; InputError for what the command refuses."""
    from cangauge.logs.charge import refuse_contradictions
    from cangauge.logs.read import LogFile
    from cangauge.service.offline import estimate_capture, estimate_recorded_log

    with progress() as show_line:

        def show(count: int) -> None:
            show_line(f"{path.name}: {count} rows")

        if not isinstance(reading.open(path), LogFile):
            done = estimate_capture(
                path, reading.car_of(path), model, settings, keeps_pack=keeps_pack, progress=show
            )
        else:
            log = reading.load(path)
            capacity_ah = settings.capacity_ah or model.capacity_ah
            if soc_from_log:  # a stated start needs no SoC of the log
                refuse_contradictions([log], capacity_ah)
            if settings.initial_soc_pct is not None:
                note_starts([log], settings.initial_soc_pct, capacity_ah)
            done = estimate_recorded_log(
                log,
                model,
                settings,
                soc_from_log=soc_from_log,
                cells=reading.cells_of(log),
                keeps_pack=keeps_pack,
                progress=show,
            )
    _check(done)
    return done


def _check(done: RecordedEstimate) -> None:
    """Print what to know about a recording; InputError if a capture's current is inverted."""
    from cangauge.bus.recording import CaptureSamples, refuse_single_row
    from cangauge.logs.gaps import USUAL_STEPS
    from cangauge.logs.sign import require_discharge_positive
    from cangauge.settings import GAP_S

    recorded = done.recorded
    gap_s = done.settings.gap_s
    if isinstance(recorded, CaptureSamples):
        refuse_single_row(recorded)
        for text in recorded.remarks:
            remark(f"{recorded.source}: {text}")
        if (log := recorded.as_log()) is not None:
            require_discharge_positive(log, is_capture=True)
    elif gap_s >= USUAL_STEPS * GAP_S:  # else the usual step is no gap
        remark(
            f"note: {recorded.source}: its usual step is {rounded(gap_s / USUAL_STEPS, 2)} s;"
            f" steps over {rounded(gap_s, 2)} s count as gaps"
        )


def write_estimates(
    path: Path, time_s: FloatArray, table: EstimateTable, *, is_parquet: bool
) -> None:
    """Write one row per sample, as CSV or Parquet.

    `time_s` are the samples' own times [s]: a refused sample's estimate is the one before. An
    unknown value becomes empty (CSV) or null (Parquet).
    """
    import pyarrow.csv as pacsv
    import pyarrow.parquet as pq

    columns = replace(table, time_s=time_s).to_arrow()
    if is_parquet:
        pq.write_table(columns, path)
        return
    with path.open("wb") as file:
        file.write((",".join(columns.column_names) + "\n").encode())  # pyarrow would quote them
        options = pacsv.WriteOptions(include_header=False, quoting_style="none")
        pacsv.write_csv(columns, file, options)


def _show(name: str, found: Mapping[str, Any], table: EstimateTable) -> None:
    """Print the SoC at both ends, its error where the log has a reference, and the pack."""
    import numpy as np

    def percent(share: float | None, of: str = "") -> str:
        return number(None if share is None else 100.0 * share, 1, f"%{of}")

    def soc_at(row: int) -> str:
        return uncertain(float(table.soc_pct[row]), float(table.soc_std_pct[row]), "%")

    known = np.isfinite(table.soc_pct)
    start = number(found["initial_soc_pct"], 1, "%")
    origin = found["initial_soc_from"]
    if origin == "voltage" and known.any():
        start = soc_at(int(known.argmax()))
    shares = [
        f"{REASON_WORDS[Reason[name.upper().replace(' ', '_')]]} {percent(share)}"
        for name, share in found["reasons"].items()
    ]
    off = found["soc_mae_pct"]
    compared = "" if off is None else f"; {number(off, 2, '%')} off the log's own SoC on average"
    say(f"{name}: {soc_at(-1)} SoC at the end, from {start} ({_ORIGINS[origin]}){compared}.")
    values = {
        "SoC at the end": soc_at(-1),
        "SoC error, MAE": number(found["soc_mae_pct"], 2, "%"),
        "SoC error, largest": number(found["soc_max_pct"], 2, "%"),
        "reference within ±2σ": percent(found["cover_2sigma"], " of samples"),
        "voltage error, MAE": number(found["voltage_mae_pct"], 2, "%"),
        "valid": percent(found["valid_fraction"], " of samples"),
        "less than valid": "; ".join(shares) or NONE_KNOWN,
    }
    print_values(f"State of charge of {name}", values | pack_values(found))
