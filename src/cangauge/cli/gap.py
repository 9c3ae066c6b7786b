"""`cangauge gap`: diagnose the gap between a model and logs."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from runpy import run_path
from typing import TYPE_CHECKING, Annotated, Any

from cangauge._extras import extra
from cangauge._files import write_texts_atomic
from cangauge.cli.options import (
    ALARM,
    CapacityAh,
    Json,
    ReadingOptions,
    Report,
    argument,
    assumed_of,
    check_outputs,
    command,
    note_starts,
    option,
)
from cangauge.cli.output import finish, note, print_table, progress, say
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge._typing import FloatArray
    from cangauge.diagnosis import Diagnosis
    from cangauge.logs.log import Log


@command()
def gap_command(
    logs: Annotated[
        list[Path], argument("LOG", "Logs to diagnose. They must have the same fault.")
    ],
    *,
    model: Annotated[
        Path | None, option("-m, --model", "MODEL", "Model file. Not needed with a simulator.")
    ] = None,
    reference: Annotated[
        list[Path] | None,
        option(
            "--reference",
            "LOG",
            "Log without a fault. Repeat the option for more logs. If a log has no soc_pct, its"
            " initial SoC is found from the voltage.",
        ),
    ] = None,
    initial_soc: Annotated[
        float | None,
        option(
            "--initial-soc",
            "P",
            "SoC at the first row of each diagnosed log, e.g. 80. Default: soc_pct of the log;"
            " without it, found from the voltage.",
            within=(0, 100),
            unit="%",
        ),
    ] = None,
    capacity_ah: CapacityAh = None,
    extended: Annotated[
        Path | None,
        option("--extended", "MODEL.json", "Write the corrected model.", suffixes=(".json",)),
    ] = None,
    simulated: Annotated[
        str | None,
        option(
            "--simulated",
            "HEADING",
            "Column of every log with the voltage that a simulator computed for the same current"
            " and temperature. The errors of the simulator are then diagnosed instead of the"
            " errors of a model.",
        ),
    ] = None,
    simulator: Annotated[
        str | None,
        option(
            "--simulator",
            "MODULE:FUNCTION",
            "Simulator as a Python function, also FILE.py:FUNCTION. It is called with time [s],"
            " current [A, positive = discharge], temperature [°C] and SoC of the first row [%],"
            " and returns the voltage [V].",
        ),
    ] = None,
    alarm: Annotated[
        float,
        option(
            "--alarm",
            "P",
            "Report a gap if the probability of no fault is at most P.",
            within=(0, 1),
        ),
    ] = ALARM,
    plan: Annotated[
        bool,
        option(
            "--plan",
            "",
            "Print the next measurement, and how much it is expected to increase the probability"
            " of the true fault.",
        ),
    ] = False,
    add_test: Annotated[
        list[Path] | None,
        option(
            "--add-test",
            "LOG",
            "Log of a further test with the same fault. The test is diagnosed together with the"
            " LOGs of the first diagnosis, and the changes of the answer are printed. Repeat the"
            " option for more logs.",
        ),
    ] = None,
    reading: ReadingOptions,
    report: Report = None,
    json_output: Json = False,
) -> None:
    """Diagnose the gap between a model and logs: which of nine faults, how large, what to do.

    The answer has three lines: the fault with its size and likelihood; the voltage error before and
    after the correction, and of healthy logs; what to do first. If the model does not describe the
    references, a line on this comes before. A gap is reported if the probability of no fault is at
    most --alarm. Give at least three references; ten are better. Without references, the error
    stated in the model file counts as normal. A log should last at least 10 minutes, better an
    hour, with changing load and SoC. Three logs give a much clearer answer than one. Positive
    current discharges.

    Examples
    --------
    `cangauge gap cold1.csv cold2.csv -m pack.json --reference mild1.csv --reference mild2.csv
    --reference mild3.csv --report gap.html --extended cold.json`

    `cangauge gap cold1.csv -m pack.json --reference mild1.csv --reference mild2.csv --reference
    mild3.csv --plan`, then the same with `--add-test test_as_driven.csv`

    `cangauge gap day1.csv --simulated "V sim [V]" --capacity-ah 60 --reference good1.csv
    --reference good2.csv --reference good3.csv`
    """
    from cangauge.diagnosis import diagnose
    from cangauge.identify.starts import with_start
    from cangauge.logs.charge import refuse_contradictions
    from cangauge.model.coulomb_counting import difference_from_reference
    from cangauge.model.model_file import Model

    tests = add_test or []
    healthy = reference or []
    given = None if model is None else Model.load(model)
    if given is not None and capacity_ah is not None:
        given = given.model_copy(update={"capacity_ah": capacity_ah})
    check_outputs([report, extended], filter(None, [*logs, *tests, *healthy, model]))
    with progress("cangauge.diagnosis") as show:
        read = reading.load_all([*logs, *tests, *healthy], show, [simulated] if simulated else [])
        if given is not None:
            capacity_ah = given.capacity_ah
            refuse_contradictions(read, capacity_ah)
            for log in read:
                if difference := difference_from_reference(log, capacity_ah):
                    note(f"warning: {difference}")
        own = read[: len(logs)]
        if initial_soc is not None:
            note_starts(own, initial_soc, capacity_ah)
            own = [with_start(log, initial_soc) for log in own]
        added = read[len(logs) :][: len(tests)]
        references = read[len(logs) + len(tests) :]
        found = diagnose(
            [*own, *added],
            given,
            references,
            simulation=_simulation(simulated, simulator, read, reading),
            capacity_ah=capacity_ah,
            alarm=alarm,
        )
        before = None
        if added:
            before = diagnose(found.logs[: len(own)], found.model, found.healthy, alarm=alarm)
    if extended is not None:
        found = replace(found, correction_path=str(extended))
    written = _write(found, extended, report, model)
    result = found.to_json() | {"assumed": assumed_of(read)}
    if before is not None:
        result["added_test"] = {
            "logs": [log.name for log in added],
            "before": {"none": before.posterior.none, **before.posterior.faults},
        }
    finish(result, partial(_show, found, before, plan, written), as_json=json_output)


def _write(
    found: Diagnosis, extended: Path | None, report: Path | None, model: Path | None
) -> list[Path]:
    """Write the corrected model, if there is one, and the page, both or none; return their paths.

    The page names the file of the model.
    """
    texts = {}
    if extended is not None and found.is_written:
        texts[extended] = found.extended_model.to_json()
    if report is not None:
        texts[report] = extra("report.diagnosis:gap_page")(found, model).html()
    write_texts_atomic(texts)
    return list(texts)


def _simulation(
    heading: str | None, function: str | None, logs: list[Log], reading: ReadingOptions
) -> Any:
    """Return the simulator, or the voltage that it wrote into a column of each log, by log."""
    if function is None:
        return heading and {
            log.source or log.name: _column_of(log, heading, reading) for log in logs
        }
    if heading is not None:
        raise InputError("two simulators", field="--simulator", value=function, cure="give one")
    return load_function(function)


def _column_of(log: Log, heading: str, reading: ReadingOptions) -> FloatArray:
    """Return the simulated voltage [V] in a column of a log's file, shape (n,).

    Raises
    ------
    InputError
        If the file lacks the column, or a value where the log has a measured voltage.
    """
    import numpy as np

    from cangauge.logs.column_map import ColumnMap
    from cangauge.logs.read import open_log

    texts = ColumnMap.of(reading.columns or {}, "--columns").texts
    columns = ColumnMap({**texts, "voltage": heading}, "--simulated")
    simulated = open_log(log.source, columns=columns).read(temperature_c=reading.temperature)
    if not np.array_equal(simulated.time_s, log.time_s):
        raise InputError(
            f"{len(simulated)} rows have a simulated voltage, {len(log)} a measured one",
            source=log.source,
            field="--simulated",
            value=heading,
            cure="give both for every row",
        )
    return simulated.voltage_v


def load_function(text: str) -> Callable[..., Any]:
    """Return a function named `MODULE:FUNCTION` or `FILE.py:FUNCTION`; may raise InputError."""
    place, _, name = text.rpartition(":")
    sys.path.insert(0, "")  # modules of the working directory too
    try:
        is_file = place.endswith(".py")
        names = run_path(place) if is_file else vars(importlib.import_module(place))
        function, problem = names.get(name), f"{place} has no function {name}"
    except (Exception, SystemExit) as error:  # noqa: BLE001 - it may raise anything
        function, problem = None, f"cannot be imported: {type(error).__name__}: {error}"
    finally:
        sys.path.remove("")
    if not callable(function):
        raise InputError(
            problem,
            field="--simulator",
            value=text,
            cure="give MODULE:FUNCTION or path/to/file.py:FUNCTION",
        )
    return function  # type: ignore[no-any-return]


def _show(found: Diagnosis, before: Diagnosis | None, plan: bool, written: Iterable[Path]) -> None:
    """Print the answer, all faults, and what limits the answer."""
    from cangauge.diagnosis.text import fault_rows, plan_text

    say(found.summary)
    if before is not None:
        say(f"Without the added test: {before.summary.splitlines()[0]}")
    if plan:
        say(plan_text(found))
    print_table("Faults", *fault_rows(found))
    say("\n- ".join(["What limits this answer:", *found.caveats]))
    for path in written:
        note(f"wrote {path}")
    if not found.is_written:
        note(f"no corrected model: {found.why_not}")
