"""Status: the object of `/status`, signs of life, the unix socket, and its commands."""

from __future__ import annotations

import json
import logging
import os
import socket
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from watched import StandInPort, Watched

from cangauge.cli.status import live_text, status_values
from cangauge.errors import CangaugeError, InputError
from cangauge.estimation.cells import CellReport
from cangauge.service.run import COUNTED, Service, log_end
from cangauge.service.status import Histogram
from cangauge.service.status_client import (
    BOUNDS_S,
    NotRunningError,
    StatusSocket,
    fetch_status,
    find_socket,
    socket_path,
)
from live import Command, LoggedLines, in_process, leaf_model_path, waits


@pytest.fixture
def watched() -> Watched:
    found = Watched()
    found.now_s = time.monotonic()
    found.drive(90.0)
    found.turn(0.5)
    return found


def test_a_name_that_is_no_utf_8_is_written_out(watched: Watched, tmp_path: Path) -> None:
    watched.monitor.model = os.fsdecode(b"caf\xe9.json")
    watched.turn()
    path = tmp_path / "status.sock"
    server = StatusSocket(path, lambda: watched.status)
    assert fetch_status(path)["model"] == "caf\\udce9.json"
    server.close()


def test_a_status_is_plain_json_of_what_the_loop_counted(watched: Watched) -> None:
    status = json.loads(json.dumps(watched.status, allow_nan=False))
    assert status["samples"] == 900
    assert status["status"] == "valid"
    assert status["estimate"]["soc_pct"] == watched.pipeline.latest.soc_pct
    frames = watched.pipeline.counts["frames"]
    assert status["frames"] == {"received": frames, "wanted": frames, "used": frames, "lost": 0}
    counts = {"garbled": 1, "error_frames": 2, "unsent": 3, "queue_drops": 4, "foreign": 0}
    assert status["bus_counts"] == counts
    assert status["step"]["count"] == 900


def test_the_end_of_a_run_says_what_was_counted(watched: Watched) -> None:
    counts = {"unsent": 1, "losses": 0, "foreign": 25}
    with LoggedLines("cangauge.service.run") as logged:
        log_end(watched.status | {"bus_counts": counts, "recording": None})
    text = "0 CRC errors, 1 frames not sent, 25 frames of another service with these ids; last SoC"
    assert text in logged.lines[0]
    assert counts.keys() | watched.status["bus_counts"].keys() == COUNTED.keys()


def test_before_the_first_sample_the_soc_is_not_known_yet() -> None:
    watched = Watched(port=StandInPort(is_off=True, queue_drops=None))
    watched.pipeline.heartbeat()
    watched.turn()
    status = watched.status
    json.dumps(status, allow_nan=False)
    assert status["status"] == "initialising"
    assert status["sample"] is status["health"] is status["cells"] is None
    assert status["latency"]["p99_at_most_s"] is None
    assert "implausible_input" not in status["reasons"]
    assert not status["bus_up"]
    assert "queue_drops" not in status["bus_counts"]
    rows = dict(status_values(status))
    assert rows["SoC"] == "not known yet"
    unknown = {name for name, text in rows.items() if text.startswith("–")}
    assert {"current", "latest sample", "recording", "residual"} <= unknown
    assert "energy left" not in rows
    assert live_text(status).plain.startswith("SoC not known yet  initialising")


def test_a_capped_current_is_a_least_one_and_a_small_energy_in_wh(watched: Watched) -> None:
    status = json.loads(json.dumps(watched.status))
    status["power"] |= {"discharge_a": 200.0, "discharge_std_a": 0.0}
    status["power"] |= {"charge_a": 45.2, "charge_std_a": 3.1}
    status["power"] |= {"energy_wh": 9.613, "energy_std_wh": 0.0418, "energy_to_soc_pct": 53.8}
    status["record"] = {
        "path": "a.log", "frames": 12, "written_bytes": 9947, "lost_frames": 0, "problem": None,
    }  # fmt: skip
    rows = dict(status_values(status))
    assert rows["possible discharge, 10 s"] == "at least 200 A"
    assert rows["possible charge, 10 s"] == "45.2 ± 3.1 A"
    assert rows["energy left"] == "9.613 ± 0.042 Wh to 54 % SoC"
    assert rows["recording"] == "a.log, 0 frames lost"


def test_a_snapshot_grows_old_and_stale(watched: Watched) -> None:
    snapshot, now_s = watched.monitor.latest, watched.now_s
    before = json.dumps(snapshot.status)
    assert snapshot.at(now_s + 1.9)["status"] == "valid"
    assert snapshot.at(now_s + 1.5)["sample"]["age_s"] == pytest.approx(2.0)
    old = snapshot.at(now_s + 2.1)
    assert (old["status"], old["loop_stuck"]) == ("invalid", True)
    assert "input_stale" in old["reasons"]
    watched.drive(10.0)
    watched.turn()
    assert json.dumps(snapshot.status) == before  # it never changes
    watched.pipeline.heartbeat(3.0)
    watched.turn()
    assert watched.status["status"] == "invalid"


