"""`cangauge judge`: a second opinion on the SoC that a battery gauge publishes."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from cangauge._files import atomic_path, write_texts_atomic
from cangauge._text import number, printable
from cangauge.cli.options import (
    JsonOption,
    ReadingOptions,
    ReportOption,
    check_outputs,
    option_groups,
    suffixed,
    within,
)
from cangauge.cli.output import emit_json, note, print_table
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.extras.judge.judgement import Judgement
    from cangauge.model.prior import ChemistryName


@option_groups()
def judge_command(  # noqa: PLR0917 - typer passes options by name
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG", help="Logs or captures in order of time, with the published SoC."
        ),
    ],
    model: Annotated[
        Path | None, typer.Option("-m", "--model", metavar="MODEL", help="Model file of the pack.")
    ] = None,
    chemistry: Annotated[
        str | None,
        typer.Option(metavar="oxide|lfp", help="Without a model: the cells' chemistry, …"),
    ] = None,
    cells: Annotated[
        int | None, typer.Option(metavar="N", help="… and how many are in series.")
    ] = None,
    capacity_ah: Annotated[
        float | None,
        typer.Option(
            metavar="A",
            help="Charge from 100 to 0 % that the gauge should count with [Ah]. Default: the"
            " model's; without a model, from the gauge's own count.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="MODEL.json",
            callback=suffixed(".json"),
            help="Write the model, narrowed by these logs.",
        ),
    ] = None,
    corrected: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            callback=suffixed(".csv", ".parquet"),
            help="Write published and corrected SoC of every row, .csv or .parquet.",
        ),
    ] = None,
    *,
    reading: ReadingOptions,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Judge the SoC that a battery gauge publishes: is it right, since when not, and why.

    The logs are of one pack, best of several days, with the published SoC as soc_pct. What happened
    between two logs need not be known. The answer states by how much the gauge is off at the end,
    since when, the cause with its size, and the next step that would settle it. Where the logs
    cannot tell, it says so. Positive current discharges.

    FILE has one row per sample: log, time_s [s], published_pct, corrected_pct and
    corrected_std_pct [%].

    Examples
    --------
    `cangauge judge monday.csv tuesday.csv wednesday.csv -m pack.json --report judge.html`

    `cangauge judge day*.csv --chemistry lfp --cells 16 --capacity-ah 280 --corrected soc.csv`
    """
    from cangauge.extras.judge.judgement import judge, narrowed
    from cangauge.logs.read import read_cells
    from cangauge.model.model_file import Model

    within(capacity_ah, 1e-3, 1e5, option="--capacity-ah", unit="Ah")
    within(None if cells is None else float(cells), 1, 2000, option="--cells", unit="")
    check_outputs([output, corrected, report], [*logs, *([model] if model else [])])
    loaded = [reading.load(path) for path in logs]
    columns = reading.given_columns()
    beside = [read_cells(log.source, log.time_s, columns) if log.source else None for log in loaded]
    judgement = judge(
        loaded,
        None if model is None else Model.load(model),
        chemistry=_chemistry(chemistry),
        cells=cells,
        capacity_ah=capacity_ah,
        cell_voltages=beside,
    )
    texts = {}
    if output is not None:
        texts[output] = narrowed(judgement).to_json()
    if report is not None:
        from cangauge.extras.judge.page import judge_report

        texts[report] = judge_report(judgement, model)
    with ExitStack() as both:
        if corrected is not None:
            _write_corrected(both.enter_context(atomic_path(corrected)), judgement)
        write_texts_atomic(texts)
    if json_output:
        result = judgement.to_dict(None if corrected is None else str(corrected))
        emit_json(result)
        return
    _show(judgement)
    for written in (output, corrected, report):
        if written is not None:
            note(f"wrote {written}")


def _chemistry(given: str | None) -> ChemistryName | None:
    if given not in {None, "oxide", "lfp"}:
        raise InputError(
            "not a known chemistry", field="--chemistry", value=given, cure="use oxide or lfp"
        )
    return cast("ChemistryName | None", given)


def _write_corrected(path: Path, judgement: Judgement) -> None:
    import numpy as np
    import pyarrow as pa

    from cangauge.logs.canonical import write_table

    logs = judgement.logs
    unknown = [np.full(len(log), np.nan) for log in logs]
    published = [
        nan if log.soc_pct is None else log.soc_pct for log, nan in zip(logs, unknown, strict=True)
    ]
    columns = {
        "log": pa.array([log.name for log in logs for _ in range(len(log))]),
        "time_s": np.concatenate([log.time_s for log in logs]),
        "published_pct": np.concatenate(published),
        "corrected_pct": np.concatenate(judgement.corrected_pct),
        "corrected_std_pct": np.concatenate(judgement.corrected_std_pct),
    }
    write_table(columns, path)


def _show(judgement: Judgement) -> None:
    from cangauge.extras.judge.judgement import rows_of

    typer.echo(printable(judgement.headline))
    typer.echo(printable(f"Next step: {judgement.next_step}"))
    print_table("Answers", ["answer", "probability", "<size"], rows_of(judgement))
    if judgement.jumps:
        rows = [
            [judgement.logs[jump.log].name, number(jump.since_start_s, 0), number(jump.size_pct, 1)]
            for jump in judgement.jumps
        ]
        print_table("Jumps that the charge does not explain", ["log", "s", "% SoC"], rows)
