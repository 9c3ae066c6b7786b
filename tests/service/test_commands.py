"""`cangauge run` and `cangauge replay`, each in a process of its own, over udp_multicast."""

from __future__ import annotations

import os
import re
import signal
import time
import zlib
from pathlib import Path

import pytest

from cangauge.logs.canonical import write_log
from live import Command, in_process, leaf_model_path, short_log

MODEL = ("-m", leaf_model_path())


@pytest.fixture
def bus(request: pytest.FixtureRequest) -> list[str]:
    """Options of a bus that no other test uses, nor the same test of another checkout."""
    port = 20_000 + zlib.crc32(f"{request.node.nodeid} {os.getpid()}".encode()) % 20_000
    channel = ["--interface", "udp_multicast", "--channel", "239.74.163.2"]
    return [*channel, "--bus-option", f"port={port}"]


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    path = tmp_path / "drive.parquet"
    write_log(short_log(120.0), path)
    return path


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP on this system")
def test_a_hangup_reads_the_configuration_again_and_an_interrupt_ends_the_service(
    bus: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "car.toml"
    path.write_text("timeout_s = 1\n")
    service = Command("run", *bus, *MODEL, "--config", path, "--json")
    service.wait_for("service.ready")
    path.write_text("timeout_s = [")
    service.process.send_signal(signal.SIGHUP)
    service.wait_for("config.refused")
    path.write_text("timeout_s = 0.5\n")
    service.process.send_signal(signal.SIGHUP)
    service.wait_for("config.reloaded")
    began = time.monotonic()
    service.process.send_signal(signal.SIGINT)
    ended = service.end(5.0)
    assert time.monotonic() - began < 1.5  # the end of the interpreter included
    assert ended.code == 0
    assert ended.json["stamps"] == "kernel"
    assert ended.json["bus_counts"]["foreign"] == 0  # its own frames come back on this bus
    assert ended.json["samples"] == 0
    assert ended.json["estimate"]["soc_pct"] is None
    assert "0 samples" in ended.err


def test_an_interrupted_replay_says_how_far_it_came(bus: list[str], log_path: Path) -> None:
    replay = Command("replay", log_path, *bus, "--json")
    replay.wait_for("playing")
    time.sleep(0.5)
    replay.process.send_signal(signal.SIGINT)
    ended = replay.end(5.0)
    assert ended.code == 130
    assert 0 < ended.json["frames"] < 100


BAD_OPTIONS = [
    (["--interface", "socketcan", "--channel", "nosuch0"], "nosuch0|no SocketCAN"),
    (["--interface", "carrier_pigeon"], "carrier_pigeon"),
    (["--channel", "can7x"], "can7x"),
    (["--interface", "pcan", "--channel", "PCAN_USBBUS1"], "pcan"),
    (["--vehicle", "moped"], "moped"),
    (["--bus-option", "fast"], "K=V"),
]
"""Of both commands."""
RUN, REPLAY = ["run", *MODEL, "--record", "out.log"], ["replay", leaf_model_path()]


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        *((RUN + bad, say) for bad, say in BAD_OPTIONS),
        *((["replay", "drive.parquet", *bad], say) for bad, say in BAD_OPTIONS),
        (["run"], "--model"),
        (["run", "-m", "/nowhere/model.json"], "/nowhere/model.json"),
        ([*RUN, "--method", "magic"], "magic"),
        ([*RUN, "--initial-soc", "150"], "150"),
        ([*RUN, "--time-source", "sundial"], "sundial"),
        ([*RUN, "--config", "/nowhere/car.toml"], "/nowhere/car.toml"),
        (["run", *MODEL, "--record", "drive.asc"], r"drive\.asc"),
        ([*RUN, "--state", "/nowhere/s.json"], "/nowhere/s.json"),
        ([*RUN, "--state", "out.log"], "--state: is another file of this service"),
        (["replay", "/nowhere/log.csv"], "/nowhere/log.csv"),
        (REPLAY, "not a known kind of log"),
        ([*REPLAY, "--speed", "fast"], "fast"),
        ([*REPLAY, "--speed", "0"], "--speed"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    log_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], say: str
) -> None:
    monkeypatch.chdir(log_path.parent)
    ended = in_process(*arguments)
    assert ended.code == 2
    assert ended.out == ""
    assert len(ended.err.splitlines()) == 1, ended.err
    assert re.search(say, ended.err)
    assert list(log_path.parent.iterdir()) == [log_path]
