"""`cangauge demo`: the main job, end to end, with a picture."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow.parquet as pq
import typer
from rich.table import Table

from cangauge._io import check_writable, write_text_atomic
from cangauge._resources import shared_file
from cangauge.bus.open import has_socketcan
from cangauge.bus.vehicle import load_vehicle
from cangauge.cli.options import JsonOption
from cangauge.cli.output import console, emit_json, note
from cangauge.errors import CangaugeError, InputError
from cangauge.estimate.offline import EstimateTable, Scores, estimate_log, score
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Reason, Status
from cangauge.identify.fit import Identification, fit
from cangauge.logs.read import read_log
from cangauge.model.model_file import model_json
from cangauge.model.published import SOC_NEWTON_MAE_PCT, VOLTAGE_MAE_PCT
from cangauge.replay.steps import quantisation_bound
from cangauge.report.estimate import estimate_report
from cangauge.report.fit import fit_report

TRAINED_ON = "leaf2012_reconstruction_white.parquet"
PLAYED = "leaf2012_reconstruction_correlated.parquet"
IDLE_S = 3.0
"""The service ends by itself after so long without a sample [s]."""


def demo_command(
    folder: Annotated[
        Path, typer.Option("--folder", metavar="DIR", help="Where model and pages are written.")
    ] = Path("out/demo"),
    json_output: JsonOption = False,
) -> None:
    """Do the whole job on the shipped log: fit, replay on a bus, live SoC, pages, error table.

    The log is a reconstruction of the published 2012 Leaf test, made from its equation: no
    recording of a car. The bus is vcan0 where there is one, else UDP multicast on this machine.

    For example:

    `cangauge demo`

    `cangauge demo --folder /tmp/demo --json`
    """
    began = time.monotonic()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"this folder cannot be made: {error.strerror}",
            source=folder,
            field="--folder",
            cure="name another one",
        ) from error
    check_writable(folder / "model.json")
    model_path, live_path = folder / "model.json", folder / "live.parquet"
    fit_page, soc_page = folder / "fit.html", folder / "soc.html"
    note("1/4  fitting the voltage model on 2.6 h of the reconstructed Leaf test …")
    identification = fit([read_log(shared_file("replay", TRAINED_ON))])
    write_text_atomic(model_path, model_json(identification.model))
    write_text_atomic(fit_page, fit_report(identification))
    note("2/4  playing another 2.6 h on the bus, as fast as the service acknowledges …")
    played = shared_file("replay", PLAYED)
    seconds = _play(model_path, played, live_path)
    note("3/4  comparing live with offline and with the reference …")
    log, model = read_log(played), identification.model
    table = _read_estimates(live_path)
    live = score(table, log, seconds)
    settings = EstimatorSettings(temperature_source=log.temperature_source)
    offline, _ = estimate_log(log, model, settings)
    difference = float(np.nanmax(np.abs(table.soc_pct - offline.soc_pct)))
    bound = quantisation_bound(load_vehicle("generic"), model, log).ekf_pct
    note("4/4  drawing …")
    write_text_atomic(soc_page, estimate_report(log, table, live, model, settings))
    result = _result(identification, live, difference, bound)
    result |= {
        "seconds": time.monotonic() - began,
        "model": str(model_path),
        "fit_page": str(fit_page),
        "soc_page": str(soc_page),
    }
    if json_output:
        emit_json(result)
        return
    _show(result)


def _play(model: Path, log: Path, live: Path) -> float:
    """Run the service in a process of its own and replay a log to it; return the seconds."""
    bus = ["--interface", "socketcan", "--channel", "vcan0"]
    if not has_socketcan("vcan0"):
        bus = ["--interface", "udp_multicast"]
    cangauge = [sys.executable, "-m", "cangauge"]
    service = [
        *cangauge, "run", *bus, "-m", str(model), "--time-source", "replay-clock",
        "--temperature-source", "room", "--until-idle", str(IDLE_S), "--output", str(live),
    ]  # fmt: skip
    began = time.monotonic()
    with subprocess.Popen(service, stderr=subprocess.PIPE, text=True) as running:  # noqa: S603 - our own commands
        replay = subprocess.run(  # noqa: S603 - our own commands
            [*cangauge, "replay", str(log), *bus, "--speed", "max"], check=False
        )
        seconds = time.monotonic() - began
        try:
            _, said = running.communicate(timeout=IDLE_S + 30.0)
        except subprocess.TimeoutExpired:
            running.kill()
            raise CangaugeError("the service did not end after the replay") from None
    if replay.returncode or running.returncode:
        raise CangaugeError(
            f"replay ended with {replay.returncode}, the service with {running.returncode}:"
            f" {said.strip()}"
        )
    return seconds


def _read_estimates(path: Path) -> EstimateTable:
    columns = pq.read_table(path).to_pydict()
    numbers: dict[str, Any] = {
        name: np.array([np.nan if value is None else value for value in columns[name]])
        for name in EstimateTable.__dataclass_fields__
        if name not in {"status", "reasons", "scores"}
    }
    reasons = {text: int(_reasons(text)) for text in set(columns["reasons"])}
    return EstimateTable(
        **numbers,
        status=np.array([Status[word.upper()] for word in columns["status"]], dtype=np.int64),
        reasons=np.array([reasons[text] for text in columns["reasons"]], dtype=np.int64),
    )


def _reasons(names: str) -> Reason:
    reasons = Reason.NONE
    for name in filter(None, (part.strip() for part in names.split(";"))):
        reasons |= Reason[name.replace(" ", "_").upper()]
    return reasons


def _result(
    identification: Identification, live: Scores, difference_pct: float, bound_pct: float
) -> dict[str, Any]:
    return {
        "log": "a reconstruction of the published 2012 Leaf test, no recording",
        "samples": live.rows,
        "replay_seconds": live.seconds,
        "fit_voltage_mae_pct": identification.voltage_mae_pct,
        "fit_soc_newton_mae_pct": identification.soc_newton_mae_pct,
        "live_voltage_mae_pct": live.voltage_mae_pct,
        "live_soc_mae_pct": live.soc_mae_pct,
        "live_soc_max_pct": live.soc_max_pct,
        "live_soc_newton_mae_pct": live.soc_newton_mae_pct,
        "live_soc_coulomb_mae_pct": live.soc_coulomb_mae_pct,
        "live_cover_2sigma": live.cover_2sigma,
        "live_minus_offline_pct": difference_pct,
        "quantisation_bound_pct": bound_pct,
    }


def _show(result: dict[str, Any]) -> None:
    table = Table(title="Reconstructed Leaf test, live over the bus (SoC withheld at the start)")
    table.add_column("")
    table.add_column("here", justify="right")
    table.add_column("published", justify="right")
    for name, key, published in (
        ("voltage error of the fit, MAE", "fit_voltage_mae_pct", VOLTAGE_MAE_PCT),
        ("SoC by Newton on the fitted log, MAE", "fit_soc_newton_mae_pct", SOC_NEWTON_MAE_PCT),
        ("SoC by Newton, live, MAE", "live_soc_newton_mae_pct", None),
        ("SoC by Coulomb counting, live, MAE", "live_soc_coulomb_mae_pct", None),
        ("SoC by EKF, live, MAE", "live_soc_mae_pct", None),
        ("SoC by EKF, live, largest", "live_soc_max_pct", None),
        ("live minus offline, largest", "live_minus_offline_pct", None),
        ("  bound by rounding in frames", "quantisation_bound_pct", None),
    ):
        shown = "" if published is None else f"{published:.2f} %"
        table.add_row(name, f"{result[key]:.3g} %", shown)
    table.add_row("2σ holds the reference in", f"{100.0 * result['live_cover_2sigma']:.1f} %", "")
    console.print(table)
    note(
        f"{result['samples']} samples in {result['replay_seconds']:.0f} s over the bus;"
        f" {result['seconds']:.0f} s in all"
    )
    note(f"open {result['soc_page']} (SoC against reference) and {result['fit_page']} (the model)")
