"""`cangauge fleet`: the answer of a command on each of many logs, as one table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from cangauge._text import NONE_KNOWN, number
from cangauge.cli.options import (
    MODEL,
    Json,
    ReadingOptions,
    argument,
    check_outputs,
    command,
    option,
)
from cangauge.cli.output import finish, note, print_table, progress, say
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.extras.fleet.rows import Row

_SHOWN: Final = {
    "estimate": {
        "SoC MAE [%]": "soc_mae_pct",
        "voltage MAE [%]": "voltage_mae_pct",
        "valid part": "valid_fraction",
    },
    "gap": {
        "answer": "answer.level",
        "fault": "answer.stated",
        "P(none)": "answer.probability_none",
        "check first": "answer.check_first",
    },
    "judge": {
        "verdict": "now.verdict",
        "error [%]": "now.error_pct",
        "± [%]": "now.sigma_pct",
        "next step": "next_step",
    },
}
"""Headings and columns that are printed; the table has all."""
_SHOWN_ROWS: Final = 20
"""Logs and reasons that are printed; the table has all."""


@command("dbc", "temperature")
def fleet_command(
    answer: Annotated[
        Literal["estimate", "gap", "judge"],
        argument("estimate|gap|judge", "Command to run on each log."),
    ],
    logs: Annotated[list[Path], argument("LOG", "Logs or captures.")],
    *,
    model: Annotated[Path, MODEL],
    output: Annotated[
        Path, option("-o, --output", "OUT.parquet", "Table to write.", suffixes=(".parquet",))
    ],
    reference: Annotated[
        list[Path] | None,
        option(
            "--reference",
            "LOG",
            "For gap: log without a fault, of any of the vehicles. Repeat the option for more"
            " logs.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        option(
            "--scheduler",
            "ADDRESS",
            "Dask scheduler, e.g. tcp://10.0.0.5:8786, for more than a thousand logs. Needs the"
            " extra `fleet`.",
        ),
    ] = None,
    reading: ReadingOptions,
    json_output: Json = False,
) -> None:
    """Estimate, diagnose or judge each of many logs: one Parquet table, with one row per log.

    The columns are the numbers of the command's `--json`, with dotted names. If a log fails, its
    row has the error. The rows are computed by one process per core, or by the workers of a Dask
    scheduler. The workers must see the same files.

    Examples
    --------
    `cangauge fleet estimate may/*/*.parquet -m type.json -o may.parquet`

    `cangauge fleet gap may*.csv --reference good1.csv --reference good2.csv -m type.json -o
    gaps.parquet`

    `cangauge fleet judge day*.csv -m pack.json -o judged.parquet --scheduler tcp://10.0.0.5:8786`
    """
    from cangauge.extras.fleet.rows import FleetJob, run, write_rows
    from cangauge.model.model_file import Model

    references = tuple(reference or ())
    if references and answer != "gap":
        cure = "leave it out"
        raise InputError(f"is of no use to {answer}", field="--reference", cure=cure)
    check_outputs([output], [*logs, *references, model])
    Model.load(model)  # a wrong one would be an error of every log
    job = FleetJob(answer, model, reading, references)
    rows = []
    with progress() as show:
        for row in run(job, logs, scheduler):
            rows.append(row)
            show(f"{len(rows)} of {len(logs)} logs")
    rows.sort(key=itemgetter("log"))
    write_rows(rows, output)
    bad = [row for row in rows if row["error"] is not None]
    result = {"logs": len(rows), "failed": len(bad)}
    finish(result, partial(_show, answer, rows, bad), {"output": output}, as_json=json_output)
    if len(bad) == len(rows):
        note("error: no log gave an answer")
        raise typer.Exit(1)


def _show(answer: str, rows: Sequence[Row], bad: Sequence[Row]) -> None:
    """Print how many logs have an answer, the first ones, and why the others failed."""
    say(f"{len(rows) - len(bad)} of {len(rows)} logs have an answer.")
    good = [row for row in rows if row["error"] is None][:_SHOWN_ROWS]
    if good:
        shown = _SHOWN[answer]
        cells = [
            [Path(row["log"]).name, *(_cell(row.get(name)) for name in shown.values())]
            for row in good
        ]
        print_table(answer, ["log", *shown], cells)
    reasons = Counter(row["error"].removeprefix(f"{row['log']}: ") for row in bad)
    for reason, count in reasons.most_common(_SHOWN_ROWS):
        note(f"failed: {count} × {reason}")


def _cell(value: Any) -> str:
    """Return a value as text; a list is one of names in JSON."""
    if value is None:
        return NONE_KNOWN
    if isinstance(value, int | float):
        return number(value, 2)
    names = json.loads(value) if value.startswith("[") else [value]
    return ", ".join(name.replace("_", " ") for name in names) or NONE_KNOWN