def test_refused_frames_are_counted_by_reason(watched: Watched) -> None:
    messages = watched.pipeline.decoder.statistics.messages.values()
    for counters in messages:
        counters["crc_errors"] += 2
        counters["not_available"] += 1
    watched.turn()
    assert watched.status["rejects"]["crc_errors"] == 2 * len(messages)
    frames = watched.status["frames"]
    # A value that is not available refuses no frame.
    assert frames["wanted"] - frames["used"] == 2 * len(messages)


def test_a_wrong_sum_of_cells_is_logged_once(
    watched: Watched, caplog: pytest.LogCaptureFixture
) -> None:
    cells = CellReport(96, 3, 50.0, 1.0, 2.0, -2.5, 0.1, is_sum_wrong=True)
    report = watched.pipeline.report()._replace(cells=cells)
    watched.pipeline.report = lambda: report  # type: ignore[method-assign] # a wrong sensor
    with caplog.at_level(logging.WARNING, logger="cangauge"):
        for _ in range(4):
            watched.turn(1.0)
    assert len([each for each in caplog.records if "-2.50 V" in each.getMessage()]) == 1
    assert "-2.50 V" in watched.status["notices"][0]
    assert watched.status["cells"]["weakest"] == 3


def test_latency_is_that_of_the_latest_sample_once_it_is_sent() -> None:
    watched = Watched()
    watched.monitor.sent()  # no sample yet
    watched.monitor.stepped(time.time() - 0.5, 1e-6, watched.now_s)
    watched.monitor.stepped(time.time() - 0.0015, 1e-6, watched.now_s)
    watched.monitor.sent()
    watched.monitor.sent()  # counted already
    for stamp_s in (time.time() + 5.0, 12.0):  # the clock was set; stamps of another clock
        watched.monitor.stepped(stamp_s, 1e-6, watched.now_s)
        watched.monitor.sent()
    watched.turn()
    latency = watched.status["latency"]
    assert latency["count"] == 1
    assert latency["total_s"] >= 0.0015


def test_a_histogram_counts_every_value_once() -> None:
    histogram = Histogram()
    assert histogram.to_dict()["p50_at_most_s"] is None
    values = [*BOUNDS_S, 1e-7, 3e-5, 7.0]
    for value in values:
        histogram.add(value)
    found = histogram.to_dict()
    assert found["count"] == sum(found["buckets"]) == len(values)
    assert found["total_s"] == pytest.approx(sum(values))
    assert (found["buckets"][0], found["buckets"][-1]) == (2, 1)  # a bound is in its bucket
    assert found["p50_at_most_s"] == 1e-3  # the tenth of twenty
    assert found["p99_at_most_s"] is None


def test_status_changes_are_logged(caplog: pytest.LogCaptureFixture, watched: Watched) -> None:
    caplog.set_level(logging.INFO, "cangauge")
    for silent_s in (3.0, 3.0, 0.0):
        watched.pipeline.heartbeat(silent_s)
        watched.turn(0.3)
    changes = [each for each in caplog.records if getattr(each, "event", "") == "status.changed"]
    fields = [each.fields for each in changes]  # type: ignore[attr-defined] # extra of `emit`
    assert [(each["before"], each["status"]) for each in fields] == [
        ("valid", "invalid"),
        ("invalid", "valid"),
    ]
    assert changes[0].levelno == logging.WARNING


# --- The unix socket and the command


