"""The page of `cangauge gap`: size, place and cause of the gap, and how far a cause closes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from cangauge._formatting import number, significant, span
from cangauge.diagnosis import NONE, UNKNOWN, Diagnosis, LogErrors, rms
from cangauge.diagnosis.next_test import NextSteps, Plan
from cangauge.extras.report.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    Pen,
    TimeFigures,
    add_line,
    add_zero,
    bars,
    new_figure,
)
from cangauge.extras.report.error_places import (
    error_maps,
    share_figures,
    side_by_side,
    worst_segment_figures,
)
from cangauge.extras.report.page import (
    Block,
    Bullets,
    Figure,
    InputFile,
    Page,
    Paragraph,
    Section,
    Table,
    Tile,
    joined,
    reconstruction_banners,
    render,
)
from cangauge.extras.report.summary import (
    EXPLAINED,
    headline,
    next_step,
    open_question,
    parameters_text,
    percent,
    percent_span,
    plan_rows,
)
from cangauge.model.effects.library import LIBRARY

_SHOWN_ANSWERS: Final = 4
"""Answers shown at least; those of the 90 % set, `none` and `unknown` always are."""


def gap_report(
    diagnosis: Diagnosis, model: InputFile | None = None, steps: NextSteps | None = None
) -> str:
    """Return the diagnosis as one self-contained HTML page.

    Parameters
    ----------
    diagnosis : Diagnosis
    model : InputFile, optional
        The diagnosed model, to name it on the page.
    steps : NextSteps, optional
        A test that was added to the diagnosis, and the next one.
    """
    return render(gap_page(diagnosis, model, steps))


def gap_page(
    diagnosis: Diagnosis, model: InputFile | None = None, steps: NextSteps | None = None
) -> Page:
    """Return the report's content (see `gap_report`); `figures` holds the bokeh figures."""
    problem = diagnosis.problem
    logs = [matrix.sampled.log for matrix in problem.diagnosed]
    references = [sampled.log for sampled in problem.references]
    errors = diagnosis.log_errors()
    extended = _extended_name(diagnosis)
    places = share_figures(diagnosis.error_breakdown)
    over_time, current = _over_time(errors, extended)
    bars_of_size, size_table = _size(diagnosis, extended)
    plan = None if steps is None else steps.plan
    details: dict[str, list[Block]] = {
        "Every effect: evidence and parameters": _every_effect(diagnosis),
        "Errors in numbers": [size_table, _log_table(errors), current],
        "Error over SoC, current, temperature and time": [
            *side_by_side(places[2:]),
            *error_maps(errors, extended),
        ],
        "Worst segments": worst_segment_figures(diagnosis.worst_segments, errors, extended),
        "What these logs can show": [_observability(diagnosis)],
    }
    sections = [
        Section("How sure this is", _certainty(diagnosis, steps)),
        *([] if plan is None else [Section("The next test", _next_test(plan))]),
        Section("Where the gap is", side_by_side(places[:2])),
        Section("How far the gap shrinks", [_closing(diagnosis), bars_of_size, over_time]),
        Section("What was compared", [_compared(diagnosis), Bullets(_method(diagnosis))]),
        *(Section(heading, blocks, is_folded=True) for heading, blocks in details.items()),
    ]
    title = f"Diagnosis of {joined([log.name for log in logs])}"
    if model is not None:
        title += f" with model {model.name}"
    size, verdict = headline(diagnosis), diagnosis.summary
    return Page(
        title=title,
        lead=size or verdict,
        subtitle=verdict if size else "",
        tiles=_tiles(diagnosis),
        sections=sections,
        inputs=[
            *([] if model is None else [model]),
            *(InputFile.of_path("log", log.name, log.source) for log in logs),
            *(InputFile.of_path("reference", log.name, log.source) for log in references),
        ],
        banners=reconstruction_banners(*(text for log in logs for text in (log.name, log.source))),
    )


def _next_test(plan: Plan) -> list[Block]:
    """Return the proposed test, its profile, and what each test is expected to show."""
    best, (headings, rows) = plan.best.profile, plan_rows(plan)
    plot = new_figure(("time", "current"), "@y{0.0} A<br>at @x{0} s", units=("s", "A"), height=190)
    add_zero(plot)
    add_line(plot, "current", best.time_s, best.current_a, Pen(BLUE, width=1.4, in_legend=False))
    return [
        Paragraph(plan.sentence),
        Figure(
            f"{'Proposed test' if plan.helps else 'Best of the tests'}: {best.name}",
            plot,
            f"From {number(best.start_soc_pct, 0, '%')} to"
            f" {number(float(best.soc_pct[-1]), 0, '%')} SoC, from"
            f" {number(best.start_c, 0, '°C')}. Positive current discharges.",
        ),
        Table(
            [heading.removeprefix("<") for heading in headings],
            rows,
            note="P(true one): expected probability of the true cause, averaged over the 90 % set."
            " A cause's own column: its expected probability where it is the true one. Under the"
            " linear model, which flatters.",
        ),
    ]


