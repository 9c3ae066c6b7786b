"""`cangauge run --state` as a process: stopped, killed, started again."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, open_bus
from cangauge.bus.publish import SocReader, standard_filter
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.state import read_state
from cangauge.types import Reason, Status
from live import Command, collect, leaf_model_path, short_log, waits

MODEL = ("-m", leaf_model_path())
ADDRESS = "239.74.163.2"
PORT = 43_821
BUS = ("--interface", "udp_multicast", "--channel", ADDRESS, "--bus-option", f"port={PORT}")


def drive(port: BusConnection, first: int, after: int) -> None:
    encoder = FrameEncoder(Vehicle.load("generic"))
    for sample in list(samples_of(short_log(100.0)))[first:after]:
        for frame in encoder.encode(sample):
            port.send(frame)
        time.sleep(0.01)


def run(path: Path) -> Command:
    config = path.parent.with_suffix(".toml")
    config.write_text("state_every_s = 0.2\n")
    service = Command("run", *BUS, *MODEL, "--state", path, "--config", config, "--json",
                      "--initial-soc", "80")  # fmt: skip
    service.wait_for("service.ready")
    return service


def samples_kept(path: Path) -> int:
    return read_state(path).estimator.samples if path.exists() else 0


def test_killed_started_again_and_stopped(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    wanted = [standard_filter(0x5A0)]
    address = BusAddress("udp_multicast", ADDRESS, {"port": PORT})
    with BusConnection(open_bus(address, wanted), address) as port:
        # Killed: what was written by then is there.
        service = run(path)
        drive(port, 0, 200)
        assert waits(lambda: samples_kept(path) == 200)
        drive(port, 200, 202)
        service.process.send_signal(signal.SIGKILL)
        service.process.wait()
        kept = samples_kept(path)
        assert 200 <= kept <= 202
        kept_pct = read_state(path).estimator.soc_pct
        service = run(path)
        while port.receive(0.0) is not None:
            pass
        contents = [SocReader().read(frame) for frame in collect(port, 0.5)]
        told = [each for name, each in contents if name == "soc_estimate"]
        assert told
        assert told[-1]["soc_pct"] == pytest.approx(kept_pct, abs=0.01)
        assert told[-1]["status"] is Status.INVALID
        assert told[-1]["reason"] & Reason.INPUT_STALE
        drive(port, 202, 210)
        assert waits(lambda: samples_kept(path) > 202)  # counted on, not anew
        # Stopped: all is there.
        service.process.send_signal(signal.SIGTERM)
        ended = service.end()
        assert (ended.code, ended.json["samples"]) == (0, 8)
        assert samples_kept(path) == kept + 8
    assert "continuing from" in ended.err
    # The seconds that starting took are counted by the mean current before: 10 s at 60 A are 0.3 %.
    assert ended.json["estimate"]["soc_pct"] == pytest.approx(kept_pct, abs=1.0)
    assert [each.name for each in tmp_path.iterdir()] == ["state.json"]


def test_a_read_only_file_system_stops_no_start() -> None:
    address = BusAddress("udp_multicast", ADDRESS, {"port": PORT})
    with BusConnection(open_bus(address, [standard_filter(0x5A0)]), address) as port:
        service = Command("run", *BUS, *MODEL, "--state", "/sys/state.json", "--initial-soc", "80")
        service.wait_for("service.ready")
        drive(port, 0, 20)
        service.wait_for("state not written: /sys/state.json")
        assert collect(port, 0.5)
        service.process.send_signal(signal.SIGTERM)
        assert service.end().code == 0
