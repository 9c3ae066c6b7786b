"""`cangauge gap`: diagnose the gap between a model and logs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cangauge._formatting import NONE_KNOWN, number, printable
from cangauge._io import write_texts_atomic
from cangauge.cli.next_test import NextTestOptions, show_tests
from cangauge.cli.options import (
    FiguresOption,
    JsonOption,
    Reading,
    ReportOption,
    assumed_of,
    check_outputs,
    folder_to_write,
    note_starts,
    option_groups,
    suffixed,
    within,
)
from cangauge.cli.output import emit_json, note, print_table, progress_shown, save_figures
from cangauge.cli.shown import ALARM_BELOW
from cangauge.cli.simulator import SimulatorOptions, corrected_paths, write_corrected
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.diagnosis import Diagnosis
    from cangauge.diagnosis.next_test import NextSteps
    from cangauge.diagnosis.simulator import SimulatorDiagnosis
    from cangauge.logs.log import Log
    from cangauge.model.model_file import Model

SHOWN_CANDIDATES = 5
SHORTEST_S = 300.0
"""Shortest log to diagnose [s]; a shorter one is mostly transient."""


@option_groups()
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
        typer.Option(
            metavar="MODEL.json",
            callback=suffixed(".json"),
            help="Write the model, extended by the cause, to this file.",
        ),
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
            callback=folder_to_write,
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
    plan: Annotated[
        bool,
        typer.Option(
            "--plan", help="Propose the next test: the one that separates the likely causes best."
        ),
    ] = False,
    plan_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv",
            callback=suffixed(".csv"),
            help="Write the current profile of that test: time_s, current_a.",
        ),
    ] = None,
    limits: Annotated[
        str | None,
        typer.Option(
            metavar="NAME=LOW:HIGH,…",
            help="Limits of that test: current=-60:120 (A), soc=20:90 (%), temperature=5:30 (°C at"
            " the start), minutes=20. Default: what the references usually show, and 20"
            " minutes.",
        ),
    ] = None,
    add_test: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="LOG",
            help="Log of a further test of the same cause, beside the LOGs of the first diagnosis:"
            " diagnoses both together and reports what the test changed; repeat the option.",
        ),
    ] = None,
    *,
    reading: Reading,
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

    `cangauge gap cold1.csv -m pack.json --reference mild1.csv --reference mild2.csv --reference
    mild3.csv --plan-file test.csv --limits current=-40:100,soc=30:80`, then the same with
    `--add-test test_as_driven.csv`

    `cangauge gap day1.csv --simulated "V sim [V]" --capacity-ah 60 --reference good1.csv
    --reference good2.csv --reference good3.csv --corrected .`
    """
    from cangauge.extras.report.summary import next_step

    given, added = list(reference or []), list(add_test or [])
    paths = [*logs, *added]
    options = SimulatorOptions(
        simulated, simulator, reading.columns, reading.temperature, capacity_ah
    )
    next_test = NextTestOptions(plan, plan_file, limits)
    _refuse_common(paths, given)
    within(initial_soc, 0.0, 100.0, option="--initial-soc", unit="%")
    within(alarm, 0.0, 1.0, option="--alarm", unit="")
    within(capacity_ah, 1e-3, 1e5, option="--capacity-ah", unit="Ah")
    model_file = _model(model, options, corrected)
    outputs = corrected_paths(paths, corrected)
    check_outputs(
        [report, extended, plan_file, *outputs],
        [*paths, *given, *([model] if model else [])],
        made=corrected,
    )
    used = [] if simulated is None else [simulated]
    diagnosed = [_long_enough(reading.load(path, used)) for path in paths]
    references = [reading.load(path, used) for path in given]
    if model_file is not None:
        _note_differences([*diagnosed, *references], model_file.capacity_ah)
        options.note_model(model)
    if initial_soc is not None:  # an added test has its own start
        capacity = capacity_ah if model_file is None else model_file.capacity_ah
        diagnosed[: len(logs)] = _started(diagnosed[: len(logs)], initial_soc, capacity)
    task = _Task(diagnosed, paths, references, given, alarm)
    with progress_shown("cangauge.diagnosis"):
        first = task.run(len(logs), model_file, options)[0].verdict if added else None
        found, of_simulator = task.run(len(paths), model_file, options)
        steps = next_test.steps(found, first, [log.name for log in diagnosed[len(logs) :]])
    texts = next_test.texts(steps)
    if extended is not None:
        texts[extended] = found.extended_model.to_json()
        if found.extended_soc_caveat:
            note(f"warning: {found.extended_soc_caveat}")
    if report is not None:
        texts[report] = _page(found, model, steps)
    write_texts_atomic(texts)
    save_figures(figures, "diagnosis.gap_page", found, None, steps)
    if of_simulator is not None and corrected is not None:
        write_corrected(of_simulator, paths, corrected)
    if json_output:
        result = found.to_dict(None if extended is None else str(extended))
        result |= {} if of_simulator is None else {"simulator": of_simulator.to_dict()}
        result |= next_test.to_dict(steps)
        emit_json(result | {"assumed": assumed_of([*diagnosed, *references])})
        return
    _show(found, "" if steps.plan else next_step(found))
    if of_simulator is not None:
        _show_simulator(of_simulator)
    show_tests(steps)
    for written in (*texts, *outputs):
        note(f"wrote {written}")


