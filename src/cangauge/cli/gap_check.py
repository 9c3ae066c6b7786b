"""`cangauge gap-check`: score the diagnosis on withheld causes."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from cangauge.cli.options import (
    JsonOption,
    Reading,
    ReportOption,
    check_outputs,
    option_groups,
)
from cangauge.cli.output import console, emit_json, note
from cangauge.cli.own_logs import OwnLogsOptions
from cangauge.cli.shown import PROTOCOLS
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.extras.validation.plan import Sizes


@option_groups("temperature_source")
def gap_check_command(  # noqa: PLR0917 - typer passes options by name
    own: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG]…",
            help="Your own logs without a fault: every effect is injected into them instead.",
        ),
    ] = None,
    own_logs: Annotated[
        bool, typer.Option("--logs", help="Check on the given LOGs, each left out in turn.")
    ] = False,
    reference: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG", help="With LOGs: a further log without a fault; repeatable."),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            "-m",
            "--model",
            metavar="MODEL",
            help="With LOGs: model file. Default: fitted to all LOGs but the one left out.",
        ),
    ] = None,
    capacity_ah: Annotated[
        float | None,
        typer.Option(metavar="A", help="With LOGs: charge from 100 to 0 % [Ah]."),
    ] = None,
    protocol: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help=f"Protocol to run; repeat for several: {', '.join(PROTOCOLS)}. Default: all that"
            " can run; pybamm needs its extra, real-…, cold-… and hysteresis-… need --data.",
        ),
    ] = None,
    part: Annotated[
        str,
        typer.Option(
            metavar="full|small",
            help="Number of cases; small takes about a minute and no recorded logs.",
        ),
    ] = "full",
    per_effect: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Cases of each effect.")
    ] = None,
    healthy: Annotated[int | None, typer.Option(metavar="N", min=0, help="Healthy cases.")] = None,
    seed: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Seed of the plan. Default: 1.")
    ] = None,
    final: Annotated[
        bool,
        typer.Option(
            "--final",
            help="Use the frozen seeds of the published figures; never while the method is being"
            " changed.",
        ),
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder with the recorded logs: bmw_i3, lg_hg2, a123_lfp."
        ),
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Keep cases and answers in this folder.")
    ] = None,
    cases: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Diagnose the cases of a kept folder; draw none."),
    ] = None,
    score_only: Annotated[
        bool,
        typer.Option("--score-only", help="With --cases: score the kept answers; diagnose none."),
    ] = False,
    at_most: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Diagnose at most this many, drawn at random; of LOGs: leave out at most as many.",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Parallel processes. Default: one per core."),
    ] = None,
    *,
    reading: Reading,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Measure how often `gap` finds the right cause, on withheld causes.

    Packs, drives, weather and faults are drawn at random and simulated by physics independent of
    the effects library, or faults are injected into recorded logs. The causes are written to a
    label file, whose hash is printed first; processes that see only logs and model diagnose the
    cases; the answers are then scored against the labels. Gaps are 0.5 to 5 times the error of a
    model on healthy logs.

    `simulated` packs fit the voltage equation only roughly. `equation` packs obey it while healthy,
    by a core temperature that the sensor does not measure; `published` packs report that
    temperature.

    With LOGs: injects every effect at three sizes into your own logs without a fault, diagnoses
    each with the others as references, and reports what this diagnosis would find on this pack.

    Examples
    --------
    `cangauge gap-check --part small`

    `cangauge gap-check --data recorded --report check.html --json > check.json`

    `cangauge gap-check --protocol simulated --per-effect 5 --healthy 50 --keep cases`

    `cangauge gap-check --cases cases --protocol simulated --at-most 60`

    `cangauge gap-check --logs mine/*.csv -m pack.json --report mine.html`
    """
    from cangauge.extras.validation.check import (
        OPEN_SET,
        diagnose_tasks,
        draw_all,
        evaluate_held_out,
        load_answers,
        load_files,
        sample_tasks,
        score_answers,
    )
    from cangauge.extras.validation.final_seeds import FINAL_SEED
    from cangauge.extras.validation.plan import estimated_seconds, open_set_size, plan
    from cangauge.extras.validation.score import score
    from cangauge.extras.validation.tables import judge_targets

    _refuse_mixed(
        own=own is not None or own_logs,
        for_drawn={
            "--protocol": protocol, "--per-effect": per_effect, "--healthy": healthy,
            "--seed": seed, "--final": final or None, "--data": data, "--keep": keep,
            "--cases": cases, "--score-only": score_only or None,
        },
        for_own={"--reference": reference, "--model": model, "--capacity-ah": capacity_ah},
    )  # fmt: skip
    if own is not None or own_logs:
        OwnLogsOptions(
            own or [], reference or [], model, capacity_ah, at_most, report, json_output
        ).check(reading.load, _progress())
        return
    check_outputs([report], [])
    jobs = jobs or os.cpu_count() or 1
    with ExitStack() as stack:
        progress = stack.enter_context(_progress())
        if cases is None:
            _refuse({"--score-only": score_only}, "it needs kept answers (--cases)")
            sizes = _sizes(protocol, part, per_effect, healthy, data)
            _refuse({"--seed": final and seed is not None}, "the final seeds are fixed")
            folder = _new_folder(keep) or Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="cases-"))
            )
            plan_seed = FINAL_SEED if final else 1 if seed is None else seed
            groups = plan(sizes, seed=plan_seed, final=final)
            open_set = open_set_size(part, per_effect) if _wants(protocol, OPEN_SET) else 0
            total = sum(len(group.cases) for group in groups)
            rough = duration(estimated_seconds(sizes, open_set) / jobs)
            note(f"{total} cases of {', '.join(sizes)}: about {rough} with {jobs} processes")
            drawing = progress.add_task("drawing", total=total)
            files = draw_all(
                groups,
                folder,
                data=data,
                jobs=jobs,
                open_set=open_set,
                about={"seed": plan_seed, "final": final},
                progress=lambda n: progress.advance(drawing, n),
            )
        else:
            _check_protocols(protocol)
            _refuse(
                {
                    "--seed": seed is not None, "--final": final, "--keep": keep is not None,
                    "--per-effect": per_effect is not None, "--healthy": healthy is not None,
                    "--data": data is not None,
                },
                "the cases are drawn already",
            )  # fmt: skip
            files = load_files(cases)
        note(f"withheld causes: SHA-256 {files.sha256}")
        if files.about["final"]:
            note("these cases have the seeds of the published figures")
        tasks = sample_tasks([t for t in files.tasks if _wants(protocol, t.protocol)], at_most)
        began = time.perf_counter()
        if score_only:
            answers = load_answers(files)
            tasks = [task for task in tasks if task.id in answers]
            note(f"{len(tasks)} of {len(files.tasks)} diagnoses were kept")
        else:
            diagnosing = progress.add_task("diagnosing", total=len(tasks))
            answers = diagnose_tasks(files, tasks, jobs, lambda n: progress.advance(diagnosing, n))
        seconds = time.perf_counter() - began
        # A sample is drawn from the cases that could be drawn.
        outcomes = score_answers(files, tasks, answers, protocol if at_most is None else ())
        models = sum(task.wants_model for task in tasks)
        evaluating = progress.add_task("held-out logs", total=models, visible=models > 0)
        held_out = evaluate_held_out(
            files, tasks, answers, lambda n: progress.advance(evaluating, n)
        )
    result: dict[str, Any] = {
        "schema": 1,
        **files.about,
        "labels_sha256": files.sha256,
        "jobs": jobs,
        "diagnosing_seconds": None if score_only else seconds,
        **score(outcomes),
        "later": held_out,
        "cases": [item.to_dict() for item in outcomes],
    }
    result["targets"] = judge_targets(result)
    _show(result, report, json_output=json_output)


