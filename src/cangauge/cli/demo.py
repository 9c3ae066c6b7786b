"""`cangauge demo`: fit, replay on a bus, live estimate and report pages on the shipped log."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cangauge._extras import extra, require_extra
from cangauge._files import make_folder, write_text_atomic
from cangauge._resources import shared_file
from cangauge._text import number, significant
from cangauge.cli.options import Json, option
from cangauge.cli.output import finish, note, print_table
from cangauge.errors import CangaugeError, InputError

TRAINED_ON = "leaf2012_reconstruction_white.parquet"
PLAYED = "leaf2012_reconstruction_correlated.parquet"
SENSOR_OFFSET_A = 1.0
"""Offset of the played current [A]: that of an ordinary Hall-effect sensor, which counting sums."""
CONFIGURATION = """\
model = "model.json"
time_source = "replay-clock"
temperature_source = "room"
until_idle_s = 3
record = "live.log"
"""
EXIT_WITHIN_S = 33.0
"""Longest wait for the service to exit after the replay: its idle time and half a minute [s]."""


def demo_command(
    *,
    folder: Annotated[
        Path, option("--folder", "DIR", "Folder for the model and the pages.")
    ] = Path("out/demo"),
    json_output: Json = False,
) -> None:
    """Fit a model, replay a log on a bus, estimate its SoC live, and report the errors.

    The log is not a recording of a car. It is a reconstruction of the published 2012 Leaf test,
    computed from the published equation, and the model is fitted as in the publication. In the
    replayed log, the voltage has a different error, and the current sensor reads 1 A too high. The
    bus is vcan0 if it exists, and otherwise UDP multicast on this machine. The demo takes about a
    minute. During this time, the live page is served at the printed address.

    Examples
    --------
    `cangauge demo`

    `cangauge demo --folder /tmp/demo --json`
    """
    from dataclasses import replace

    import numpy as np

    from cangauge.bus.vehicle import Vehicle
    from cangauge.estimation.offline import estimate_log, score
    from cangauge.estimation.settings import EstimatorSettings
    from cangauge.identify.fit import fit
    from cangauge.logs.canonical import write_log
    from cangauge.logs.read import open_log
    from cangauge.replay.steps import quantization_bound
    from cangauge.service.offline import RecordedEstimate, estimate_capture

    require_extra("report")
    began = time.monotonic()
    try:
        make_folder(folder)
    except OSError as error:
        raise InputError(
            f"cannot create this folder: {error.strerror}",
            source=folder,
            field="--folder",
            cure="name another one",
        ) from error
    paths = {
        "model": folder / "model.json",
        "fit_page": folder / "fit.html",
        "soc_page": folder / "soc.html",
    }
    note("1/4  fit the voltage model to 2.6 h of the reconstructed Leaf test")
    identification = fit([open_log(shared_file("replay", TRAINED_ON)).read()], equation="published")
    model = identification.model
    model.save(paths["model"])
    write_text_atomic(paths["fit_page"], extra("report.fit:fit_page")(identification).html())
    note("2/4  replay another 2.6 h on the bus at full speed, and estimate its SoC live")
    log = open_log(shared_file("replay", PLAYED)).read()
    log = replace(log, current_a=log.current_a + SENSOR_OFFSET_A)
    write_log(log, folder / PLAYED)
    for old in folder.glob("live*.log"):  # a recording is never overwritten
        old.unlink()
    seconds = _play(folder, folder / PLAYED)
    note("3/4  compare live with offline and with the reference")
    settings = EstimatorSettings(temperature_source="room")
    vehicle = Vehicle.load("generic")
    # The recording gives the live numbers again, bit for bit.
    table = estimate_capture(folder / "live.log", vehicle, model, settings).table
    live = score(table, log, seconds)
    offline, _ = estimate_log(log, model, settings)
    note("4/4  write the pages")
    estimate = RecordedEstimate(log, table, live, model, settings)
    page = extra("report.estimate:estimate_page")(estimate, paths["model"])
    write_text_atomic(paths["soc_page"], page.html())
    result = {
        "log": "a reconstruction of the published 2012 Leaf test, no recording",
        "current_offset_a": SENSOR_OFFSET_A,
        "fit_voltage_mae_pct": identification.voltage_mae_pct,
        "fit_soc_newton_mae_pct": identification.soc_newton_mae_pct,
        **{f"live_{name}": value for name, value in vars(live).items()},
        "live_minus_offline_pct": float(np.nanmax(np.abs(table.soc_pct - offline.soc_pct))),
        "quantisation_bound_pct": quantization_bound(vehicle, model, log)["ekf"],
        "seconds": time.monotonic() - began,
        **{name: str(path) for name, path in paths.items()},
    }
    finish(result, partial(_show, result), as_json=json_output)


def _play(folder: Path, log: Path) -> float:
    """Replay a log to the service, each in its own process; return the duration [s]."""
    page = ""
    if os.name == "posix":
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            page = f"127.0.0.1:{probe.getsockname()[1]}"
        note(f"     see it while it plays: http://{page}/")
    config = folder / "run.toml"
    write_text_atomic(config, CONFIGURATION + (f'dashboard = "{page}"\n' if page else ""))
    cangauge = [sys.executable, "-P", "-m", "cangauge"]  # -P: no modules of the working folder
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    began = time.monotonic()
    with subprocess.Popen(  # noqa: S603 - our own commands
        [*cangauge, "run", "--config", str(config)],
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as running:
        replay = subprocess.run(  # noqa: S603 - our own commands
            [*cangauge, "replay", str(log), "--speed", "max"], check=False, env=environment
        )
        seconds = time.monotonic() - began
        try:
            _, errors = running.communicate(timeout=EXIT_WITHIN_S)
        except subprocess.TimeoutExpired:
            running.kill()
            raise CangaugeError("the service did not exit after the replay") from None
    if replay.returncode or running.returncode:
        raise CangaugeError(
            f"replay exited with {replay.returncode}, the service with {running.returncode}:"
            f" {errors.strip()}"
        )
    return seconds


def _show(result: dict[str, Any]) -> None:
    """Print the errors of fit and live estimate, beside the published ones, and where to look."""
    from cangauge.model.published import SOC_NEWTON_MAE_PCT, VOLTAGE_MAE_PCT

    rows = [
        ("voltage error of the fit, MAE", "fit_voltage_mae_pct", f"{VOLTAGE_MAE_PCT:.2f} %"),
        ("SoC by Newton, fitted log, MAE", "fit_soc_newton_mae_pct", f"{SOC_NEWTON_MAE_PCT:.2f} %"),
        ("SoC by Newton, live, MAE", "live_soc_newton_mae_pct", ""),
        ("SoC by Coulomb counting, live, MAE", "live_soc_coulomb_mae_pct", ""),
        ("SoC by EKF, live, MAE", "live_soc_mae_pct", ""),
        ("SoC by EKF, live, largest", "live_soc_max_pct", ""),
        ("live minus offline, largest", "live_minus_offline_pct", ""),
        ("  bound from rounding in frames", "quantisation_bound_pct", ""),
    ]
    print_table(
        f"Reconstructed Leaf test, live; current {SENSOR_OFFSET_A:g} A too high",
        ["error", "here", "published"],
        [[name, significant(result[key], 3, "%"), published] for name, key, published in rows]
        + [["reference within ±2σ", number(100.0 * result["live_cover_2sigma"], 1, "%"), ""]],
    )
    note(
        f"{result['live_rows']} samples in {result['live_seconds']:.0f} s over the bus;"
        f" {result['seconds']:.0f} s in total"
    )
    note(f"open {result['soc_page']} (SoC against reference) and {result['fit_page']} (the model)")
