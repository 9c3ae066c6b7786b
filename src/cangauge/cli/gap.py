"""`cangauge gap`: what a model misses on logs, where, which effect, how far it shrinks."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from cangauge._formatting import NONE_KNOWN, number, significant
from cangauge._io import atomic_path
from cangauge.cli.options import (
    DbcOption,
    JsonOption,
    MapOption,
    ReportOption,
    TemperatureOption,
    TemperatureSourceOption,
    VehicleOption,
    check_outputs,
    load_log,
    within,
)
from cangauge.cli.output import emit_json, note, print_table
from cangauge.diagnosis import NONE, UNKNOWN, Diagnosis, diagnose
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.model_file import Model, load_model, model_json
from cangauge.report.tables import verdict_limit

SHOWN = 5
SHORTEST_S = 300.0
"""A log shorter than this shows nothing but its start [s]."""


def gap_command(  # noqa: PLR0917 - typer passes options by name
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG", help="Logs that the model does not explain; one cause."),
    ],
    model: Annotated[Path, typer.Option("-m", "--model", metavar="MODEL", help="Model file.")],
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="LOG",
            help="A log on which the model is good; repeat it. It tells its SoC (soc_pct), at least"
            " at its start, or starts full.",
        ),
    ] = None,
    initial_soc: Annotated[
        float | None,
        typer.Option(metavar="P", help="SoC at each diagnosed log's first row [%]."),
    ] = None,
    capacity_ah: Annotated[
        float | None,
        typer.Option(
            metavar="A", help="Capacity instead of the model's, for all logs and --extended [Ah]."
        ),
    ] = None,
    extended: Annotated[
        Path | None, typer.Option(metavar="MODEL", help="Write the extended model here.")
    ] = None,
    vehicle: VehicleOption = None,
    dbc: DbcOption = None,
    map_file: MapOption = None,
    temperature: TemperatureOption = None,
    temperature_source: TemperatureSourceOption = None,
    report: ReportOption = None,
    json_output: JsonOption = False,
) -> None:
    """Diagnose the gap between a model and logs: where, which effect, how far it shrinks.

    The verdict is an effect, `none` (no gap beyond what the references show) or `unknown` (a gap
    of which no effect in the library is likely to be the cause). It is early work: the README says
    how often it is right. Give at least three references, more are better; without any, the error
    that the model file states is what is expected of logs without a cause. Logs of 10 minutes and
    more can be judged, better of an hour, with changing load and SoC. Positive current discharges.

    For example:

    `cangauge gap cold1.csv cold2.csv -m pack.json --reference mild1.csv --reference mild2.csv
    --reference mild3.csv --report gap.html --extended cold.json`
    """
    given = list(reference or [])
    _check_apart(logs, given)
    check_outputs([report, extended], [*logs, *given, model])
    model_file = load_model(model)
    if initial_soc is not None:
        within(initial_soc, 0.0, 100.0, option="--initial-soc", unit="%")
    if capacity_ah is not None:
        model_file = _with_capacity(model_file, capacity_ah)

    def read(path: Path) -> Log:
        return load_log(
            path,
            vehicle=vehicle,
            dbc=dbc,
            map_file=map_file,
            temperature_c=temperature,
            temperature_source=temperature_source,
            refuse_turned=True,
        )

    diagnosed = [_long_enough(read(path)) for path in logs]
    references = [read(path) for path in given]
    found = diagnose(diagnosed, model_file, references, initial_soc_pct=initial_soc, progress=note)
    with ExitStack() as stack:
        if extended is not None:
            text = model_json(found.extended_model)
            stack.enter_context(atomic_path(extended)).write_text(text)
        if report is not None:
            # Drawing is slow to import; the diagnosis does without.
            from cangauge.report.diagnosis import gap_report  # noqa: PLC0415

            stack.enter_context(atomic_path(report)).write_text(gap_report(found))
    if json_output:
        emit_json(found.to_dict(None if extended is None else str(extended)))
        return
    _show(found)
    for written in (extended, report):
        if written is not None:
            note(f"wrote {written}")


def _with_units(parameters: Mapping[str, dict[str, Any]]) -> str:
    """Return parameters with their 95 % intervals, where they have any."""
    said = []
    for name, told in parameters.items():
        unit = "" if told["unit"] == "1" else f" {told['unit']}"
        within = ""
        if told["ci"] is not None:
            low, high = (significant(value, 3) for value in told["ci"])
            within = f" ({low} … {high})"
        said.append(f"{name} {significant(told['value'], 3)}{unit}{within}")
    return ", ".join(said)


def _check_apart(logs: list[Path], references: list[Path]) -> None:
    known = {path.resolve() for path in references}
    for path in logs:
        if path.resolve() in known:
            raise InputError(
                "is a LOG and a reference: what it shows would be clean and a gap at once",
                source=path,
                field="--reference",
                cure="give it as one of them",
            )


def _with_capacity(model: Model, capacity_ah: float) -> Model:
    within(capacity_ah, 1e-3, 1e5, option="--capacity-ah", unit="Ah")
    return model.model_copy(update={"capacity_ah": capacity_ah})


def _long_enough(log: Log) -> Log:
    if log.duration_s < SHORTEST_S:
        raise InputError(
            f"{log.duration_s:.0f} s of data show nothing but the start: nothing can be concluded",
            source=log.source or log.name,
            cure=f"give a log of at least {SHORTEST_S / 60.0:.0f} min, better half an hour with"
            " changing load and SoC",
        )
    return log


def _show(found: Diagnosis) -> None:
    typer.echo(found.summary)
    if open_question := verdict_limit(found):
        typer.echo(open_question)
    rows = []
    for item in found.candidates[:SHOWN]:
        closed = item["closed_fraction"]
        rows.append(
            [
                str(item["effect"]),
                f"{item['probability']:.2f}",
                number(item["log_bayes_factor"], 1),
                number(item["rmse_v"], 2),
                NONE_KNOWN if closed is None else f"{100.0 * closed:.0f} %",
            ]
        )
    for answer in (UNKNOWN, NONE):
        chance = f"{found.verdict.probabilities[answer]:.2f}"
        rows.append([answer, chance, NONE_KNOWN, NONE_KNOWN, NONE_KNOWN])
    headings = ["effect", "probability", "evidence [ln]", "left [V]", "closed"]
    print_table("Candidates; error left, and gap closed, on rows held out", headings, rows)
    for item in found.candidates:
        if item["effect"] in found.extension.cause:
            typer.echo(f"{item['effect']}: {_with_units(item['parameters'])}")
    if found.caveats:
        typer.echo("What these logs cannot show:")
    for sentence in found.caveats:
        typer.echo(f"- {sentence}")
