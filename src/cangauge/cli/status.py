"""`cangauge status`: the state of a running service."""

from __future__ import annotations

from typing import Any, Final

import typer

from cangauge._text import NONE_KNOWN, duration, number
from cangauge.cli.options import EndpointOption, JsonOption, TokenFileOption
from cangauge.cli.output import emit_json, print_table
from cangauge.errors import CangaugeError

USABLE: Final = frozenset({"valid", "degraded"})


def status_command(
    endpoint: EndpointOption = None,
    token_file: TokenFileOption = None,
    json_output: JsonOption = False,
) -> None:
    """Show the state of a running service: SoC ± standard deviation [%], frames, delays.

    Exit code 0: the SoC is valid or degraded. 1: it is invalid or unknown, or no service runs.
    2: bad usage. With `--json` the object is printed with exit codes 0 and 1.

    Examples
    --------
    `cangauge status`

    `cangauge status --endpoint /run/cangauge/can0/status.sock --json`

    `cangauge status --endpoint http://127.0.0.1:9464`
    """
    from cangauge.service.status_client import NotRunningError, fetch_status, find_socket

    try:
        place = endpoint or str(find_socket())
        status = fetch_status(place, token_file)
    except NotRunningError as error:
        if json_output:
            emit_json({"running": False, "status": None, "problem": str(error)})
            raise typer.Exit(1) from error
        raise CangaugeError(str(error)) from error
    if json_output:
        emit_json(status)
    else:
        print_table(f"cangauge at {place}", ("", "<"), status_rows(status))
    if status.get("status") not in USABLE:
        raise typer.Exit(1)


def status_rows(status: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of name and value that show a status."""
    estimate, sample = status["estimate"], status["sample"] or {}
    frames, record = status["frames"], status["record"]
    reasons = "; ".join(each.replace("_", " ") for each in status["reasons"])
    rejected = _counts(status["rejects"])
    rows = [
        ("SoC", f"{number(estimate['soc_pct'], 2)} ± {number(estimate['soc_std_pct'], 2, '%')}"),
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
        (
            "frames",
            f"{frames['received']} received, {frames['used']} used, {frames['lost']} lost",
        ),
        ("rejected", rejected or "none"),
        (
            "bus",
            "; ".join(
                (
                    status["bus"],
                    *filter(None, [status["bus_trouble"]]),
                    _counts(status["bus_counts"]) or "no errors",
                )
            ),
        ),
        ("latency", _delay(status["latency"])),
        ("processing time", _delay(status["step"])),
    ]
    if record is not None:
        problem = f"; FAILING: {record['problem']}" if record["problem"] else ""
        problem += "" if record["active"] else "; ended"
        rows.append(
            (
                "recording",
                f"{record['path']}: {record['frames']} frames,"
                f" {number(1e-6 * record['written_bytes'], 1, 'MB')},"
                f" {record['lost_frames']} frames lost{problem}",
            )
        )
    if problem := status["config"]["problem"]:
        rows.append(("configuration", f"the latest one is REFUSED, the old one stays: {problem}"))
    elif status["config"]["reloading"]:
        rows.append(("configuration", "reading a new one"))
    if status["loop_stuck"]:
        rows.insert(0, ("LOOP STUCK", "the receive loop hangs; restart the service"))
    return [
        *rows,
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
        rows += [
            ("capacity", with_std(health["capacity_ah"], health["capacity_std_ah"], "Ah")),
            (
                "resistance",
                with_std(health["resistance_ratio"], health["resistance_std"], "× the model's", 2),
            ),
            ("current offset", number(health["offset_a"], 2, "A")),
        ]
    if power is not None:
        energy = with_std(
            _times(power["energy_wh"], 1e-3), _times(power["energy_std_wh"], 1e-3), "kWh"
        )
        rows += [
            (
                "discharge for 10 s",
                with_std(power["discharge_a"], power["discharge_std_a"], "A", 0),
            ),
            ("charge for 10 s", with_std(power["charge_a"], power["charge_std_a"], "A", 0)),
            ("energy left", energy),
        ]
    if cells is not None:
        weakest = "" if cells["weakest"] is None else f"number {cells['weakest']}: "
        rows += [
            ("weakest cell", weakest + with_std(cells["soc_pct"], cells["soc_std_pct"], "%")),
            (
                "cells",
                f"{cells['cells']} known, spread {number(cells['spread_pct'], 1, '%')}; pack less"
                f" their sum {with_std(cells['sum_error_v'], cells['sum_std_v'], 'V', 2)}",
            ),
        ]
    return rows + [("NOTICE", each) for each in status["notices"]]


def with_std(value: float | None, std: float | None, unit: str, digits: int = 1) -> str:
    """Return a value and its standard deviation with their unit."""
    return f"{number(value, digits)} ± {number(std, digits, unit)}"


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in counts.items() if value)


def _delay(durations: dict[str, Any]) -> str:
    if not durations["count"]:
        return NONE_KNOWN
    p50, p99 = (_times(durations[f"{name}_at_most_s"], 1e3) for name in ("p50", "p99"))
    return f"median at most {number(p50, 3, 'ms')}, 99 % within {number(p99, 3, 'ms')}"


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value
