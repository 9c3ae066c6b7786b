"""`cangauge gap-check`: what the diagnosis would find on a pack."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from cangauge.cli.options import (
    CELLS,
    CapacityAh,
    Json,
    ReadingOptions,
    argument,
    assumed_of,
    command,
    option,
)
from cangauge.cli.output import finish, note, print_table, progress
from cangauge.errors import InputError


@command("dbc", "columns", "sign", "temperature")
def gap_check_command(
    logs: Annotated[
        list[Path] | None,
        argument(
            "[LOG]…",
            "At least four logs of yours without a fault. Also give --capacity-ah and --cells."
            " Headings are recognised, or named by [columns] of the map file. Default: a"
            " simulated pack.",
        ),
    ] = None,
    *,
    capacity_ah: CapacityAh = None,
    cells: Annotated[int, CELLS] = 96,
    at_most: Annotated[
        int | None,
        option("--at-most", "N", "Diagnose at most N of the logs.", within=(1, math.inf)),
    ] = None,
    reading: ReadingOptions,
    json_output: Json = False,
) -> None:
    """Inject every effect into healthy logs of a pack, and count how often `gap` finds it.

    Each log is diagnosed in turn, with the other logs as references. It is diagnosed as it is, and
    with every effect at three sizes: one, two and four times the voltage error of left-out
    references. The table shows how often the right one of the nine faults ranked first, and how
    often a fault stated alone was right.

    Examples
    --------
    `cangauge gap-check mine/*.csv --capacity-ah 60 --cells 96`

    `cangauge gap-check --at-most 2`
    """
    from cangauge.extras.validation import gap_check
    from cangauge.extras.validation.twin.faults import FAULT_KINDS
    from cangauge.extras.validation.twin.injection import fit_surrogate_pack

    read = [reading.load(path) for path in logs or []]
    if not read:
        healthy, pack = gap_check.simulated_logs()
    elif capacity_ah is None:
        problem, cure = "unknown capacity of the pack", "give it in Ah"
        raise InputError(problem, field="--capacity-ah", cure=cure)
    else:
        healthy, pack = read, fit_surrogate_pack(read, capacity_ah=capacity_ah, cells=cells)
    each = 1 + len(gap_check.FLOORS) * len(FAULT_KINDS)
    note(f"at most {each} diagnoses of each log left out, about half a second each")
    findings = []
    with progress() as show_line:
        for finding in gap_check.find(healthy, pack, at_most):
            findings.append(finding)
            show_line(f"{len(findings)} diagnoses")
    result = gap_check.summarize(findings)

    def show() -> None:
        typer.echo(gap_check.summary(result))
        print_table("Right fault first, stated alone and right", *gap_check.table(result))

    finish(result | {"assumed": assumed_of(read)}, show, as_json=json_output)
