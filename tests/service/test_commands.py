"""`cangauge run`, `replay` and `status` as commands, over udp_multicast."""

from __future__ import annotations

import json
import os
import re
import signal
import time
import urllib.request
import zlib
from pathlib import Path

import pytest

from cangauge.bus.vehicle import Vehicle
from cangauge.logs.canonical import write_log
from cangauge.service.offline import estimate_capture
from live import Command, in_process, leaf_model, leaf_model_path, short_log, waits

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


def test_a_whole_run(bus: list[str], tmp_path: Path) -> None:
    """By one configuration: bus, vehicle and ids of the replay are those of the service."""
    log, sock = tmp_path / "drive.parquet", tmp_path / "status.sock"
    write_log(short_log(120.0), log)
    config = tmp_path / "run.toml"
    config.write_text(
        f'model = "{MODEL[1]}"\ninterface = "{bus[1]}"\nchannel = "{bus[3]}"\n'
        'vehicle = "leaf_aze0"\ntime_source = "replay-clock"\nlog_format = "json"\n'
        f'http = "127.0.0.1:0"\nstatus_socket = "{sock}"\n'
        'record = "seen.log.gz"\nrecord_part_mb = 0.005\n'
        f"bus_options = {{ port = {bus[5].partition('=')[2]} }}\n"
        "ids = { soc_estimate = 0x4A0, soc_detail = 0x4A1 }\n"
    )
    service = Command("run", "--config", config, "--json")
    service.wait_for("service.ready")
    service.wait_for("http.listening")
    http_port = json.loads(service.lines[-1])["port"]
    replayed = in_process("replay", log, "--config", config, "--speed", "max", "--json")
    assert replayed.code == 0, replayed.err
    assert replayed.json["acknowledged"] == replayed.json["samples"] == 1200
    assert replayed.json["quantisation"]["current_a"] == 0.25  # a Leaf's step is 0.5 A
    # The status is renewed ten times a second; health and possible current once a second.
    status = ("status", "--endpoint", sock)
    assert waits(lambda: in_process(*status, "--json").json["samples"] == 1200)
    found = in_process(*status, "--json")
    assert found.json["latency"]["count"] > 0
    assert waits(lambda: "energy left" in in_process(*status).out)
    shown = in_process(*status).out
    assert all(name in shown for name in ("capacity", "possible discharge, 10 s", "energy left"))
    assert found.json["record"]["lost_frames"] == 0
    url, counted = f"http://127.0.0.1:{http_port}/metrics", b"cangauge_samples_total 1200.0"
    assert waits(lambda: counted in urllib.request.urlopen(url).read())
    service.process.terminate()
    ended = service.end()
    assert ended.code == 0
    assert not sock.exists()
    told = {line["event"]: line["message"] for line in map(json.loads, ended.err.splitlines())}
    assert {"http.listening", "service.ready", "status.changed"} <= told.keys()
    assert "1200 samples, 0 lost, 0 CRC errors; last SoC " in told["service.stopped"]
    assert ended.json["frames"]["lost"] == ended.json["rejects"]["crc_errors"] == 0
    assert ended.json["estimate"]["soc_pct"] == pytest.approx(replayed.json["soc_pct"], abs=0.01)
    assert ended.json["recording"] == str(tmp_path / "seen-0001.log.gz")
    assert len(list(tmp_path.glob("seen-0001-*.log.gz"))) > 1
    # Bit for bit: the recording, offline.
    recorded = estimate_capture(ended.json["recording"], Vehicle.load("leaf_aze0"), leaf_model())
    assert recorded.table.soc_pct.size == 1200
    for name in ("time_s", "soc_pct", "soc_std_pct", "soc_newton_pct", "soc_coulomb_pct"):
        assert ended.json["estimate"][name] == getattr(recorded.table, name)[-1], name
    assert recorded.report is not None
    offline = json.loads(json.dumps(recorded.report.to_dict()))
    assert {name: ended.json[name] for name in offline} == offline


def test_an_interrupted_replay_says_how_far_it_came(bus: list[str], log_path: Path) -> None:
    replay = Command("replay", log_path, *bus, "--json")
    replay.wait_for("playing")
    time.sleep(0.5)
    replay.process.send_signal(signal.SIGINT)
    ended = replay.end()
    assert ended.code == 130
    assert 0 < ended.json["frames"] < 100
    # Only the receiver knows what has not arrived.
    assert ended.json["lost"] is None
    assert "`cangauge status` counts what was lost" in ended.err


BAD_OPTIONS = [
    (["--channel", "can7x"], "can7x"),
    (["--vehicle", "moped"], "moped"),
    (["--bus-option", "fast"], "K=V"),
    (["--bus-option", f"bitrate={'9' * 5000}"], "4300 digits"),
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
        ([*RUN, "--initial-soc", "150"], "150"),
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
    assert (ended.code, ended.out, len(ended.err.splitlines())) == (2, "", 1), ended.err
    assert re.search(say, ended.err)
    assert list(log_path.parent.iterdir()) == [log_path]


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ('dashboard = "here"', "HOST:PORT"),
        ('http = "127.0.0.1:0"\nhttp_token_file = "/nowhere/token"', "/nowhere/token"),
        ('status_socket = "/proc/x.sock"', "/proc/x.sock"),
        ("record_part_mb = 0", "record_part_mb"),
        ('log_level = "loud"', "log_level"),
    ],
)
def test_what_cannot_be_served_is_one_line_and_exit_2(
    bus: list[str], tmp_path: Path, text: str, say: str
) -> None:
    config = tmp_path / "run.toml"
    config.write_text(f'log_format = "json"\n{text}\n')
    ended = in_process("run", *bus, *MODEL, "--config", config)
    assert (ended.code, ended.out, len(ended.err.splitlines())) == (2, "", 1), ended.err
    assert say in ended.err
    assert list(tmp_path.iterdir()) == [config]
