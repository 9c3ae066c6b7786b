"""`cangauge gap-check`: causes drawn and sealed, diagnosed from the logs alone, scored."""

from __future__ import annotations

import os
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from cangauge.cli.inputs import JsonOption
from cangauge.cli.output import console, emit_json, note
from cangauge.errors import InputError
from cangauge.gapcheck.check import (
    OPEN_SET,
    answers_before,
    diagnose_tasks,
    draw_all,
    drawn_before,
    outcomes_of,
)
from cangauge.gapcheck.plan import FULL, SMALL, Sizes, plan
from cangauge.gapcheck.score import score
from cangauge.gapcheck.tables import print_figures

NEEDS_DATA = ("real-bmw_i3", "real-lg_hg2")


def gap_check_command(  # noqa: PLR0917 - typer passes options by name
    protocol: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help=f"{', '.join([*FULL, OPEN_SET])}; repeat it."),
    ] = None,
    part: Annotated[str, typer.Option(metavar="full|small", help="How many cases.")] = "full",
    per_effect: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Cases of each effect.")
    ] = None,
    healthy: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Cases without a fault.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of the draw.")] = 1,
    final: Annotated[
        bool, typer.Option("--final", help="Take the seeds kept for a release's figures.")
    ] = False,
    data: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Folder of the recorded logs.")
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Keep the cases in this new folder.")
    ] = None,
    cases: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Diagnose kept cases again.")
    ] = None,
    at_most: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Diagnose only so many, at random.")
    ] = None,
    score_only: Annotated[
        bool, typer.Option("--score-only", help="With --cases: score the answers kept there.")
    ] = False,
    jobs: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Processes. Default: the cores.")
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Check the diagnosis on causes that it cannot see."""
    jobs = jobs or len(os.sched_getaffinity(0))
    with ExitStack() as stack:
        progress = stack.enter_context(
            Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                console=console,
            )
        )
        if cases is None:
            folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cases-")))
            sizes = _sizes(protocol, part, per_effect, healthy, data)
            groups = plan(sizes, seed=seed, final=final)
            bar = progress.add_task("drawing", total=sum(len(group.cases) for group in groups))
            wants_open = protocol is None or OPEN_SET in protocol
            drawn = draw_all(
                groups,
                folder,
                data=data,
                jobs=jobs,
                open_set=(10 if part == "full" else 1) if wants_open else 0,
                about={"seed": seed, "final": final},
                progress=lambda n: progress.advance(bar, n),
            )
        else:
            drawn = drawn_before(cases)
        note(f"sealed causes: SHA-256 {drawn.sha256}")
        tasks = [t for t in drawn.tasks if protocol is None or t.protocol in protocol]
        if at_most is not None and at_most < len(tasks):
            chosen = np.random.default_rng(seed).permutation(len(tasks))[:at_most]
            tasks = [tasks[k] for k in sorted(chosen)]
        began = time.perf_counter()
        if score_only:
            answers = answers_before(drawn)
        else:
            bar = progress.add_task("diagnosing", total=len(tasks))
            answers = diagnose_tasks(drawn, tasks, jobs, lambda n: progress.advance(bar, n))
        seconds = time.perf_counter() - began
        outcomes = outcomes_of(drawn, tasks, answers)
    figures = score(outcomes)
    result = {
        "schema": 1,
        **drawn.about,
        "labels_sha256": drawn.sha256,
        "jobs": jobs,
        "diagnosing_seconds": None if score_only else seconds,
        **figures,
        "cases": [item.to_dict() for item in outcomes],
    }
    print_figures(figures, console)
    if json_output:
        emit_json(result)


def _sizes(
    protocol: list[str] | None,
    part: str,
    per_effect: int | None,
    healthy: int | None,
    data: Path | None,
) -> dict[str, Sizes]:
    table = {"full": FULL, "small": SMALL}.get(part)
    if table is None:
        raise InputError("no such part", field="--part", value=part, cure="use full or small")
    wanted = [name for name in table if data is not None or name not in NEEDS_DATA]
    if protocol is not None:
        for name in protocol:
            if name not in {*table, OPEN_SET}:
                raise InputError(
                    "no such protocol",
                    field="--protocol",
                    value=name,
                    cure=f"use {', '.join([*table, OPEN_SET])}",
                )
        wanted = [name for name in table if name in protocol]
        if OPEN_SET in protocol and "simulated" not in wanted:
            wanted.append("simulated")
    sizes = {name: table[name] for name in wanted}
    for name, item in sizes.items():
        if per_effect is not None and item.per_effect:
            sizes[name] = replace(sizes[name], per_effect=per_effect)
        if healthy is not None and item.healthy:
            sizes[name] = replace(sizes[name], healthy=healthy)
    return sizes
