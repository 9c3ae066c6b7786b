"""`cangauge twin`: a simulated pack and drive → a log whose truth is known."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer

from cangauge._io import write_text_atomic
from cangauge.cli.options import JsonOption, check_outputs, within
from cangauge.cli.output import console, emit_json, note, print_table
from cangauge.errors import InputError
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.validation.twin.day import Day, draw_day, read_speed
from cangauge.validation.twin.faults import Fault, fault_kinds, parse_effect
from cangauge.validation.twin.plant import Plant
from cangauge.validation.twin.scaling import scale_to_gap
from cangauge.validation.twin.simulate import Recording, Truth, simulate
from cangauge.validation.twin.world import PlantName, draw_plant, record_day, rms

DEFAULT_GAP = 0.003
"""Gap of an effect whose size is not given, as a part of the nominal voltage."""

EMPTY = 0.015
"""State of charge at which a whole discharge ends: a fit takes 2 % and less for empty."""


def twin_command(  # noqa: PLR0917 - typer passes options by name
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="LOG", help="The log: .parquet or .csv."),
    ] = None,
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="Which pack; the same seed, the same log.")
    ] = 0,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ID[:parameter=value,…]",
            help="A fault of the pack or its sensors; repeat for several. `gap_v=V` in place of"
            " a size: as large as it takes to open this RMS gap. Without either: 0.3 % of the"
            " pack's voltage.",
        ),
    ] = None,
    day: Annotated[
        int, typer.Option(metavar="N", min=1, help="Which day (drive and weather) of the pack.")
    ] = 1,
    hours: Annotated[
        float | None, typer.Option(metavar="H", help="Length [h]. Default: 0.5 to 2.5 at random.")
    ] = None,
    ambient_c: Annotated[
        float | None,
        typer.Option(metavar="C", help="Ambient temperature [°C]. Default: −10 to 35 at random."),
    ] = None,
    start_soc: Annotated[
        float | None, typer.Option(metavar="P", help="SoC at the start [%]. Default: at random.")
    ] = None,
    end_soc: Annotated[
        float | None, typer.Option(metavar="P", help="SoC at which the drive ends at last [%].")
    ] = None,
    discharge: Annotated[
        bool,
        typer.Option(
            "--discharge",
            help="From full to empty within the hours (default 2.5 h), to identify a model on.",
        ),
    ] = False,
    speed: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="A driving schedule: CSV of time [s] and speed [m/s], repeated."
        ),
    ] = None,
    pack: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="leaf24, leaf40, car60, car60lfp, compact or module12. Default: at random.",
        ),
    ] = None,
    chemistry: Annotated[
        str | None, typer.Option(metavar="NAME", help="nmc, lmo, nca or lfp.")
    ] = None,
    plant: Annotated[
        str,
        typer.Option(
            metavar="twin|equation|published|pybamm",
            help="What simulates the cells; pybamm needs the extra cangauge[pybamm].",
        ),
    ] = "twin",
    soc: Annotated[
        str,
        typer.Option(
            metavar="full|start",
            help="soc_pct of the log: the true SoC after the assumed start, or the start alone.",
        ),
    ] = "full",
    truth: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write what is true here too.")
    ] = None,
    list_effects: Annotated[
        bool, typer.Option("--list", help="List the effects and their parameters, and leave.")
    ] = False,
    json_output: JsonOption = False,
) -> None:
    """Simulate a pack, a drive, the weather and the sensors: a log whose truth is known.

    The cells are no copy of the voltage model that cangauge identifies (tabulated open-circuit
    voltage, Butler–Volmer kinetics, diffusion, two thermal nodes, cell spread, quantised and
    jittered sensors), so what it finds here it has earned. Positive current discharges.

    For example:

    `cangauge twin --seed 1 --discharge -o full.parquet`

    `cangauge twin --seed 1 --day 2 --effect current_offset:offset_a=1.5 -o trip.parquet`

    `cangauge twin --seed 1 --day 3 --effect weak_cell:gap_v=1 --ambient-c -5 -o cold.csv`

    `cangauge twin --list`
    """
    if list_effects:
        _list(json_output)
        return
    if output is None:
        raise InputError("no log to write", field="-o", cure="name a .parquet or a .csv file")
    if soc not in {"full", "start"}:
        raise InputError("no such choice", field="--soc", value=soc, cure="use full or start")
    check_outputs([output, truth], [speed] if speed is not None else [])
    began = time.perf_counter()
    with console.status("drawing the pack") as status:
        stand_in = draw_plant(
            np.random.default_rng([seed, 1]), pack, chemistry, cast("PlantName", plant)
        )
        what = draw_day(
            np.random.default_rng([seed, 4, day]),
            stand_in.pack,
            hours=2.5 if hours is None and discharge else _hours(hours),
            ambient_c=_ambient(ambient_c),
            start_soc=_start(start_soc, discharge=discharge),
            end_soc=EMPTY if end_soc is None and discharge else _share(end_soc, "--end-soc"),
            speed_ms=None if speed is None else read_speed(speed),
            discharge=discharge,
        )
        status.update("simulating")
        healthy = simulate(stand_in, what)
        faults = _faults(effect or [], stand_in, what, healthy, seed)
        recording = record_day(stand_in, what, faults, name=output.stem, healthy=healthy)
    log = _with_soc(recording, soc)
    write_log(log, output)
    result = _result(recording, stand_in, faults, output, time.perf_counter() - began)
    if truth is not None:
        write_text_atomic(truth, json.dumps(result, indent=1) + "\n")
    if json_output:
        emit_json(result)
        return
    _show(result)
    note(f"log: {output}")


def _hours(given: float | None) -> float | None:
    return given if given is None else within(given, 0.05, 12.0, option="--hours", unit="h")


def _ambient(given: float | None) -> float | None:
    return given if given is None else within(given, -30.0, 50.0, option="--ambient-c", unit="°C")


def _start(given: float | None, *, discharge: bool) -> float | None:
    if given is None:
        return 1.0 if discharge else None
    return _share(given, "--start-soc")


def _share(given: float | None, option: str) -> float | None:
    return given if given is None else within(given, 0.0, 100.0, option=option, unit="%") / 100.0


def _faults(
    texts: list[str], plant: Plant, day: Day, healthy: Truth, seed: int
) -> tuple[Fault, ...]:
    faults = []
    for number, text in enumerate(texts):
        asked = parse_effect(
            text,
            plant.pack,
            seed=seed + 7919 * number,
            default_gap_v=DEFAULT_GAP * plant.pack.nominal_v,
        )
        fault = asked.fault
        if asked.gap_v is not None:
            scaled = scale_to_gap(plant, [day], fault, asked.gap_v, [healthy])
            fault = scaled.fault
            if scaled.limited:
                note(
                    f"{fault.id}: this drive shows {scaled.reached_v:.3g} V of the gap of"
                    f" {asked.gap_v:.3g} V at most, within what is physical"
                )
        faults.append(fault)
    return tuple(faults)


def _with_soc(recording: Recording, soc: str) -> Log:
    log = recording.log
    if soc == "start" or log.soc_pct is None:
        return log
    reference = recording.true_soc_pct.copy()
    reference[0] = log.soc_pct[0]  # what the gauge assumes
    return replace(log, soc_pct=reference)


def _result(
    recording: Recording, plant: Plant, faults: tuple[Fault, ...], output: Path, seconds: float
) -> dict[str, Any]:
    log, pack = recording.log, plant.pack
    assumed = log.first_soc()
    return {
        "log": str(output),
        "rows": len(log),
        "hours": log.duration_s / 3600.0,
        "seconds": seconds,
        "plant": plant.name,
        "pack": pack.name,
        "chemistry": pack.chemistry.name,
        "cells": pack.cells,
        "capacity_ah": pack.capacity_ah,
        "assumed_start_soc_pct": None if assumed is None else assumed[1],
        "true_soc_pct": [float(recording.true_soc_pct[0]), float(recording.true_soc_pct[-1])],
        "temperature_c": [float(log.temperature_c.min()), float(log.temperature_c.max())],
        "floor_sensor_v": rms(recording.floor_v),
        "gap_v": rms(recording.gap_v),
        "effects": [
            {
                "effect": fault.id,
                "parameter": fault.kind.parameter,
                "value": fault.size,
                "unit": fault.kind.unit,
                "shape": fault.full_shape(),
            }
            for fault in faults
        ],
    }


def _show(result: dict[str, Any]) -> None:
    (from_pct, to_pct), (cold, warm) = result["true_soc_pct"], result["temperature_c"]
    rows = [
        ["pack", f"{result['pack']}, {result['cells']} cells {result['chemistry']}", ""],
        ["capacity", f"{result['capacity_ah']:.2f}", "Ah"],
        ["length", f"{result['hours']:.2f}", "h"],
        ["assumed start", f"{result['assumed_start_soc_pct']:.1f}", "%"],
        ["true SoC", f"{from_pct:.1f} → {to_pct:.1f}", "%"],
        ["temperature", f"{cold:.1f} … {warm:.1f}", "°C"],
        ["floor of the sensors", f"{result['floor_sensor_v']:.3f}", "V"],
        ["gap", f"{result['gap_v']:.3f}", "V"],
    ]
    rows += [
        [item["effect"], f"{item['parameter']} = {item['value']:.4g}", item["unit"]]
        for item in result["effects"]
    ]
    print_table("Simulated truth", ["", "value", "<unit"], rows)


def _list(json_output: bool) -> None:
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
                        "says": kind.says,
                    }
                    for kind in kinds
                ]
            }
        )
        return
    print_table(
        "Effects",
        ["id", "<parameters", "<what happens"],
        [
            [
                kind.id,
                f"{kind.parameter} [{kind.unit}]" + "".join(f", {name}" for name in kind.shape),
                kind.says,
            ]
            for kind in kinds
        ],
    )
