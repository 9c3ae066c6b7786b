"""`cangauge export-fmu`: a model as a functional mock-up unit."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from cangauge.cli.options import MODEL, Json, check_outputs, option
from cangauge.cli.output import finish, note


def export_fmu_command(
    *,
    model: Annotated[Path, MODEL],
    output: Annotated[
        Path, option("-o, --output", "FILE.fmu", "Unit to write.", suffixes=(".fmu",))
    ],
    kind: Annotated[
        Literal["pack", "estimator"],
        option(
            "--kind",
            "pack|estimator",
            "pack: inputs current and temperature, outputs voltage and SoC. estimator: inputs"
            " current, temperature and voltage, outputs SoC, σ and status.",
        ),
    ] = "pack",
    json_output: Json = False,
) -> None:
    """Write a model as a functional mock-up unit (FMI 2.0, co-simulation).

    The unit is compiled for this machine. Its sources are included, to compile it for others.

    Examples
    --------
    `cangauge export-fmu -m pack.json -o pack.fmu`

    `cangauge export-fmu -m pack.json -o estimator.fmu --kind estimator`
    """
    check_outputs([output], [model])
    # Deferred, so that the help page does not wait for numpy and scipy.
    from cangauge.extras.embedded.fmu import export_fmu
    from cangauge.model.model_file import Model

    export_fmu(Model.load(model), output, kind=kind)
    result = {"output": str(output), "kind": kind, "fmi": 2}
    finish(result, partial(note, f"{kind}: {output}"), as_json=json_output)