def _extended_name(diagnosis: Diagnosis) -> str:
    """Return what the extended model adds, in words."""
    accepted = diagnosis.extension.cause
    if accepted:
        return f"with {' and '.join(accepted)}"
    return "adapted to the references" if diagnosis.problem.references else "nothing added"


def _tiles(diagnosis: Diagnosis) -> list[Tile]:
    verdict = diagnosis.verdict
    before, after = diagnosis.baseline_soc_mae_pct, diagnosis.extended_soc_mae_pct
    tiles = [
        Tile("Verdict", verdict.cause.replace("_", " "), f"probability {verdict.probability:.2f}"),
        Tile("Error of the model", number(diagnosis.baseline_rmse_v, 2, "V"), "RMS, these logs"),
        Tile("Extended model", number(diagnosis.extended_rmse_v, 2, "V"), "RMS, held-out rows"),
        Tile(
            "Floor: references" if diagnosis.problem.references else "Floor: model file",
            number(diagnosis.floor_v, 2, "V"),
            "RMS, model as given",
        ),
    ]
    if diagnosis.explainable_v is not None:
        tiles.append(
            Tile(
                "Floor: explainable",
                number(diagnosis.explainable_v, 2, "V"),
                "RMS, adapted to references",
            )
        )
    if diagnosis.closed_fraction is not None:
        hint = "of the squared gap above the floor"
        if diagnosis.closed_fraction_ci is not None:
            hint = f"squared; 95 %: {percent_span(*diagnosis.closed_fraction_ci)}"
        tiles.append(Tile("Gap closed", percent(diagnosis.closed_fraction), hint))
    if before is not None:
        tiles.append(
            Tile(
                "SoC error (EKF)",
                f"{significant(before, 2)} → {significant(after, 2, '%')}",
                "MAE, model as given → extended",
            )
        )
    return tiles


def _size(diagnosis: Diagnosis, extended: str) -> tuple[Figure, Table]:
    """Return the errors in volts and in % SoC, against the two floors."""
    problem = diagnosis.problem
    soc = np.concatenate([matrix.sampled.rows.soc_pct for matrix in problem.diagnosed])
    slope_v_per_pct = float(np.median(problem.given.model.pseudo_ocv_slope(soc)))
    floor = (
        ("floor: references", "the references, model as given: sensors and what does not repeat")
        if problem.references
        else ("floor: model file", "stated in the model file, without references")
    )
    entries = [
        ("model as given", diagnosis.baseline_rmse_v, ORANGE,
         diagnosis.baseline_soc_mae_pct, "these logs"),
        (extended, diagnosis.extended_rmse_v, BLUE,
         diagnosis.extended_soc_mae_pct, "these logs, on rows held out of its fit"),
        (floor[0], diagnosis.floor_v, GREY, None, floor[1]),
    ]  # fmt: skip
    if diagnosis.explainable_v is not None:
        entries.append(
            ("floor: explainable", diagnosis.explainable_v, GREEN, None,
             "each reference held out, model adapted to the others")
        )  # fmt: skip
    rows = [
        [name, number(rms_v, 2), number(rms_v / slope_v_per_pct, 2), number(soc_mae_pct, 2), on]
        for name, rms_v, _, soc_mae_pct, on in entries
    ]
    return (
        Figure(
            "Error and floors",
            bars(
                "RMS error",
                "V",
                [(name, rms_v, color) for name, rms_v, color, _, _ in entries],
                decimals=2,
            ),
            _size_caption(diagnosis),
        ),
        Table(
            ["", "RMS [V]", "as SoC [%]", "SoC error of the EKF [%]", "judged on"],
            rows,
            note="As SoC: volts over the median slope of the pseudo-OCV here,"
            f" {slope_v_per_pct:.2f} V per %. SoC error of the EKF: mean absolute error after"
            " 5 minutes, initial SoC withheld; – where the logs have no reference SoC.",
        ),
    )


def _size_caption(diagnosis: Diagnosis) -> str:
    ratio = number(diagnosis.baseline_rmse_v / max(diagnosis.floor_v, 1e-9), 1)
    floor = "that on the references" if diagnosis.problem.references else "what its file states"
    text = f"The model's error on these logs is {ratio} times {floor}."
    if diagnosis.explainable_v is None:
        return f"{text} The second floor, the error of an adapted model, needs more references."
    return (
        f"{text} The part above both floors is the gap. The part between the floors is structure"
        " that the model lacks, and needs no fault."
    )


