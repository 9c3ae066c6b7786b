"""`cangauge packs-check`: the estimator on recorded packs, with models from few logs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from cangauge.cli.options import JsonOption
from cangauge.cli.output import PlainConsole, console, emit_json
from cangauge.cli.shown import CASES, PACKS
from cangauge.errors import InputError


def packs_check_command(  # noqa: PLR0917 - typer passes options by name
    data: Annotated[
        Path,
        typer.Option(
            metavar="FOLDER",
            help="Folder with the recorded logs: bmw_i3, batic_car1, lg_hg2, leaf_module_ornl,"
            " a123_lfp, or some of them.",
        ),
    ],
    pack: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help=f"Pack; repeat for several: {', '.join(PACKS)}. Default: all that are there.",
        ),
    ] = None,
    case: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help=f"Case; repeat for several: {', '.join(CASES)}. Default: all.",
        ),
    ] = None,
    logs: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Number of training logs; repeat for several. Default: 1, 2,"
            " 3, 5 and 10, as far as the pack has them.",
        ),
    ] = None,
    splits: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Draws of training logs. Default: 2.")
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="The development packs alone, one draw, few logs and three cases: under two"
            " minutes on one core.",
        ),
    ] = False,
    effects: Annotated[
        str,
        typer.Option(metavar="ID,…|auto|none", help="Effects of the models, as for `fit`."),
    ] = "none",
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="Seed of the draws of training logs.")
    ] = 1,
    jobs: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Parallel processes. Default: one per core."),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Measure the SoC errors, and their σ, on recorded packs.

    Models are fitted to 1, 2, 3, 5 and 10 logs of a pack, drawn with a fixed seed, and the other
    logs are estimated with the start withheld, given or 20 % wrong, and with errors of the current
    sensor, the capacity and the voltage sensor. The table compares the filter with the Newton
    inverse and with counting, and judges its σ; targets that a row misses are named.

    A second table compares with what the logs show: the capacity learned over three charges, the
    current's offset, the current possible for 10 s, the energy left, and a weakened cell. The last
    case runs a model on other packs' logs: how often, and how soon, a mismatch is reported.

    Constants of the filter may be chosen on the `_dev` packs; all others are judged only.

    Examples
    --------
    `cangauge packs-check --data recorded --quick`

    `cangauge packs-check --data recorded --pack i3 --logs 5 --case withheld`

    `cangauge packs-check --data recorded --json > packs.json 2> packs.txt`
    """
    from cangauge.extras.validation import packs, packs_run
    from cangauge.extras.validation.packs_score import WIDTH, print_bench
    from cangauge.identify.effect_search import parse_effect_ids

    by_name = {each.name: each for each in packs_run.CASES}
    for name in case or ():
        if name not in by_name:
            raise InputError(
                "unknown case", field="--case", value=name, cure=f"use {', '.join(by_name)}"
            )
    names, sizes, chosen = pack, logs, case
    if quick:
        names, chosen = names or list(packs.DEVELOPMENT), chosen or list(packs_run.QUICK_CASES)
        sizes, splits = sizes or list(packs_run.QUICK_SIZES), splits or 1
    effect_ids = () if effects == "none" else parse_effect_ids([effects])
    found = packs.load(data, names)
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(),
        console=console,
    ) as progress:  # fmt: skip
        estimating = progress.add_task("fitting and estimating", total=None)
        bench = packs_run.run(
            found,
            cases=[by_name[name] for name in chosen or by_name],
            sizes=sizes,
            splits=splits or 2,
            judged_at_most=packs_run.QUICK_LOGS if quick else None,
            effects=effect_ids,
            jobs=jobs or os.cpu_count() or 1,
            seed=seed,
            progress=lambda done, total: progress.update(estimating, completed=done, total=total),
        )
    print_bench(bench, PlainConsole(stderr=json_output, highlight=False, width=WIDTH))
    if json_output:
        emit_json(bench.to_dict())
