"""`cangauge export-c`: write a model as C sources for a microcontroller."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from cangauge.cli.options import CELLS, CHEMISTRY, MODEL, CapacityAh, Json, option
from cangauge.cli.output import finish, note
from cangauge.errors import InputError


def export_c_command(
    *,
    model: Annotated[Path | None, MODEL] = None,
    output: Annotated[
        Path,
        option(
            "-o, --output",
            "DIR",
            "Folder for the sources: a new or empty folder, or that of an earlier export.",
        ),
    ],
    chemistry: Annotated[Literal["oxide", "lfp"], CHEMISTRY] = "oxide",
    cells: Annotated[int | None, CELLS] = None,
    capacity_ah: CapacityAh = None,
    platform: Annotated[
        Literal["generic", "esp-idf", "zephyr", "arduino", "foxbms"],
        option(
            "--platform",
            "generic|esp-idf|zephyr|arduino|foxbms",
            "Form of the folder. generic: sources with a Makefile and tests; esp-idf: component;"
            " zephyr: module; arduino: library; foxbms: SoC module of foxBMS 2. Each has an"
            " example.",
        ),
    ] = "generic",
    period: Annotated[
        float,
        option(
            "--period",
            "S",
            "Interval of the currents that the delay line stores. Samples in between need no"
            " memory.",
            within=(0.001, 60),
            unit="s",
        ),
    ] = 0.5,
    json_output: Json = False,
) -> None:
    """Write a model and the estimator as C sources, with tests, for a microcontroller.

    Without a model, give chemistry, cells and capacity: the sources then have the model of a
    typical cell.

    Examples
    --------
    `cangauge export-c -m pack.json -o pack_c`

    `cangauge export-c --chemistry lfp --cells 16 --capacity-ah 280 -o pack_c`  (without
    logs: typical cell, with its uncertainty)
    """
    # Deferred, so that the help page does not wait for numpy and scipy.
    from cangauge.extras.embedded.embedded import export_c, std_at_rest_pct
    from cangauge.model.model_file import Model

    if model is not None:
        if (cells, capacity_ah) != (None, None):
            cure = "leave out -m, or --cells and --capacity-ah"
            raise InputError("the model states these", field="--cells/--capacity-ah", cure=cure)
        chosen = Model.load(model)
    elif cells is None or capacity_ah is None:
        cure = "give -m MODEL, or --chemistry, --cells and --capacity-ah of a pack without logs"
        raise InputError("no model", field="--model", cure=cure)
    else:
        chosen = Model.prior(chemistry, cells, capacity_ah)
    files, line_bytes = export_c(chosen, output, period_s=period, platform=platform)
    std_pct = std_at_rest_pct(chosen)
    result = {
        "folder": str(output),
        "files": files,
        "delay_line_bytes": line_bytes,
        "std_at_rest_pct": std_pct,
    }
    tests = "" if platform == "arduino" else ": `make test` there runs the tests on this machine"
    text = (
        f"{len(files)} files in {output}{tests}.\n"
        f"The delay line takes {line_bytes / 1024:.1f} KiB at {period:g} s a sample.\n"
        f"{chosen.name}: from half a minute of rest the SoC is known to ± {std_pct:.1f} % (1σ)."
    )
    finish(result, partial(note, text), as_json=json_output)