def _certainty(diagnosis: Diagnosis, steps: NextSteps | None) -> list[Block]:
    """Return the probabilities in words and as bars, what each answer means, and the caveats."""
    stated = diagnosis.verdict.probabilities
    by_probability = sorted(stated, key=lambda name: -stated[name])
    needed = {*by_probability[:_SHOWN_ANSWERS], *diagnosis.verdict.credible_set, NONE, UNKNOWN}
    answers = [name for name in by_probability if name in needed]
    colors = {diagnosis.verdict.cause: BLUE}
    shown = [(name, 100.0 * stated[name], colors.get(name, GREY)) for name in answers]
    texts = [_certainty_text(diagnosis)]
    if steps is not None and steps.added is not None:
        texts.append(steps.added.sentence)
    if steps is None or steps.plan is None:
        texts.append(next_step(diagnosis))
    caveats = [text for text in (open_question(diagnosis), *diagnosis.caveats) if text]
    blocks: list[Block] = [
        Paragraph(" ".join(filter(None, texts))),
        Figure(
            "Probability of each answer",
            bars("probability", "%", shown, decimals=0),
            "All answers together have 100 %; the less likely effects are below.",
        ),
        Table(
            ["answer", "what it means"],
            [[name, EXPLAINED[name]] for name in answers],
            note="An effect is a signature at the terminals, not proof of a mechanism.",
        ),
    ]
    if caveats:
        blocks += [Paragraph("What these logs cannot show:"), Bullets(caveats)]
    return blocks


def _certainty_text(diagnosis: Diagnosis) -> str:
    verdict = diagnosis.verdict
    none = percent(verdict.probabilities[NONE])
    alarm = f"Alarm: a fault is all but certain, P(none) {none}." if verdict.detected else (
        f"No alarm: the probability that there is no fault is {none}."
    )  # fmt: skip
    text = f"{alarm} The 90 % set: {', '.join(verdict.credible_set)}."
    if verdict.family != verdict.cause:
        text += (
            f" The family {verdict.family.replace('_', ' ')} has"
            f" {percent(verdict.family_probability)}."
        )
    return text


def _every_effect(diagnosis: Diagnosis) -> list[Block]:
    rows = [
        [
            str(item["effect"]),
            number(diagnosis.verdict.probabilities[item["effect"]], 2),
            number(item["log_bayes_factor"], 1),
            number(item["rmse_v"], 2),
            "–" if item["closed_fraction"] is None else percent(item["closed_fraction"]),
            parameters_text(item["parameters"], "; "),
            EXPLAINED[item["effect"]],
        ]
        for item in diagnosis.candidates
    ]
    table = Table(
        ["effect", "probability", "log evidence", "error held out [V]", "gap closed",
         "parameters (95 %)", "what it means"],
        rows,
        note="Errors on rows held out of the fit of the effect.",
    )  # fmt: skip
    if diagnosis.verdict.cause in {NONE, UNKNOWN}:
        return [table]
    effect = LIBRARY[diagnosis.verdict.cause]
    return [Paragraph(f"{effect.id}: {effect.signature}. {effect.equation}."), table]


def _compared(diagnosis: Diagnosis) -> Table:
    """Return the diagnosed logs and the references with ranges, error and hash."""
    problem = diagnosis.problem
    rows = []
    diagnosed = [matrix.sampled for matrix in problem.diagnosed]
    for role, logs, errors in (
        ("log", diagnosed, problem.diagnosed_errors_v),
        ("reference", problem.references, problem.reference_errors_v),
    ):
        for sampled, error_v in zip(logs, errors, strict=True):
            log, seen = sampled.log, sampled.rows
            file = InputFile.of_path(role, log.name, log.source)
            rows.append(
                [
                    role,
                    log.name,
                    number(log.duration_s / 60.0, 0),
                    span(float(seen.soc_pct.max()), float(seen.soc_pct.min()), 0),
                    span(float(seen.temperature_c.min()), float(seen.temperature_c.max()), 0),
                    number(rms(error_v), 2),
                    "–" if file.sha256 is None else file.sha256[:12],
                ]
            )
    return Table(
        ["", "name", "duration [min]", "SoC [%]", "temperature [°C]", "RMS error [V]", "SHA-256"],
        rows,
        note=f"Errors of the model {diagnosis.model.name} as given.",
    )