@pytest.fixture
def served(watched: Watched, tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "status.sock"
    server = StatusSocket(path, lambda: watched.status)
    yield path
    server.close()


def test_the_socket_and_the_command(watched: Watched, served: Path) -> None:
    assert stat.S_IMODE(served.stat().st_mode) == 0o660
    assert fetch_status(served)["samples"] == 900
    ended = in_process("status", "--endpoint", served, "--json")
    assert (ended.code, ended.json["status"]) == (0, "valid")
    ended = in_process("status", "--endpoint", served)
    assert ended.code == 0
    assert "± " in ended.out
    watched.pipeline.heartbeat(3.0)
    watched.turn()
    ended = in_process("status", "--endpoint", served, "--json")
    assert (ended.code, ended.json["reasons"]) == (1, ["input_stale"])
    nowhere = ("status", "--endpoint", served.with_name("no.sock"))
    ended = in_process(*nowhere, "--json")
    assert (ended.code, ended.json["running"]) == (1, False)
    ended = in_process(*nowhere)
    assert (ended.code, ended.out, len(ended.err.splitlines())) == (1, "", 1)


def test_watch_shows_the_status_and_a_silence(watched: Watched, tmp_path: Path) -> None:
    path = tmp_path / "status.sock"
    command = Command("status", "--watch", "--endpoint", path)
    assert command.process.stdout is not None
    lines = iter(command.process.stdout.readline, "")
    assert any("NO ANSWER" in line for line in lines)
    server = StatusSocket(path, lambda: watched.status)
    assert any("valid" in line for line in lines)
    server.close()
    assert any("NO ANSWER" in line for line in lines)
    command.process.terminate()
    command.process.communicate(timeout=30.0)


def test_a_socket_left_behind_is_replaced_and_a_file_is_not(
    watched: Watched, tmp_path: Path, served: Path
) -> None:
    with pytest.raises(InputError, match="another service"):
        StatusSocket(served, lambda: watched.status)
    silent = [socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(3)]
    for each in silent:  # clients that do not read hold nobody
        each.connect(str(served))
    assert fetch_status(served)["samples"] == 900
    for each in silent:
        each.close()
    left = tmp_path / "left.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(left))
    StatusSocket(left, lambda: watched.status).close()
    assert not left.exists()
    left.write_text("precious")
    with pytest.raises(InputError, match="cannot be created"):
        StatusSocket(left, lambda: watched.status)
    assert left.read_text() == "precious"
    with pytest.raises(InputError, match="cannot be created"):
        StatusSocket(tmp_path / ("long" * 50), lambda: watched.status)


def test_services_are_found_in_the_runtime_folder(
    watched: Watched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(os, "getuid", os.getpid)  # a folder without other services
    path = socket_path("socketcan can0")
    assert path == tmp_path / "cangauge" / "socketcan-can0.sock"
    first = StatusSocket(path, lambda: watched.status)
    assert find_socket() == path
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    second = StatusSocket(socket_path("socketcan can1"), lambda: watched.status)
    with pytest.raises(InputError, match="several services are running"):
        find_socket()
    first.close()
    second.close()
    with pytest.raises(NotRunningError):
        find_socket()


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no owners on this system")
def test_a_runtime_folder_that_another_user_has_made_is_not_used(
    watched: Watched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    path = socket_path("socketcan can0")
    server = StatusSocket(path, lambda: watched.status)
    owner = os.geteuid()
    if owner == 0:
        os.chown(tmp_path, 1234, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.raises(InputError, match="another user has made its folder"):
        StatusSocket(socket_path("socketcan can1"), lambda: watched.status)
    with suppress(NotRunningError, InputError):
        assert find_socket() != path
    server.close()


class Answers:
    """A foreign server at a unix socket: sends one answer, all of it or byte by byte."""

    def __init__(self, path: Path, answer: bytes, every_s: float = 0.0) -> None:
        self._answer, self._every_s = answer, every_s
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._server.bind(str(path))
        self._server.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        self._thread.join()
        self._server.close()

    def _serve(self) -> None:
        peer, _ = self._server.accept()
        with peer, suppress(OSError):  # the client has gone
            if not self._every_s:
                peer.sendall(self._answer)
            for place in range(len(self._answer) if self._every_s else 0):
                peer.sendall(self._answer[place : place + 1])
                time.sleep(self._every_s)


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b'{"schema": 99}',
        b"[" * 500_000,
        b'{"schema": 1}',
        b'{"schema": 1, "estimate": {}, "sample": 5, "reasons": 3, "frames": null}',
        b'{"schema": 1, "x": ' + b"9" * 100_000 + b"}",
    ],
)
def test_an_answer_that_is_no_status(tmp_path: Path, answer: bytes) -> None:
    with Answers(tmp_path / "x.sock", answer):
        ended = in_process("status", "--endpoint", tmp_path / "x.sock")
    assert (ended.code, ended.out) == (1, "")
    assert "x.sock: the answer is not a status" in ended.err


def test_an_answer_without_end_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cangauge.service.status_client.ANSWER_WITHIN_S", 0.2)
    with (
        Answers(tmp_path / "x.sock", b"{" * 1000, every_s=0.01),
        pytest.raises(NotRunningError, match="timed out"),
    ):
        fetch_status(tmp_path / "x.sock")


def test_a_socket_survives_a_lack_of_descriptors(
    served: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, failures = socket.socket.accept, []

    def accept(self: socket.socket) -> Any:
        found = real(self)
        if not failures:
            failures.append(1)
            raise OSError(24, os.strerror(24))
        return found

    monkeypatch.setattr(socket.socket, "accept", accept)

    def is_answered() -> bool:
        try:
            return bool(fetch_status(served)["samples"] == 900)
        except CangaugeError:
            return False

    assert waits(lambda: is_answered() and bool(failures))
    assert is_answered()


def test_a_service_runs_without_a_socket_that_it_was_not_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "file"))
    bus = {"interface": "virtual", "channel": "no socket"}
    service = Service(model=str(leaf_model_path()), duration_s=0.01, **bus)
    with LoggedLines("cangauge.service.run") as logged:
        assert service.run()["samples"] == 0
    assert service.endpoint is None
    assert any(line.startswith("warning: no status socket: ") for line in logged.lines)
