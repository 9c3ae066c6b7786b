"""`cangauge judge`: a second opinion on the SoC that a battery gauge publishes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cangauge._files import write_texts_atomic
from cangauge._text import number
from cangauge.cli.options import (
    CELLS,
    CHEMISTRY,
    MODEL,
    CapacityAh,
    Json,
    ReadingOptions,
    Report,
    argument,
    check_outputs,
    command,
    option,
)
from cangauge.cli.output import finish, print_table, progress, say
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.extras.judge.result import Judgement


@command()
def judge_command(
    logs: Annotated[
        list[str], argument("LOG", "Logs or captures in order of time, with the published SoC.")
    ],
    *,
    model: Annotated[Path | None, MODEL] = None,
    chemistry: Annotated[Literal["oxide", "lfp"] | None, CHEMISTRY] = None,
    cells: Annotated[int | None, CELLS] = None,
    capacity_ah: CapacityAh = None,
    output: Annotated[
        Path | None,
        option(
            "-o, --output",
            "MODEL.json",
            "Write the model, narrowed by these logs.",
            suffixes=(".json",),
        ),
    ] = None,
    corrected: Annotated[
        Path | None,
        option(
            "--corrected",
            "FILE.csv|.parquet",
            "Write published and corrected SoC of every row.",
            suffixes=(".csv", ".parquet"),
        ),
    ] = None,
    suite: Annotated[
        bool, option("--suite", "", "Play drives with faults to the gauge that is started by LOG …")
    ] = False,
    data: Annotated[
        Path | None,
        option(
            "--data",
            "FOLDER",
            "With --suite: recorded logs of the model's pack, with their true SoC, in place of the"
            " simulated ones.",
        ),
    ] = None,
    reading: ReadingOptions,
    report: Report = None,
    json_output: Json = False,
) -> None:
    """Judge the SoC that a battery gauge publishes: is it right, since when not, and why.

    Give logs of one pack, best of several days, with the published SoC as soc_pct. Charging and
    driving between the logs need not be recorded. The answer has three lines: the present error of
    the gauge; earlier errors and their cause; what to do next. If the logs do not suffice, the
    answer states this. Positive current discharges. Without a model, give --chemistry and --cells.
    Without a capacity, it is found from the counted charge per 100 % of published SoC.

    FILE has one row per sample: log, time_s [s], published_pct, corrected_pct and
    corrected_std_pct [%].

    Examples
    --------
    `cangauge judge monday.csv tuesday.csv wednesday.csv -m pack.json --report judge.html`

    `cangauge judge day*.csv --chemistry lfp --cells 16 --capacity-ah 280 --corrected soc.csv`

    With --suite, twelve simulated drives are played to a gauge program, each with twenty faults of
    the counted charge. The result is a score card. The command that starts the program follows
    `--`. In this command, {interface}, {channel}, {port}, {model}, {capacity_ah} and {soc} are
    replaced for each run.

    `cangauge judge --suite -- cangauge run --interface {interface} --channel {channel} --bus-option
    port={port} -m {model} --initial-soc {soc} --time-source replay-clock`
    """
    from cangauge.extras.judge.judgement import judge, narrowed
    from cangauge.model.model_file import Model

    if suite:
        _suite(logs, model, data, json_output=json_output)
        return
    if data is not None:
        raise InputError("belongs to --suite", field="--data", cure="give the logs themselves")
    paths = [Path(log) for log in logs]
    check_outputs([output, corrected, report], [*paths, *([model] if model else [])])
    with progress() as show:
        loaded = reading.load_all(paths, show)
    pack = None if model is None else Model.load(model)
    judgement = judge(
        loaded,
        pack,
        chemistry=chemistry,
        cells=cells,
        capacity_ah=capacity_ah,
        cell_voltages=[reading.cells_of(log) for log in loaded],
    )
    texts = {}
    if output is not None:
        texts[output] = narrowed(judgement).to_json()
    if report is not None:
        from cangauge.extras.judge.page import judge_page

        texts[report] = judge_page(judgement, model).html()
    write_texts_atomic(texts)
    if corrected is not None:
        _write_corrected(corrected, judgement)
    files = {"corrected": corrected, "narrowed": output, "report": report}
    finish(judgement.to_dict(), partial(say, judgement.text), files, as_json=json_output)


def _suite(
    started_by: Sequence[str], model: Path | None, data: Path | None, *, json_output: bool
) -> None:
    """Play the suite to a gauge, and print its score card."""
    from cangauge.extras.judge.suite import recorded_drives, run_suite, simulated_drives
    from cangauge.model.model_file import Model

    if (model is None) != (data is None):
        raise InputError("give both, or neither", field="--data/-m", cure="recorded: both")
    with progress() as show:
        show("making the drives")
        drives = (
            simulated_drives()
            if model is None or data is None
            else recorded_drives(sorted(data.iterdir()), Model.load(model))
        )
        scores = run_suite(started_by, drives, show=show)
    columns = {
        "MAE [%]": ("mae_pct", 1.0, 2),
        "worst [%]": ("worst_pct", 1.0, 1),
        "jumps/h": ("jumps_per_h", 1.0, 1),
        "within 5 % after [min]": ("recovery_s", 1.0 / 60.0, 0),
        "within 2σ [%]": ("cover_2sigma", 100.0, 0),
        "silent [%]": ("silent", 100.0, 0),
    }
    head, rows = ["fault", *columns], []
    for score in scores:
        row = [score["fault"]]
        for name, scale, digits in columns.values():
            value = score[name]
            row.append("never" if value == math.inf else number(value and scale * value, digits))
        rows.append(row)
    result = {"schema": 1, "gauge": " ".join(started_by), "scores": scores}
    finish(result, partial(print_table, f"{len(drives)} drives", head, rows), as_json=json_output)


def _write_corrected(path: Path, judgement: Judgement) -> None:
    import numpy as np
    import pyarrow as pa

    from cangauge.logs.canonical import write_table

    logs = judgement.logs
    columns = {
        "log": pa.array([log.name for log in logs for _ in range(len(log))]),
        "time_s": np.concatenate([log.time_s for log in logs]),
        "published_pct": np.concatenate(judgement.published_pct),
        "corrected_pct": np.concatenate(judgement.corrected_pct),
        "corrected_std_pct": np.concatenate(judgement.corrected_std_pct),
    }
    write_table(columns, path)
