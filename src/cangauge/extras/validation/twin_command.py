"""`cangauge twin`: simulate a log whose truth is known."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from cangauge._files import write_text_atomic
from cangauge.cli.options import JsonOption, check_outputs, suffixed, within
from cangauge.cli.output import console, emit_json, note, print_table
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.extras.validation.twin.simulation import PlantName


def twin_command(  # noqa: PLR0917 - typer passes options by name
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="LOG",
            callback=suffixed(".parquet", ".pq", ".csv", ".bdf"),
            help="Log to write: .parquet or .csv.",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="Selects the pack. Same seed, same log.")
    ] = 0,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ID[:parameter=value,…]",
            help="Fault of the pack or its sensors; repeat for several. `gap_v=V` in place of a"
            " size: the size that opens this RMS gap. Default: a gap of 0.3 % of the pack voltage.",
        ),
    ] = None,
    day: Annotated[
        int, typer.Option(metavar="N", min=1, help="Number of the drive, with its weather.")
    ] = 1,
    hours: Annotated[
        float | None, typer.Option(metavar="H", help="Duration [h]. Default: 0.5 to 2.5, drawn.")
    ] = None,
    ambient_c: Annotated[
        float | None,
        typer.Option(metavar="C", help="Ambient temperature [°C]. Default: −10 to 35, drawn."),
    ] = None,
    start_soc: Annotated[
        float | None, typer.Option(metavar="P", help="Initial SoC [%]. Default: drawn.")
    ] = None,
    end_soc: Annotated[
        float | None, typer.Option(metavar="P", help="SoC at which the drive ends [%].")
    ] = None,
    discharge: Annotated[
        bool,
        typer.Option(
            "--discharge",
            help="Drive from full to empty within the hours (default 2.5 h): a log for `fit`.",
        ),
    ] = False,
    speed: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Driving schedule: CSV of time [s] and speed [m/s], repeated."
        ),
    ] = None,
    pack: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="leaf24, leaf40, car60, car60lfp, compact or module12. Default: drawn.",
        ),
    ] = None,
    chemistry: Annotated[
        str | None, typer.Option(metavar="NAME", help="nmc, lmo, nca or lfp.")
    ] = None,
    plant: Annotated[
        str,
        typer.Option(
            metavar="twin|equation|published|pybamm",
            help="Model of the cells; pybamm needs the extra cangauge[pybamm].",
        ),
    ] = "twin",
    soc: Annotated[
        str,
        typer.Option(
            metavar="full|start",
            help="soc_pct of the log: assumed initial SoC, then the true SoC; or the former alone.",
        ),
    ] = "full",
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.json",
            callback=suffixed(".json"),
            help="Write the truth to this file too.",
        ),
    ] = None,
    list_effects: Annotated[
        bool, typer.Option("--list", help="List the effects and their parameters.")
    ] = False,
    json_output: JsonOption = False,
) -> None:
    """Simulate a pack, a drive, the weather and the sensors: a log whose truth is known.

    The cell model is independent of the voltage model that cangauge identifies: tabulated
    open-circuit voltage, Butler–Volmer kinetics, diffusion, two thermal nodes, cell spread,
    quantized and jittered sensors. Positive current discharges.

    Examples
    --------
    `cangauge twin --seed 1 --discharge -o full.parquet`

    `cangauge twin --seed 1 --day 2 --effect current_offset:offset_a=1.5 -o trip.parquet`

    `cangauge twin --seed 1 --day 3 --effect weak_cell:gap_v=1 --ambient-c -5 -o cold.csv`

    `cangauge twin --list`
    """
    from cangauge.extras.validation.twin.drive import read_speed
    from cangauge.extras.validation.twin.simulation import simulate
    from cangauge.logs.canonical import write_log

    if list_effects:
        _list(json_output)
        return
    if output is None:
        raise InputError("no log to write", field="-o", cure="name a .parquet or a .csv file")
    if soc not in {"full", "start"}:
        raise InputError("unknown choice", field="--soc", value=soc, cure="use full or start")
    check_outputs([output, truth], [speed] if speed is not None else [])
    began = time.perf_counter()
    with console.status("simulating"):
        simulated = simulate(
            effect or (),
            seed=seed,
            drive=day,
            hours=within(hours, 0.05, 12.0, option="--hours", unit="h"),
            ambient_c=within(ambient_c, -30.0, 50.0, option="--ambient-c", unit="°C"),
            start_soc_pct=within(start_soc, 0.0, 100.0, option="--start-soc", unit="%"),
            end_soc_pct=within(end_soc, 0.0, 100.0, option="--end-soc", unit="%"),
            discharge=discharge,
            speed_ms=None if speed is None else read_speed(speed),
            pack=pack,
            chemistry=chemistry,
            plant=cast("PlantName", plant),
            name=output.stem,
        )
    for scaled in simulated.limited:
        note(
            f"{scaled.fault.id}: on this drive its physical limits allow a gap of"
            f" {scaled.reached_v:.3g} V, not {scaled.target_v:.3g} V"
        )
    write_log(simulated.log if soc == "full" else simulated.recording.log, output)
    result = {
        "log": str(output),
        **simulated.to_dict(),
        "seconds": time.perf_counter() - began,
    }
    if truth is not None:
        write_text_atomic(truth, json.dumps(result, indent=1) + "\n")
    if json_output:
        emit_json(result)
        return
    _show(result)
    note(f"log: {output}")


def _show(result: dict[str, Any]) -> None:
    (from_pct, to_pct), (cold, warm) = result["true_soc_pct"], result["temperature_c"]
    rows = [
        ["pack", f"{result['pack']}, {result['cells']} cells {result['chemistry']}", ""],
        ["capacity", f"{result['capacity_ah']:.2f}", "Ah"],
        ["duration", f"{result['hours']:.2f}", "h"],
        ["assumed initial SoC", f"{result['assumed_start_soc_pct']:.1f}", "%"],
        ["true SoC", f"{from_pct:.1f} → {to_pct:.1f}", "%"],
        ["temperature", f"{cold:.1f} … {warm:.1f}", "°C"],
        ["sensor floor", f"{result['floor_sensor_v']:.3f}", "V"],
        ["gap", f"{result['gap_v']:.3f}", "V"],
    ]
    rows += [
        [item["effect"], f"{item['parameter']} = {item['value']:.4g}", item["unit"]]
        for item in result["effects"]
    ]
    print_table("Simulated truth", ["", "value", "unit"], rows)


def _list(json_output: bool) -> None:
    from cangauge.extras.validation.twin.faults import fault_kinds

    kinds = (*fault_kinds(), *fault_kinds(outside=True))
    if json_output:
        emit_json(
            {
                "effects": [
                    {
                        "effect": kind.id,
                        "family": kind.family,
                        "parameter": kind.parameter,
                        "unit": kind.unit,
                        "signed": kind.signed,
                        "shape": list(kind.shape),
                        "says": kind.summary,
                    }
                    for kind in kinds
                ]
            }
        )
        return
    print_table(
        "Effects",
        ["id", "parameters", "effect on the log"],
        [
            [
                kind.id,
                f"{kind.parameter} [{kind.unit}]" + "".join(f", {name}" for name in kind.shape),
                kind.summary,
            ]
            for kind in kinds
        ],
    )
