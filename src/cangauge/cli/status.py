"""`cangauge status`: the state of a running service; the line of `cangauge run` on a terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn

import typer
from rich.console import RenderableType
from rich.live import Live
from rich.text import Text

from cangauge._text import NONE_KNOWN, energy_text, known_soc, number, possible, uncertain
from cangauge.cli.options import Json, option
from cangauge.cli.output import (
    PlainConsole,
    emit_json,
    finish,
    known_rows,
    print_values,
    text_table,
)
from cangauge.errors import CangaugeError, InputError
from cangauge.types import REASON_WORDS, Reason

WATCH_EVERY_S: Final = 0.5
"""Interval of `--watch` [s]."""
_STYLE: Final = {"initialising": "yellow", "valid": "green", "degraded": "yellow", "invalid": "red"}


def status_command(
    *,
    endpoint: Annotated[
        Path | None,
        option(
            "--endpoint",
            "PATH",
            "Unix socket of the service. Default: the service running on this machine. From"
            ' another machine: `curl -H "Authorization: Bearer TOKEN" http://HOST:PORT/status`.',
        ),
    ] = None,
    watch: Annotated[
        bool, option("--watch", "", "Update the output every half second, until Ctrl-C.")
    ] = False,
    json_output: Json = False,
) -> None:
    """Show the state of a running service: SoC ± standard deviation [%], inputs, bus.

    Exit code 0: the SoC is valid or degraded. 1: the SoC is invalid or unknown, or no service runs.
    2: bad usage. With `--json`, the object is printed for exit codes 0 and 1. `--watch` waits for
    a service that is not started yet.

    Examples
    --------
    `cangauge status`

    `cangauge status --watch`

    `cangauge status --endpoint /run/cangauge/can0/socketcan-can0.sock --json`
    """
    from cangauge.service.status_client import NotRunningError, fetch_status, find_socket, no_status

    def ask() -> tuple[dict[str, Any], str, Text, dict[str, str]]:
        place = endpoint or find_socket()
        status = fetch_status(place)
        try:
            return status, f"cangauge at {place}", live_text(status), status_values(status)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise no_status(place) from error

    if watch:
        _watch(ask)
    try:
        status, title, _, values = ask()
    except NotRunningError as error:
        if json_output:
            emit_json({"running": False, "status": None, "problem": str(error)})
            raise typer.Exit(1) from error
        raise CangaugeError(str(error)) from error
    finish(status, partial(print_values, title, values), as_json=json_output)
    if status["status"] not in {"valid", "degraded"}:
        raise typer.Exit(1)


def _watch(ask: Callable[[], tuple[object, str, Text, dict[str, str]]]) -> NoReturn:
    """Show the status until stopped, in lines where stdout is no terminal."""
    shown = PlainConsole(highlight=False)
    with ExitStack() as stack:
        show: Callable[[RenderableType], None] = shown.print
        if shown.is_terminal:
            live = stack.enter_context(Live(console=shown, auto_refresh=False, screen=True))
            show = partial(live.update, refresh=True)
        while True:
            content: RenderableType
            try:
                _, title, content, values = ask()
                if shown.is_terminal:
                    content = text_table(title, ("", ""), known_rows(values))
            except InputError:
                raise  # waiting does not mend it
            except CangaugeError as error:
                content = Text(f"NO ANSWER: {error}", style="bold red")
            show(content)
            time.sleep(WATCH_EVERY_S)


def live_text(status: dict[str, Any]) -> Text:
    """Return SoC ± standard deviation, status, voltage, residual and rate in one line."""
    estimate = status["estimate"]
    sample = status["sample"]
    reasons = status["reasons"]
    text = Text("SoC ", no_wrap=True, overflow="ellipsis")
    text.append(known_soc(estimate["soc_pct"], estimate["soc_std_pct"], 2), style="bold")
    text.append("  ")
    text.append(status["status"], style=_STYLE[status["status"]])
    if reasons:
        text.append(f" ({_words(reasons)})", style="dim")
    if sample is not None:
        residual = number(estimate["residual_v"], 3, "V")
        text.append(f"  {number(sample['voltage_v'], 2, 'V')}  residual {residual}")
    text.append(f"  {status['samples_per_s']:.0f} samples/s")
    if status["bus_trouble"]:
        text.append(f"  {status['bus_trouble']}", style="bold red")
    return text


def status_values(status: dict[str, Any]) -> dict[str, str]:
    """Return names and values that show a status; a dash for what is not known yet."""
    estimate = status["estimate"]
    sample = status["sample"] or {}
    frames = status["frames"]
    reasons = _words(status["reasons"])
    config = status["config"]
    bus = (status["bus"], status["bus_trouble"], _counts(status["bus_counts"]) or "no errors")
    refused = f"the latest one is REFUSED, the old one stays: {config['problem']}"
    reading = "reading a new one" if config["reloading"] else NONE_KNOWN
    recorded = NONE_KNOWN
    if (record := status["record"]) is not None:
        recorded = f"{record['path']}, {record['lost_frames']} frames lost"
        recorded += f"; FAILING: {record['problem']}" if record["problem"] else ""
    return {
        "LOOP STUCK": "the receive loop hangs; restart the service"
        if status["loop_stuck"]
        else NONE_KNOWN,
        "SoC": known_soc(estimate["soc_pct"], estimate["soc_std_pct"], 2),
        "status": status["status"] + (f": {reasons}" if reasons else ""),
        "by voltage alone": number(estimate["soc_newton_pct"], 2, "%"),
        "by charge alone": number(estimate["soc_coulomb_pct"], 2, "%"),
        "current": number(sample.get("current_a"), 2, "A (positive = discharge)"),
        "voltage": number(sample.get("voltage_v"), 2, "V"),
        "residual": number(estimate["residual_v"], 3, "V"),
        "temperature": number(sample.get("temperature_c"), 1, "°C"),
        **pack_values(status),
        **{f"NOTICE {k}": each for k, each in enumerate(status["notices"], start=1)},
        "latest sample": number(sample.get("age_s"), 2, "s ago"),
        "frames": ", ".join(f"{frames[name]} {name}" for name in ("received", "used", "lost")),
        "rejected": _counts(status["rejects"]) or "none",
        "bus": "; ".join(filter(None, bus)),
        "recording": recorded,
        "configuration": refused if config["problem"] else reading,
        "vehicle": status["vehicle"],
        "model": f"{status['model']} ({status['method']}, time: {status['time_source']})",
    }


def pack_values(report: Mapping[str, Any]) -> dict[str, str]:
    """Return names and values of health, power and cells, where known (`PackReport.to_dict`)."""
    health = report["health"]
    power = report["power"]
    cells = report["cells"]
    values = {}
    if health is not None:
        values = {
            "capacity": uncertain(health["capacity_ah"], health["capacity_std_ah"], "Ah"),
            "resistance": uncertain(
                health["resistance_ratio"], health["resistance_std"], "× the model's"
            ),
            "current offset": number(health["offset_a"], 2, "A"),
        }
    if power is not None:
        for way in ("discharge", "charge"):
            values[f"possible {way}, 10 s"] = possible(
                power[f"{way}_a"], power[f"{way}_std_a"], "A"
            )
        left = energy_text(power["energy_wh"], power["energy_std_wh"])
        to_pct = power["energy_to_soc_pct"]
        values["energy left"] = left if to_pct is None else f"{left} to {to_pct:.0f} % SoC"
    if cells is not None:
        weakest = "" if cells["weakest"] is None else f"number {cells['weakest']}: "
        less = uncertain(cells["sum_error_v"], cells["sum_std_v"], "V")
        values |= {
            "weakest cell": weakest + uncertain(cells["soc_pct"], cells["soc_std_pct"], "%"),
            "cells": f"{cells['cells']} known, spread {number(cells['spread_pct'], 1, '%')}; pack"
            f" less their sum {less}",
        }
    return values


def _words(reasons: list[str]) -> str:
    return "; ".join(REASON_WORDS[Reason[each.upper()]] for each in reasons)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in counts.items() if value)