def _closing(diagnosis: Diagnosis) -> Paragraph:
    before = number(diagnosis.baseline_rmse_v, 2, "V")
    after = number(diagnosis.extended_rmse_v, 2, "V")
    text = f"RMS error on held-out rows: {before} with the model as given, {after} extended."
    if diagnosis.extended_rmse_v > diagnosis.baseline_rmse_v:
        text += " The extended model is worse: do not run it."
    elif diagnosis.closed_fraction is not None:
        interval = ""
        if diagnosis.closed_fraction_ci is not None:
            interval = f" (95 % interval {percent_span(*diagnosis.closed_fraction_ci)})"
        closed = percent(diagnosis.closed_fraction)
        text += f" This closes {closed}{interval} of the squared gap above the"
        text += " floor."
    if diagnosis.problem.references:
        cause = "the cause and " if diagnosis.extension.cause else "no cause, only "
        text += (
            f" The extended model has {cause}what the references show: adjusted coefficients, and"
            " structure that logs without a fault share."
        )
    return Paragraph(f"{text} {diagnosis.extended_soc_caveat}".rstrip())


def _over_time(errors: Sequence[LogErrors], extended: str) -> tuple[Figure, Figure]:
    """Return the figures of the errors, before and after, and of the current."""
    logs = [item.sampled.log for item in errors]
    time = TimeFigures(logs)
    plot = time.plot("measured − model", "V", height=300, names=True)
    rows_s = [item.sampled.rows.time_s for item in errors]
    for name, color, values in (
        ("model as given", ORANGE, [item.before_v for item in errors]),
        (extended, BLUE, [item.after_v for item in errors]),
    ):
        pen = Pen(color, width=1.0, alpha=0.85)
        time.line(plot, name, list(zip(rows_s, values, strict=True)), pen)
    add_zero(plot)
    current = time.plot("current", "A", height=170)
    pieces = [(log.time_s, log.current_a) for log in logs]
    time.line(current, "current", pieces, Pen(GREY, width=1.0, in_legend=False))
    return (
        Figure(
            "Measured minus modelled voltage, before and after",
            plot,
            "All rows, including those of the extended model's fit: see the size of the gap above"
            " for the error on held-out rows.",
        ),
        Figure("Current", current, "Positive current discharges the pack, negative charges it."),
    )


def _log_table(errors: Sequence[LogErrors]) -> Table:
    rows = []
    for item in errors:
        seen = item.sampled.rows
        rows.append(
            [
                item.sampled.log.name,
                number(item.sampled.log.duration_s / 60.0, 1),
                span(float(seen.soc_pct.max()), float(seen.soc_pct.min()), 0),
                span(float(seen.temperature_c.min()), float(seen.temperature_c.max()), 0),
                number(rms(item.before_v), 2),
                number(rms(item.after_v), 2),
                number(float(np.mean(item.before_v)), 2),
                number(float(np.mean(item.after_v)), 2),
            ]
        )
    return Table(
        ["log", "duration [min]", "SoC [%]", "temperature [°C]", "RMS before [V]",
         "RMS after [V]", "mean before [V]", "mean after [V]"],
        rows,
        note="On the rows of the fit, where the error after is slightly smaller than on held-out"
        " rows.",
    )  # fmt: skip


def _observability(diagnosis: Diagnosis) -> Table:
    rows = [
        [str(item["effect"]), percent(float(str(item["visible"]))), str(item["needs"])]
        for item in diagnosis.observability
    ]
    return Table(
        ["effect", "visible part of its physical range", "what would show or separate it"],
        rows,
        note="0 %: even at its physical limit the effect would hardly exceed the error of logs"
        " without it.",
    )


def _method(diagnosis: Diagnosis) -> list[str]:
    problem = diagnosis.problem
    error = problem.error
    rows = sum(matrix.residual_v.size for matrix in problem.diagnosed)
    names = ", ".join(matrix.sampled.log.name for matrix in problem.diagnosed)
    remarks = [
        f"Diagnosed: {names} ({rows:,} rows); references: {len(problem.references)}.",
        f"Expected error without a fault: {error.rmse_v:.2f} V, weighted by time scale:"
        f" {error.scale_v2[0] ** 0.5:.2f} V from row to row,"
        f" {error.lasting_v2**0.5:.2f} V·√row over many minutes.",
        "Coefficients, structure that logs without a fault share, and their differences from log to"
        " log are marginalised; then every effect is compared with none.",
        *diagnosis.extension.remarks,
    ]
    if not problem.references:
        remarks.append(
            "Without references the model file's own noise is the floor: give logs on which the"
            " model is known to be good with --reference."
        )
    return remarks
