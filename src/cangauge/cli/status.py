"""`cangauge status`: the state of a running service; the line of `cangauge run` on a terminal."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.console import RenderableType
from rich.live import Live
from rich.text import Text

from cangauge._text import (
    NONE_KNOWN,
    duration,
    known_soc,
    number,
    possible,
    uncertain,
    uncertain_energy,
)
from cangauge.cli.options import JsonOption
from cangauge.cli.output import PlainConsole, emit_json, print_table, text_table
from cangauge.errors import CangaugeError, InputError
from cangauge.types import REASON_WORDS, Reason

WATCH_EVERY_S: Final = 0.5
"""Interval of `--watch` [s]."""
USABLE: Final = frozenset({"valid", "degraded"})
_STYLE: Final = {"initialising": "yellow", "valid": "green", "degraded": "yellow", "invalid": "red"}


def status_command(
    endpoint: Annotated[
        str | None,
        typer.Option(
            metavar="PATH|URL",
            help="Unix socket of the service, or http://HOST:PORT. Default: the service running on"
            " this machine.",
        ),
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File with the bearer token of an HTTP endpoint; or in CANGAUGE_HTTP_TOKEN.",
        ),
    ] = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show it again every half second, until Ctrl-C.")
    ] = False,
    json_output: JsonOption = False,
) -> None:
    """Show the state of a running service: SoC ± standard deviation [%], frames, delays.

    Exit code 0: the SoC is valid or degraded. 1: it is invalid or unknown, or no service runs.
    2: bad usage. With `--json` the object is printed with exit codes 0 and 1. `--watch` may be
    started before the service, and waits for it.

    Examples
    --------
    `cangauge status`

    `cangauge status --watch --endpoint http://127.0.0.1:9464`

    `cangauge status --endpoint /run/cangauge/can0/status.sock --json`
    """
    from cangauge.service.status_client import NotRunningError

    if watch:
        _watch(endpoint, token_file)
        return
    try:
        place, status = _ask(endpoint, token_file)
    except NotRunningError as error:
        if json_output:
            emit_json({"running": False, "status": None, "problem": str(error)})
            raise typer.Exit(1) from error
        raise CangaugeError(str(error)) from error
    if json_output:
        emit_json(status)
    else:
        print_table(f"cangauge at {place}", ("", ""), status_rows(status))
    if status["status"] not in USABLE:
        raise typer.Exit(1)


def _ask(endpoint: str | None, token_file: Path | None) -> tuple[str, dict[str, Any]]:
    from cangauge.service.status_client import fetch_status, find_socket

    place = endpoint or str(find_socket())
    return place, fetch_status(place, token_file)


def _watch(endpoint: str | None, token_file: Path | None) -> None:
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
                place, status = _ask(endpoint, token_file)
                content = live_text(status)
                if shown.is_terminal:
                    content = text_table(f"cangauge at {place}", ("", ""), status_rows(status))
            except InputError:
                raise  # waiting does not mend it
            except CangaugeError as error:
                content = Text(f"NO ANSWER: {error}", style="bold red")
            show(content)
            time.sleep(WATCH_EVERY_S)


def live_text(status: dict[str, Any]) -> Text:
    """Return SoC ± standard deviation, status, voltage, residual and rate in one line."""
    estimate, sample, reasons = status["estimate"], status["sample"], status["reasons"]
    text = Text("SoC ", no_wrap=True, overflow="ellipsis")
    text.append(known_soc(estimate["soc_pct"], estimate["soc_std_pct"], 2), style="bold")
    text.append("  ")
    text.append(status["status"], style=_STYLE[status["status"]])
    if reasons:
        text.append(f" ({_words(reasons)})", style="dim")
    if sample is not None:
        residual = number(_times(estimate["residual_v"], 1e3), 0, "mV")
        text.append(f"  {number(sample['voltage_v'], 2, 'V')}  residual {residual}")
    text.append(f"  {status['samples_per_s']:.0f} samples/s")
    if status["bus_trouble"]:
        text.append(f"  {status['bus_trouble']}", style="bold red")
    return text


def status_rows(status: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of name and value that show a status; none for what is not known yet."""
    estimate, sample = status["estimate"], status["sample"] or {}
    frames, reasons = status["frames"], _words(status["reasons"])
    bus = (status["bus"], status["bus_trouble"], _counts(status["bus_counts"]) or "no errors")
    rows = [
        ("SoC", known_soc(estimate["soc_pct"], estimate["soc_std_pct"], 2)),
        ("status", status["status"] + (f": {reasons}" if reasons else "")),
        ("by voltage alone", number(estimate["soc_newton_pct"], 2, "%")),
        ("by charge alone", number(estimate["soc_coulomb_pct"], 2, "%")),
        ("current", number(sample.get("current_a"), 2, "A (positive = discharge)")),
        ("voltage", number(sample.get("voltage_v"), 2, "V")),
        ("residual", number(_times(estimate["residual_v"], 1e3), 0, "mV")),
        ("temperature", number(sample.get("temperature_c"), 1, "°C")),
        *_pack_rows(status),
        ("latest sample", f"{number(sample.get('age_s'), 2, 's')} ago"),
        ("samples", f"{status['samples']} ({number(status['samples_per_s'], 1, '/s')})"),
        ("frames", ", ".join(f"{frames[name]} {name}" for name in ("received", "used", "lost"))),
        ("rejected", _counts(status["rejects"]) or "none"),
        ("bus", "; ".join(filter(None, bus))),
        ("latency", _delay(status["latency"])),
        ("processing time", _delay(status["step"])),
    ]
    if (record := status["record"]) is not None:
        problem = f"; FAILING: {record['problem']}" if record["problem"] else ""
        problem += "" if record["active"] else "; ended"
        size = _size(record["written_bytes"])
        text = f"{record['path']}: {record['frames']} frames, {size}"
        rows.append(("recording", f"{text}, {record['lost_frames']} frames lost{problem}"))
    if problem := status["config"]["problem"]:
        rows.append(("configuration", f"the latest one is REFUSED, the old one stays: {problem}"))
    elif status["config"]["reloading"]:
        rows.append(("configuration", "reading a new one"))
    if status["loop_stuck"]:
        rows.insert(0, ("LOOP STUCK", "the receive loop hangs; restart the service"))
    return [
        *(row for row in rows if not row[1].startswith(NONE_KNOWN)),
        ("vehicle", status["vehicle"]),
        ("model", f"{status['model']} ({status['method']}, time: {status['time_source']})"),
        (
            "running for",
            f"{duration(status['uptime_s'])}, cangauge {status['version']}, {status['core']} core",
        ),
    ]


