"""`cangauge gap`: diagnose the gap between a model and logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cangauge._formatting import NONE_KNOWN, number, printable
from cangauge._io import write_texts_atomic
from cangauge.cli.options import (
    ColumnsOption,
    DbcOption,
    FiguresOption,
    JsonOption,
    MapOption,
    ReportOption,
    SignOption,
    TemperatureOption,
    TemperatureSourceOption,
    VehicleOption,
    assumed_of,
    check_outputs,
    load_log,
    within,
)
from cangauge.cli.output import emit_json, note, print_table, progress_shown, save_figures
from cangauge.cli.simulator import SimulatorOptions, corrected_path, write_corrected
from cangauge.diagnosis import ALARM_BELOW, NONE, UNKNOWN, Diagnosis, diagnose
from cangauge.diagnosis.simulator import SimulatorDiagnosis, diagnose_simulator
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import difference_from_reference
from cangauge.model.model_file import Model
from cangauge.report.summary import headline, next_step, open_question, parameters_text

SHOWN_CANDIDATES = 5
SHORTEST_S = 300.0
"""Shortest log to diagnose [s]; a shorter one is mostly transient."""


def gap_command(  # noqa: PLR0917 - typer passes options by name
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG", help="Logs to diagnose; one cause is sought for all."),
    ],
    model: Annotated[
        Path | None,
        typer.Option(
            "-m", "--model", metavar="MODEL", help="Model file; not needed for a simulator."
        ),
    ] = None,
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="LOG",
            help="Log without a fault; repeat the option. Without soc_pct its start is found from"
            " the voltage.",
        ),
    ] = None,
    initial_soc: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="SoC at the first row of each diagnosed log [%], e.g. 80. Default: its soc_pct,"
            " else found from the voltage.",
        ),
    ] = None,
    capacity_ah: Annotated[
        float | None,
        typer.Option(
            metavar="A", help="Charge from 100 to 0 % [Ah], in place of the model's, for all logs."
        ),
    ] = None,
    extended: Annotated[
        Path | None,
        typer.Option(metavar="MODEL", help="Write the model, extended by the cause, to this file."),
    ] = None,
    simulated: Annotated[
        str | None,
        typer.Option(
            metavar="HEADING",
            help="Column of every log with a simulator's voltage for the same current and"
            " temperature: what it misses is diagnosed, in place of a model's gap.",
        ),
    ] = None,
    simulator: Annotated[
        str | None,
        typer.Option(
            metavar="MODULE:FUNCTION",
            help="The same by a Python function, also FILE.py:FUNCTION, called with time [s],"
            " current [A, positive = discharge], temperature [°C], SoC of the first row [%]; it"
            " returns the voltage [V].",
        ),
    ] = None,
    corrected: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="With a simulator: write each LOG with its simulated and corrected voltage to"
            " FOLDER/NAME.corrected.csv.",
        ),
    ] = None,
    alarm: Annotated[
        float,
        typer.Option(
            "--alarm",
            metavar="P",
            help="Report a fault where the probability of none is at most this.",
        ),
    ] = ALARM_BELOW,
    vehicle: VehicleOption = None,
    dbc: DbcOption = None,
    map_file: MapOption = None,
    columns: ColumnsOption = None,
    sign: SignOption = None,
    temperature: TemperatureOption = None,
    temperature_source: TemperatureSourceOption = None,
    report: ReportOption = None,
    figures: FiguresOption = None,
    json_output: JsonOption = False,
) -> None:
    """Diagnose the gap between a model and logs: size, place, probable cause.

    The verdict is the most probable of `none`, the effects and `unknown` (a gap without a likely
    cause in the library); the alarm is the probability of `none` alone, and the 90 % set names the
    answers to reckon with. The documentation states how often each is right. Give at
    least three references, better more; without any, the error stated in the model file counts as
    normal. A log needs 10 minutes, better an hour, with changing load and SoC. Positive current
    discharges.

    Examples
    --------
    `cangauge gap cold1.csv cold2.csv -m pack.json --reference mild1.csv --reference mild2.csv
    --reference mild3.csv --report gap.html --extended cold.json`

    `cangauge gap day1.csv --simulated "V sim [V]" --capacity-ah 60 --reference good1.csv
    --reference good2.csv --reference good3.csv --corrected .`
    """
    given = list(reference or [])
    options = SimulatorOptions(simulated, simulator, columns, temperature)
    _refuse_common(logs, given)
    outputs = [] if corrected is None else [corrected_path(log, corrected) for log in logs]
    check_outputs([report, extended, *outputs], [*logs, *given, *([model] if model else [])])
    model_file = _model(model, options, corrected)
    within(initial_soc, 0.0, 100.0, option="--initial-soc", unit="%")
    within(alarm, 0.0, 1.0, option="--alarm", unit="")
    within(capacity_ah, 1e-3, 1e5, option="--capacity-ah", unit="Ah")
    if capacity_ah is not None and model_file is not None:
        model_file = model_file.model_copy(update={"capacity_ah": capacity_ah})

    def read(path: Path) -> Log:
        return load_log(
            path,
            vehicle=vehicle,
            dbc=dbc,
            map_file=map_file,
            temperature_c=temperature,
            temperature_source=temperature_source,
            columns=columns,
            sign=sign,
            refuse_inverted=True,
        )

    diagnosed = [_long_enough(read(path)) for path in logs]
    references = [read(path) for path in given]
    if model_file is not None:
        _note_differences([*diagnosed, *references], model_file.capacity_ah)
    of_simulator = None
    with progress_shown("cangauge.diagnosis"):
        if model_file is not None and not options.are_given:
            found = diagnose(
                diagnosed,
                model_file,
                references,
                initial_soc_pct=initial_soc,
                alarm_below=alarm,
            )
        else:
            of_simulator = diagnose_simulator(
                [options.run(*each, initial_soc) for each in zip(diagnosed, logs, strict=True)],
                [options.run(*each, None) for each in zip(references, given, strict=True)],
                model=model_file,
                capacity_ah=capacity_ah,
                alarm_below=alarm,
            )
            found = of_simulator.diagnosis
    _write(found, model, report, extended)
    save_figures(figures, "diagnosis.gap_page", found)
    if of_simulator is not None and corrected is not None:
        write_corrected(of_simulator, logs, corrected)
    if json_output:
        result = found.to_dict(None if extended is None else str(extended))
        result |= {} if of_simulator is None else {"simulator": of_simulator.to_dict()}
        emit_json(result | {"assumed": assumed_of([*diagnosed, *references])})
        return
    _show(found)
    if of_simulator is not None:
        _show_simulator(of_simulator)
    for written in filter(None, (extended, report, *outputs)):
        note(f"wrote {written}")


def _note_differences(logs: list[Log], capacity_ah: float) -> None:
    for log in logs:
        if (difference := difference_from_reference(log, capacity_ah)) is not None:
            note(f"warning: {difference}")


def _write(
    found: Diagnosis, model: Path | None, report: Path | None, extended: Path | None
) -> None:
    texts = {}
    if extended is not None:
        texts[extended] = found.extended_model.to_json()
    if report is not None:
        # bokeh takes half a second to import.
        from cangauge.report.diagnosis import gap_report  # noqa: PLC0415
        from cangauge.report.page import InputFile  # noqa: PLC0415

        texts[report] = gap_report(found, InputFile.of_model(found.model, model))
    write_texts_atomic(texts)


def _model(path: Path | None, options: SimulatorOptions, corrected: Path | None) -> Model | None:
    """Return the given model; None for a simulator without one."""
    if corrected is not None and not options.are_given:
        raise InputError(
            "needs a simulator", field="--corrected", value=str(corrected),
            cure="give --simulated or --simulator; a model is corrected by --extended",
        )  # fmt: skip
    if path is None and not options.are_given:
        raise InputError(
            "no model", field="--model", cure="give the model file, or --simulated or --simulator"
        )
    return None if path is None else Model.load(path)


def _refuse_common(logs: list[Path], references: list[Path]) -> None:
    known = {path.resolve() for path in references}
    for path in logs:
        if path.resolve() in known:
            raise InputError(
                "is both a LOG and a reference, which must be without the fault",
                source=path,
                field="--reference",
                cure="give it as one of them",
            )


def _long_enough(log: Log) -> Log:
    if log.duration_s < SHORTEST_S:
        raise InputError(
            f"{log.duration_s:.0f} s are too short for a diagnosis",
            source=log.source or log.name,
            cure=f"give a log of at least {SHORTEST_S / 60.0:.0f} min, better half an hour with"
            " changing load and SoC",
        )
    return log


def _show(found: Diagnosis) -> None:
    for sentence in (
        headline(found),
        found.summary,
        open_question(found),
        next_step(found),
    ):
        if sentence:
            typer.echo(printable(sentence))
    rows = []
    for item in found.candidates[:SHOWN_CANDIDATES]:
        closed = item["closed_fraction"]
        rows.append(
            [
                str(item["effect"]),
                number(item["probability"], 2),
                number(item["log_bayes_factor"], 1),
                number(item["rmse_v"], 2),
                NONE_KNOWN if closed is None else number(100.0 * closed, 0, "%"),
            ]
        )
    for answer in (UNKNOWN, NONE):
        probability = number(found.verdict.probabilities[answer], 2)
        rows.append([answer, probability, NONE_KNOWN, NONE_KNOWN, NONE_KNOWN])
    headings = ["cause", "probability", "evidence", "RMSE [V]", "closed"]
    print_table("Candidates, judged on held-out rows", headings, rows)
    for item in found.candidates:
        if item["effect"] in found.extension.cause:
            typer.echo(f"{item['effect']}: {parameters_text(item['parameters'])}")
    if found.caveats:
        typer.echo("What these logs cannot show:")
    for sentence in found.caveats:
        typer.echo(printable(f"- {sentence}"))


def _show_simulator(found: SimulatorDiagnosis) -> None:
    if found.correction:
        typer.echo(found.correction)
    rows = [
        [
            str(each["name"]),
            number(each["simulated_rmse_v"], 3),
            number(each["corrected_rmse_v"], 3),
        ]
        for each in found.errors()
    ]
    print_table(
        "Measured less simulated voltage", ["<log", "RMS as it is [V]", "corrected [V]"], rows
    )