def _show(result: dict[str, Any], report: Path | None, *, json_output: bool) -> None:
    from cangauge.extras.validation.tables import print_result

    print_result(result, console)
    if report is not None:
        # Slow to import.
        from cangauge.extras.report.check import check_report

        write_text_atomic(report, check_report(result))
        note(f"report: {report}")
    if json_output:
        emit_json(result)


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


def _refuse(given: dict[str, bool], reason: str) -> None:
    """Raise InputError for the first option that is given."""
    for option, is_given in given.items():
        if is_given:
            raise InputError(reason, field=option, cure="leave it out")


def _refuse_mixed(*, own: bool, for_drawn: dict[str, Any], for_own: dict[str, Any]) -> None:
    """Raise InputError for an option of the other check: drawn cases, or one's own logs."""
    given = {name: value is not None for name, value in (for_drawn if own else for_own).items()}
    _refuse(given, "nothing is drawn for your own logs" if own else "it needs your own LOGs")


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
    from cangauge.extras.validation.check import OPEN_SET
    from cangauge.extras.validation.plan import FULL, NEEDS_DATA, SMALL

    table = {"full": FULL, "small": SMALL}.get(part)
    if table is None:
        raise InputError("unknown part", field="--part", value=part, cure="use full or small")
    _check_protocols(protocol)
    sizes = {}
    for name in table:
        if protocol is None and part == "small" and name in NEEDS_DATA:
            continue  # quick, and the same cases with and without recorded logs
        needed = name == "simulated" and _wants(protocol, OPEN_SET)
        if (_wants(protocol, name) or needed) and _can_run(name, data, required=bool(protocol)):
            usual = table[name]
            changes = {"per_effect": per_effect, "healthy": healthy}
            sizes[name] = replace(
                usual,
                **{
                    key: number
                    for key, number in changes.items()
                    if number is not None and getattr(usual, key)
                },
            )
    if not any(item.cases for item in sizes.values()):
        raise InputError("no cases to draw", field="--protocol", cure="ask for more cases")
    return sizes


def _check_protocols(protocol: Sequence[str] | None) -> None:
    for name in protocol or ():
        if name not in PROTOCOLS:
            raise InputError(
                "unknown protocol", field="--protocol", value=name,
                cure=f"use {', '.join(PROTOCOLS)}",
            )  # fmt: skip


def _can_run(name: str, data: Path | None, *, required: bool) -> bool:
    """Whether a protocol can run here; raise InputError if it is required."""
    from cangauge.extras.validation.plan import NEEDS_DATA
    from cangauge.extras.validation.recordings import folder_of
    from cangauge.extras.validation.twin.pybamm_plant import import_pybamm

    try:
        if name == "pybamm":
            import_pybamm()
        if name in NEEDS_DATA:
            folder_of(name.partition("-")[2], data)
    except InputError as error:
        if required:
            raise
        note(f"skipped: {name} ({error})")
        return False
    return True
