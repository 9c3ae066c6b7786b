"""`cangauge twin`: simulate a log whose truth is known."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cangauge.cli.options import Json, check_outputs, option
from cangauge.cli.output import finish, note, print_table, progress


def twin_command(
    *,
    output: Annotated[
        Path,
        option(
            "-o, --output",
            "LOG.parquet|.pq|.csv",
            "Log to write.",
            suffixes=(".parquet", ".pq", ".csv"),
        ),
    ],
    seed: Annotated[
        int,
        option(
            "--seed",
            "N",
            "Number that selects the pack. The same seed gives the same log.",
            within=(0, math.inf),
        ),
    ] = 0,
    effect: Annotated[
        list[str] | None,
        option(
            "--effect",
            "ID[:parameter=value,…]",
            "Fault of the pack or its sensors. Repeat the option for several faults. For an"
            " unknown ID or parameter, the known ones are printed. `gap_v=V` instead of a size"
            " selects the size that changes the voltage by V (RMS). Default: gap_v of 0.3 % of"
            " the pack voltage.",
        ),
    ] = None,
    day: Annotated[
        int,
        option(
            "--day", "N", "Number that selects the drive and the weather.", within=(1, math.inf)
        ),
    ] = 1,
    hours: Annotated[
        float | None,
        option(
            "--hours", "H", "Duration. Default: random, 0.5 to 2.5.", within=(0.05, 12), unit="h"
        ),
    ] = None,
    discharge: Annotated[
        bool,
        option(
            "--discharge",
            "",
            "Drive from full to empty within --hours (default 2.5), as a log for `fit`.",
        ),
    ] = False,
    pack: Annotated[
        str | None,
        option(
            "--pack",
            "KIND",
            "Pack: leaf24, leaf40, car60, car60lfp, compact or module12. Default: random.",
        ),
    ] = None,
    json_output: Json = False,
) -> None:
    """Simulate a pack, a drive, the weather and the sensors, and write the log.

    The cell model is not the voltage model that cangauge identifies. It has tabulated open-circuit
    voltage, Butler–Volmer kinetics, diffusion, two thermal nodes, cell spread, and quantized and
    jittered sensors. Positive current discharges.

    `cangauge.simulate` in Python has further arguments: weather, SoC, speed and chemistry.

    Examples
    --------
    `cangauge twin --seed 1 --discharge -o full.parquet`

    `cangauge twin --seed 1 --day 2 --effect current_offset:offset_a=1.5 -o trip.parquet`

    `cangauge twin --seed 1 --effect weak_cell:gap_v=1 --pack leaf24 -o weak.csv`
    """
    from cangauge.extras.validation.twin.simulation import simulate
    from cangauge.logs.canonical import write_log

    check_outputs([output], [])
    with progress() as show:
        show("simulating")
        simulated = simulate(
            effect or (),
            seed=seed,
            drive=day,
            hours=hours,
            discharge=discharge,
            pack=pack,
            name=output.stem,
        )
    for text in simulated.notes:
        note(text)
    write_log(simulated.log, output)
    result = simulated.to_dict()
    finish(result, partial(_show, result), {"log": output}, as_json=json_output)


def _show(result: dict[str, Any]) -> None:
    (from_pct, to_pct), (cold, warm) = result["true_soc_pct"], result["temperature_c"]
    rows = [
        ["pack", f"{result['pack']}, {result['cells']} cells {result['chemistry']}", ""],
        ["capacity", f"{result['capacity_ah']:.2f}", "Ah"],
        ["duration", f"{result['hours']:.2f}", "h"],
        ["assumed initial SoC", f"{result['assumed_start_soc_pct']:.1f}", "%"],
        ["true SoC", f"{from_pct:.1f} → {to_pct:.1f}", "%"],
        ["temperature", f"{cold:.1f} … {warm:.1f}", "°C"],
        ["voltage sensor's error", f"{result['floor_sensor_v']:.3f}", "V"],
        ["gap", f"{result['gap_v']:.3f}", "V"],
    ]
    rows += [
        [item["effect"], f"{item['parameter']} = {item['value']:.4g}", item["unit"]]
        for item in result["effects"]
    ]
    print_table("Simulated truth", ["", "value", "unit"], rows)
