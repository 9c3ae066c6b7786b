"""`cangauge gap-check`: causes drawn and sealed, diagnosed from the logs alone, scored."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from cangauge._formatting import duration
from cangauge._io import write_text_atomic
from cangauge.cli.options import JsonOption, ReportOption, check_outputs
from cangauge.cli.output import console, emit_json, note
from cangauge.errors import InputError
from cangauge.validation.cases import FULL, NEEDS_DATA, SMALL, Sizes, folder_of, open_set_of, plan
from cangauge.validation.cases import seconds_of as planned_seconds
from cangauge.validation.check import (
    OPEN_SET,
    Drawn,
    answers_before,
    diagnose_tasks,
    draw_all,
    drawn_before,
    later_of,
    outcomes_of,
    some_of,
)
from cangauge.validation.score import score
from cangauge.validation.tables import judge_targets, print_result
from cangauge.validation.twin.pybamm_plant import import_pybamm

FINAL_SEED = 8
"""Raised for each release's check: what one has shown may have shaped the next method."""

PROTOCOLS = (*FULL, OPEN_SET)


def gap_check_command(  # noqa: PLR0917 - typer passes options by name
    protocol: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help=f"What to check; repeat it. Of {', '.join(PROTOCOLS)}. Default: all that can run:"
            " pybamm needs the extra of that name, real-…, cold-… and hysteresis-… need --data.",
        ),
    ] = None,
    part: Annotated[
        str,
        typer.Option(
            metavar="full|small",
            help="How many cases; small takes about a minute and no recorded logs.",
        ),
    ] = "full",
    per_effect: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Cases of each effect instead.")
    ] = None,
    healthy: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Cases without a fault instead.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Of the draw. Default: 1.")
    ] = None,
    final: Annotated[
        bool,
        typer.Option(
            "--final",
            help="Draw from the seeds that are kept for a release's figures: once per release,"
            " never while the method is being changed.",
        ),
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder with the recorded logs: bmw_i3, lg_hg2, a123_lfp."
        ),
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Keep cases and answers here.")
    ] = None,
    cases: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Diagnose cases that --keep kept, and draw none."),
    ] = None,
    score_only: Annotated[
        bool, typer.Option("--score-only", help="With --cases: score the answers kept there.")
    ] = False,
    at_most: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Diagnose so many, drawn at random.")
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Processes at a time. Default: one a core."),
    ] = None,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Check the diagnosis on causes that it cannot see.

    Packs, drives, weather and faults are drawn at random and simulated by physics that shares
    nothing with the effects that `cangauge gap` knows, or faults are put into recorded logs. The
    causes go to a sealed file whose hash is printed first; processes that get the logs and the
    model alone diagnose them; then the file is opened and the answers are scored. Gaps are 0.5 to
    5 times what a model of training and reference days misses on further clean days.

    `simulated` is a pack of the twin's own physics, which the voltage model fits only roughly;
    `equation` one that obeys the published equation as long as it is healthy, by a core that the
    temperature sensor does not see; `published` one whose reported temperature is the core's.

    For example:

    `cangauge gap-check --part small`

    `cangauge gap-check --data recorded --report check.html --json > check.json`

    `cangauge gap-check --protocol simulated --per-effect 5 --healthy 50 --keep cases`

    `cangauge gap-check --cases cases --protocol simulated --at-most 60`
    """
    check_outputs([report], [])
    jobs = jobs or os.cpu_count() or 1
    with ExitStack() as stack:
        progress = stack.enter_context(_progress())
        if cases is None:
            if score_only:
                raise InputError("scores kept answers", field="--score-only", cure="add --cases")
            sizes = _sizes(protocol, part, per_effect, healthy, data)
            folder = _new_folder(keep) or Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="cases-"))
            )
            drawn = _draw(
                folder, sizes, progress, seed=seed, final=final, data=data, jobs=jobs,
                open_set=open_set_of(part, per_effect) if _wants(protocol, OPEN_SET) else 0,
            )  # fmt: skip
        else:
            _check_protocols(protocol)
            _refuse_with_cases(
                {
                    "--seed": seed is not None, "--final": final, "--keep": keep is not None,
                    "--per-effect": per_effect is not None, "--healthy": healthy is not None,
                    "--data": data is not None,
                }
            )  # fmt: skip
            drawn = drawn_before(cases)
        note(f"sealed causes: SHA-256 {drawn.sha256}")
        if drawn.about["final"]:
            note("these cases are drawn from the seeds kept for a release's figures")
        tasks = some_of([t for t in drawn.tasks if _wants(protocol, t.protocol)], at_most)
        began = time.perf_counter()
        if score_only:
            answers = answers_before(drawn)
            tasks = [task for task in tasks if task.id in answers]
            note(f"{len(tasks)} of {len(drawn.tasks)} diagnoses were kept")
        else:
            bar = progress.add_task("diagnosing", total=len(tasks))
            answers = diagnose_tasks(drawn, tasks, jobs, lambda n: progress.advance(bar, n))
        seconds = time.perf_counter() - began
        # A sample is of what could be drawn.
        outcomes = outcomes_of(drawn, tasks, answers, protocol if at_most is None else ())
        wanted = sum(task.wants_model for task in tasks)
        bar = progress.add_task("extended models", total=wanted, visible=wanted > 0)
        later = later_of(drawn, tasks, answers, lambda n: progress.advance(bar, n))
    result: dict[str, Any] = {
        "schema": 1,
        **drawn.about,
        "labels_sha256": drawn.sha256,
        "jobs": jobs,
        "diagnosing_seconds": None if score_only else seconds,
        **score(outcomes),
        "later": later,
        "cases": [item.to_dict() for item in outcomes],
    }
    result["targets"] = judge_targets(result)
    print_result(result, console)
    if report is not None:
        # Drawing is slow to import; the check does without.
        from cangauge.report.check import check_report  # noqa: PLC0415

        write_text_atomic(report, check_report(result))
        note(f"report: {report}")
    if json_output:
        emit_json(result)


def _draw(
    folder: Path,
    sizes: dict[str, Sizes],
    progress: Progress,
    *,
    seed: int | None,
    final: bool,
    data: Path | None,
    jobs: int,
    open_set: int,
) -> Drawn:
    if final and seed is not None:
        raise InputError("the final seeds are fixed", field="--final", cure="leave out --seed")
    chosen = FINAL_SEED if final else 1 if seed is None else seed
    groups = plan(sizes, seed=chosen, final=final)
    total = sum(len(group.cases) for group in groups)
    rough = duration(planned_seconds(sizes, open_set) / jobs)
    note(f"{total} cases of {', '.join(sizes)}: about {rough}, {jobs} at a time")
    bar = progress.add_task("drawing", total=total)
    return draw_all(
        groups,
        folder,
        data=data,
        jobs=jobs,
        open_set=open_set,
        about={"seed": chosen, "final": final},
        progress=lambda n: progress.advance(bar, n),
    )


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )


def _wants(protocol: Sequence[str] | None, name: str) -> bool:
    return protocol is None or name in protocol


def _refuse_with_cases(given: Mapping[str, bool]) -> None:
    for option, is_given in given.items():
        if is_given:
            raise InputError("these cases are drawn already", field=option, cure="leave it out")


def _new_folder(keep: Path | None) -> Path | None:
    if keep is None:
        return None
    if keep.exists() and (not keep.is_dir() or any(keep.iterdir())):
        raise InputError(
            "must be a new or empty folder", field="--keep", value=str(keep), cure="name another"
        )
    return keep


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
    _check_protocols(protocol)
    sizes = {}
    for name in table:
        if protocol is None and part == "small" and name in NEEDS_DATA:
            continue  # for every push: quick, and the same on a machine without recorded logs
        needed = name == "simulated" and _wants(protocol, OPEN_SET)
        if (_wants(protocol, name) or needed) and _can_run(name, data, asked=bool(protocol)):
            own = table[name]
            sizes[name] = replace(
                own,
                per_effect=own.per_effect
                if per_effect is None
                else per_effect * bool(own.per_effect),
                healthy=own.healthy if healthy is None else healthy * bool(own.healthy),
            )
    if not any(item.cases for item in sizes.values()):
        raise InputError("nothing to check", field="--protocol", cure="ask for more cases")
    return sizes


def _check_protocols(protocol: Sequence[str] | None) -> None:
    for name in protocol or ():
        if name not in PROTOCOLS:
            raise InputError(
                "no such protocol", field="--protocol", value=name,
                cure=f"use {', '.join(PROTOCOLS)}",
            )  # fmt: skip


def _can_run(name: str, data: Path | None, *, asked: bool) -> bool:
    """Whether a protocol has what it needs; raises if it was asked for by name."""
    try:
        if name == "pybamm":
            import_pybamm()
        if name in NEEDS_DATA:
            folder_of(name.partition("-")[2], data)
    except InputError as error:
        if asked:
            raise
        note(f"left out: {name} ({error})")
        return False
    return True
