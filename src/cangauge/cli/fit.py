"""`cangauge fit`: recorded logs → model file and report."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cangauge._extras import extra
from cangauge._files import write_texts_atomic
from cangauge.cli.options import (
    Json,
    ReadingOptions,
    Report,
    argument,
    assumed_of,
    check_outputs,
    command,
    option,
)
from cangauge.cli.output import finish, print_values, progress, remark, say
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.identify.identification import Identification
    from cangauge.logs.log import Log

SAME_SUM = 0.02
"""Largest difference between the sum of the cells and the pack's voltage, of the latter: a cell
more or less in 16 makes three times as much."""


@dataclass(frozen=True, slots=True)
class PublishedOptions:
    """The options of the published equation."""

    delay_s: Annotated[
        str | None,
        option(
            "--delays",
            "S,S,…",
            "Delays of the current [s], by default 0,10,30,70; with --equation published.",
        ),
    ] = None
    epsilon: Annotated[
        float | None,
        option(
            "--epsilon",
            "E",
            "Margin ε of the scaled SoC, by default 0.05; with --equation published.",
            within=(0.0001, 0.49),
        ),
    ] = None
    t_ref_c: Annotated[
        float | None,
        option(
            "--t-ref",
            "C",
            "Reference temperature T_r, by default 20; with --equation published.",
            within=(-60, 120),
            unit="°C",
        ),
    ] = None

    def given(self, equation: str) -> dict[str, Any]:
        """Return the arguments of `fit` that are given; raise InputError for another equation."""
        given = {name: value for name, value in asdict(self).items() if value is not None}
        if self.delay_s is not None:
            given["delay_s"] = _delays_s(self.delay_s)
        if given and equation != "published":
            raise InputError(
                "--delays, --epsilon and --t-ref belong to the published equation",
                field="--equation",
                value=equation,
                cure="add --equation published, or omit them",
            )
        return given


@command()
def fit_command(
    logs: Annotated[list[Path], argument("LOG", "Recorded logs or captures of one pack.")],
    *,
    output: Annotated[
        Path, option("-o, --output", "MODEL.json", "Model file to write.", suffixes=(".json",))
    ],
    capacity_ah: Annotated[
        Any,
        option(
            "--capacity-ah",
            "A|from-soc",
            "Charge from 100 to 0 %, e.g. 51.5, or `from-soc`: counted charge per 100 % of"
            " soc_pct. Default: found from a log that runs from full to empty.",
            within=(0.001, 1e5),
            unit="Ah",
            word="from-soc",
        ),
    ] = None,
    initial_soc: Annotated[
        list[Any] | None,
        option(
            "--initial-soc",
            "P|auto",
            "SoC at the first row. Give one value for all logs, or repeat the option for each log"
            " in order. Default, and `auto`: soc_pct of the log. If a log has no soc_pct, its SoC"
            " is estimated together with the curve; at least one other log must have a known SoC.",
            within=(0, 100),
            unit="%",
            word="auto",
        ),
    ] = None,
    equation: Annotated[
        Literal["knots", "published"],
        option(
            "--equation",
            "knots|published",
            "knots: spline curve with a typical cell of the chemistry as prior. published: the"
            " published equation, fitted by plain least squares.",
        ),
    ] = "knots",
    chemistry: Annotated[
        Literal["oxide", "lfp"] | None,
        option(
            "--chemistry",
            "oxide|lfp",
            "Chemistry of the cells. oxide: layered oxides or manganese spinel; lfp: iron"
            " phosphate. Default: from the voltage per cell if --cells is known, otherwise oxide.",
        ),
    ] = None,
    cells: Annotated[
        int | None,
        option(
            "--cells",
            "N",
            "Number of cells in series. It determines the chemistry, and the curve beyond the SoC"
            " of the logs. Default: number of cell-voltage columns in the first log, if it has"
            " all cells.",
            within=(1, 2000),
        ),
    ] = None,
    rate_hz: Annotated[
        float,
        option(
            "--rate-hz",
            "HZ",
            "Sampling rate of the fit. Faster logs are decimated.",
            within=(0.01, 1000),
            unit="Hz",
        ),
    ] = 1.0,
    effects: Annotated[
        list[str] | None,
        option(
            "--effects",
            "ID…|auto|none",
            "Effects to add to the model, separated by commas, e.g. hysteresis. `auto` adds the"
            " effects that significantly lower the error of left-out logs. Default: none.",
        ),
    ] = None,
    published: PublishedOptions,
    reading: ReadingOptions,
    report: Report = None,
    json_output: Json = False,
) -> None:
    """Identify the voltage model of a pack from recorded logs.

    A log has the columns time_s [s], current_a [A] (positive discharges), voltage_v [V],
    temperature_c [°C] and optionally soc_pct [%]. Use --columns if they have other names. `cangauge
    inspect` shows what a file contains. The SoC at the start of at least one log must be known.

    Examples
    --------
    `cangauge fit full_discharge.parquet -o pack.json --report pack.html`

    `cangauge fit trip1.csv trip2.csv trip3.csv -o pack.json --capacity-ah from-soc --cells 96`

    `cangauge fit drive.log --vehicle leaf_ze0 -o pack.json --capacity-ah 51.5 --initial-soc 92`

    `cangauge fit trip*.csv -o pack.json --capacity-ah from-soc --effects auto`

    `cangauge fit known.csv other.csv -o pack.json --capacity-ah 60 --initial-soc 92 --initial-soc
    auto`

    If the model file or the report cannot be written, neither is written.
    """
    from cangauge.identify.fit import fit
    from cangauge.identify.starts import given_starts

    given = initial_soc or [None]
    starts = given_starts(given[0] if len(given) == 1 else given, len(logs))
    of_equation = published.given(equation)
    check_outputs([output, report], logs)
    with progress("cangauge.identify") as show:
        recorded = reading.load_all(logs, show)
        result = fit(
            recorded,
            capacity_ah=capacity_ah,
            initial_soc_pct=starts,
            equation=equation,
            chemistry=chemistry,
            cells=cells or _cells_of(recorded[0], reading),
            rate_hz=rate_hz,
            effects=effects,
            **of_equation,
        )
        show("writing")
        texts = {output: result.model.to_json()}
        if report is not None:
            texts[report] = extra("report.fit:fit_page")(result).html()
        write_texts_atomic(texts)
    found = result.to_dict() | {"assumed": assumed_of(recorded)}
    finish(found, partial(_show, result), {"model": output, "report": report}, as_json=json_output)


def _cells_of(log: Log, reading: ReadingOptions) -> int | None:
    """Return the number of cells in series that a log's columns of cells prove, or None."""
    import numpy as np

    if (cells := reading.cells_of(log)) is None:
        return None
    ratio = float(np.nanmedian(cells.voltage_v.sum(axis=1) / log.voltage_v))
    return cells.count if abs(ratio - 1.0) <= SAME_SUM else None


def _delays_s(given: str) -> tuple[float, ...]:
    """Return the value of `--delays` [s]; raise InputError if it is none."""
    try:
        delays = tuple(float(text) for text in given.split(","))
    except ValueError:
        delays = ()
    # Slope resistance and heat are defined by the undelayed current.
    if delays[:1] == (0.0,) and all(low < high <= 3600.0 for low, high in pairwise(delays)):
        return delays
    raise InputError(
        "not delays that begin with 0 and increase to 3600 s at most",
        field="--delays",
        value=given,
        cure="give increasing seconds from 0, such as 0,10,30,70",
    )


def _show(result: Identification) -> None:
    """Print how well the model fits, and where it holds; the report has the coefficients."""
    say(result.verdict)
    for text in result.remarks:
        remark(f"note: {text}")
    print_values(f"Model {result.model.name}", result.summary())