def _pack_rows(status: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of health, power and cells, where known."""
    health, power, cells = status["health"], status["power"], status["cells"]
    rows = []
    if health is not None:
        ratio = (health["resistance_ratio"], health["resistance_std"])
        rows += [
            ("capacity", _with_std(health["capacity_ah"], health["capacity_std_ah"], "Ah")),
            ("resistance", _with_std(*ratio, "× the model's", 2)),
            ("current offset", number(health["offset_a"], 2, "A")),
        ]
    if power is not None:
        rows += [
            (f"possible {way}, 10 s", possible(power[f"{way}_a"], power[f"{way}_std_a"], "A"))
            for way in ("discharge", "charge")
        ]
        energy = uncertain_energy(power["energy_wh"], power["energy_std_wh"])
        rows.append(("energy left", energy))
    if cells is not None:
        weakest = "" if cells["weakest"] is None else f"number {cells['weakest']}: "
        less = uncertain(cells["sum_error_v"], cells["sum_std_v"], "V")
        spread = number(cells["spread_pct"], 1, "%")
        rows += [
            ("weakest cell", weakest + _with_std(cells["soc_pct"], cells["soc_std_pct"], "%")),
            ("cells", f"{cells['cells']} known, spread {spread}; pack less their sum {less}"),
        ]
    return rows + [("NOTICE", each) for each in status["notices"]]


def _with_std(value: float | None, std: float | None, unit: str, digits: int = 1) -> str:
    return f"{number(value, digits)} ± {number(std, digits, unit)}"


def _words(reasons: list[str]) -> str:
    return "; ".join(REASON_WORDS[Reason[each.upper()]] for each in reasons)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in counts.items() if value)


def _delay(durations: dict[str, Any]) -> str:
    if not durations["count"]:
        return NONE_KNOWN
    bounds = (durations[f"{name}_at_most_s"] for name in ("p50", "p99"))
    p50, p99 = ("over 1 s" if s is None else f"at most {1e3 * s:g} ms" for s in bounds)
    return f"median {p50}, 99 % {p99}"


def _size(count: int) -> str:
    return number(1e-3 * count, 0, "kB") if count < 1e6 else number(1e-6 * count, 1, "MB")


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value