@dataclass(frozen=True, slots=True)
class _Task:
    """Logs to diagnose, with their files."""

    logs: list[Log]
    paths: list[Path]
    references: list[Log]
    reference_paths: list[Path]
    alarm_below: float

    def run(
        self, number: int, model: Model | None, options: SimulatorOptions
    ) -> tuple[Diagnosis, SimulatorDiagnosis | None]:
        """Diagnose the first logs, that many."""
        from cangauge.diagnosis import diagnose
        from cangauge.diagnosis.simulator import diagnose_simulator

        logs, references = self.logs[:number], self.references
        if model is not None and not options.are_given:
            return diagnose(logs, model, references, alarm_below=self.alarm_below), None
        found = diagnose_simulator(
            [options.run(*each) for each in zip(logs, self.paths, strict=False)],
            [options.run(*each) for each in zip(references, self.reference_paths, strict=True)],
            model=model,
            capacity_ah=options.capacity_ah,
            alarm_below=self.alarm_below,
        )
        return found.diagnosis, found


def _started(logs: list[Log], initial_soc_pct: float, capacity_ah: float | None) -> list[Log]:
    from cangauge.identify.starts import with_start

    note_starts(logs, initial_soc_pct, capacity_ah)
    return [with_start(log, initial_soc_pct) for log in logs]


def _note_differences(logs: list[Log], capacity_ah: float) -> None:
    from cangauge.model.coulomb_counting import difference_from_reference

    for log in logs:
        if (difference := difference_from_reference(log, capacity_ah)) is not None:
            note(f"warning: {difference}")


def _page(found: Diagnosis, model: Path | None, steps: NextSteps) -> str:
    # bokeh takes half a second to import.
    from cangauge.extras.report.diagnosis import gap_report
    from cangauge.extras.report.page import InputFile

    return gap_report(found, InputFile.of_model(found.model, model), steps)


def _model(path: Path | None, options: SimulatorOptions, corrected: Path | None) -> Model | None:
    """Return the given model; None for a simulator without one."""
    from cangauge.model.model_file import Model

    if corrected is not None and not options.are_given:
        raise InputError(
            "needs a simulator", field="--corrected", value=str(corrected),
            cure="give --simulated or --simulator; a model is corrected by --extended",
        )  # fmt: skip
    if path is None and not options.are_given:
        raise InputError(
            "no model", field="--model", cure="give the model file, or --simulated or --simulator"
        )
    if path is None:
        return None
    found = Model.load(path)
    if options.capacity_ah is None:
        return found
    return found.model_copy(update={"capacity_ah": options.capacity_ah})


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


def _show(found: Diagnosis, next_words: str) -> None:
    from cangauge.diagnosis import NONE, UNKNOWN
    from cangauge.extras.report.summary import headline, open_question, parameters_text

    for sentence in (
        headline(found),
        found.summary,
        open_question(found),
        next_words,
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
