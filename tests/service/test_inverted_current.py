"""A current with the wrong sign is found while the service runs, with the line to change."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.bus.publish import SocReader
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.replay.player import play
from cangauge.replay.steps import LogSource
from cangauge.service.config import RunConfig
from cangauge.service.pipeline import Pipeline
from cangauge.service.run import Service
from cangauge.service.setup import Setup
from cangauge.types import Reason, Status
from live import LoggedLines, frames_of, leaf_model, leaf_model_path, never, short_log, virtual_port

MAP = """dbc = ["pack.dbc"]
name = "car"
[current]
signal = "current_a"
sign = {sign}
[voltage]
signal = "voltage_v"
[temperature]
signal = "temperature_c"
"""


def inverted(log: Log) -> Log:
    return replace(log, current_a=-log.current_a)


def driven(log: Log) -> Pipeline:
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    for frame in frames_of(log, shift_s=1.7e9):
        pipeline.handle(frame)
    return pipeline


def test_an_inverted_drive_through_the_service(tmp_path: Path) -> None:
    (tmp_path / "pack.dbc").write_bytes(shared_file("dbc", "generic_pack.dbc").read_bytes())
    (tmp_path / "car.toml").write_text(MAP.format(sign=-1))
    config = tmp_path / "run.toml"
    config.write_text(
        f'model = "{leaf_model_path()}"\nmap = "car.toml"\ninterface = "virtual"\nchannel = "sign"'
        '\ntime_source = "replay-clock"\nstatus_socket = "off"\ninitial_soc = 80\n'
    )
    found: dict[str, Any] = {}
    with LoggedLines() as logged, virtual_port("sign") as port:
        service = Service(config)
        running = threading.Thread(target=lambda: found.update(service.run()))
        running.start()
        source = LogSource(short_log(600.0, rate_hz=2.0), Vehicle.load("generic"))
        state = play(port, source, speed=float("inf"), stop=never)
        service.stop()
        running.join(30.0)
        logged.release_due(everything=True)
    # The status at the end, the log, and the frame on the bus.
    assert (found["status"], "sign_suspect" in found["reasons"]) == ("invalid", True)
    [notice] = found["notices"]
    assert notice.endswith(f"set sign = 1 under [current] of {tmp_path / 'car.toml'}")
    assert any("the current has the wrong sign" in line for line in logged.lines)
    assert state.soc["status"] is Status.INVALID
    assert state.soc["reason"] & Reason.IMPLAUSIBLE_INPUT


@pytest.mark.parametrize(
    ("text", "cure"),
    [
        ('like = "leaf_aze0"', "set sign = 1 under [current]"),
        ('like = "generic"', "set sign = -1 under [current]"),
        ('like = "generic"\ncurrent = "current_a"', "set sign = -1 under [current]"),
        ('like = "leaf_aze0"\n[current]\nscale = 2.0', "set sign = 1 under [current]"),
        (None, "use the preset of this car"),
    ],
)
def test_the_sign_to_set_is_the_other_one(tmp_path: Path, text: str | None, cure: str) -> None:
    path = tmp_path / "car.toml"
    path.write_text(text or "")
    config = RunConfig(model=str(leaf_model_path()), map=str(path) if text else None)
    assert cure in Setup.of(config).sign_cure


def test_the_frame_says_implausible_and_the_suspicion_ends_with_the_proof() -> None:
    pipeline = driven(inverted(short_log(700.0, rate_hz=2.0)))
    assert pipeline.latest.reasons & Reason.SIGN_SUSPECT
    assert not pipeline.latest.reasons & Reason.IMPLAUSIBLE_INPUT
    _, content = SocReader().read(pipeline.heartbeat()[0])
    assert content["status"] is Status.INVALID
    # Its bits have been those of other reasons before: this one has none of its own.
    expected = pipeline.published.reasons & ~Reason.SIGN_SUSPECT | Reason.IMPLAUSIBLE_INPUT
    assert content["reason"] == expected
    for sample in samples_of(short_log(300.0, rate_hz=1.0)):
        pipeline.estimator.update(sample._replace(time_s=2e9 + sample.time_s))
    assert not pipeline.estimator.estimate.reasons & Reason.SIGN_SUSPECT


def test_a_right_sign_and_a_charge_at_constant_power_prove_nothing() -> None:
    log = short_log(700.0, rate_hz=2.0)
    assert not driven(log).latest.reasons & Reason.SIGN_SUSPECT
    voltage_v = np.linspace(370.0, 400.0, len(log))  # both rise, a current that charges too
    steady = replace(log, current_a=-7000.0 / voltage_v, voltage_v=voltage_v)
    assert not driven(steady).latest.reasons & Reason.SIGN_SUSPECT


def test_a_sign_that_turns_is_found_within_some_steps() -> None:
    log = short_log(700.0, rate_hz=2.0)
    turned = replace(log, current_a=np.where(log.time_s < 350.0, 1.0, -1.0) * log.current_a)
    table = run_estimator(turned, leaf_model(), EstimatorSettings())
    suspect = (table.reasons & Reason.SIGN_SUSPECT) != 0
    first_s = turned.time_s[np.argmax(suspect)]
    rows_a = turned.current_a[(turned.time_s >= 350.0) & (turned.time_s <= first_s)][::2]
    assert 6 <= np.sum(np.abs(np.diff(rows_a)) >= 0.05 * leaf_model().capacity_ah) <= 30
    assert np.all(suspect[turned.time_s > first_s])
    assert np.all(table.status[suspect] == Status.INVALID)
