"""`cangauge export-fmu`: a model as a functional mock-up unit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast

import typer

from cangauge.cli.options import JsonOption, check_outputs, suffixed
from cangauge.cli.output import emit_json, note
from cangauge.errors import InputError


def export_fmu_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file (JSON).")],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="FILE.fmu", callback=suffixed(".fmu"), help="Unit to write."
        ),
    ],
    kind: Annotated[
        str,
        typer.Option(
            metavar="pack|estimator",
            help="pack: current and temperature in, voltage and SoC out; estimator: voltage too in,"
            " SoC, σ and status out.",
        ),
    ] = "pack",
    fmi: Annotated[int, typer.Option(metavar="2|3", help="Version of the interface.")] = 3,
    json_output: JsonOption = False,
) -> None:
    """Write a model as a functional mock-up unit (FMI 2.0 or 3.0, co-simulation).

    The unit is compiled by the C compiler of this machine, and holds its sources for others.

    Examples
    --------
    `cangauge export-fmu pack.json -o pack.fmu`

    `cangauge export-fmu pack.json -o estimator.fmu --kind estimator --fmi 2`
    """
    if kind not in {"pack", "estimator"}:
        raise InputError("neither pack nor estimator", field="--kind", value=kind)
    if fmi not in {2, 3}:
        raise InputError("neither 2 nor 3", field="--fmi", value=fmi)
    check_outputs([output], [model])
    # Deferred, so that the help page does not wait for numpy and scipy.
    from cangauge.extras.embedded.fmu import Kind, Version, export_fmu
    from cangauge.model.model_file import Model

    export_fmu(Model.load(model), output, kind=cast("Kind", kind), version=cast("Version", fmi))
    if json_output:
        emit_json({"output": str(output), "kind": kind, "fmi": fmi})
        return
    note(f"{kind}: {output}")
