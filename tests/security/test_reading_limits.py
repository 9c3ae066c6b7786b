"""Reading takes a bounded time, and none of the receive loop's."""

from __future__ import annotations

import signal
import time
from functools import partial
from itertools import pairwise
from pathlib import Path

import can
import pytest

from cangauge._io import time_limit
from cangauge.errors import InputError
from cangauge.model.model_file import Model
from cangauge.service import reading
from cangauge.service.config import RunConfig, load_config
from cangauge.service.reading import BackgroundReader, Reading
from faults.large_dbc import write_large_dbc
from live import Command, in_process, leaf_model_path, waits

GROUP = "239.74.163.78"


def endless(_seconds: float = 0.0) -> RunConfig:
    """Read for ever, as a configuration that a child process can import."""
    while True:
        pass


def ends(_seconds: float = 0.0) -> RunConfig:
    raise SystemExit(3)


def result(reader: BackgroundReader, within_s: float = 30.0) -> Reading | InputError:
    found: list[Reading | InputError | None] = []
    assert waits(lambda: bool(found.append(reader.poll()) or found[-1]), within_s)  # type: ignore[func-returns-value] # collects
    assert found[-1] is not None
    return found[-1]


def test_a_limit_interrupts_and_leaves_an_outer_alarm() -> None:
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    signal.setitimer(signal.ITIMER_REAL, 50.0)
    try:
        began_s = time.monotonic()
        with pytest.raises(InputError, match=r"x.dbc: takes more than 0.1 s.*; remove the"):  # noqa: PT012, SIM117
            with time_limit("x.dbc", 0.1):
                with time_limit("inner", 1000.0):  # the outer one counts
                    endless()
        assert time.monotonic() - began_s < 5.0
        assert 40.0 < signal.getitimer(signal.ITIMER_REAL)[0] < 50.0
        with time_limit("y.dbc", 100.0):
            pass
        assert 40.0 < signal.getitimer(signal.ITIMER_REAL)[0] < 50.0
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("read", [endless, ends])
def test_a_reading_that_never_ends_is_refused(read: object) -> None:
    reader = BackgroundReader(partial(read, 0.0), 0.3)  # type: ignore[arg-type] # one of both above
    reader.request()
    found = result(reader)
    assert isinstance(found, InputError)
    assert "takes more than 0.3 s" in str(found) or "ended with status" in str(found)
    assert found.cure
    assert not reader.is_reading


def test_a_reader_that_is_closed_ends_its_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "START_S", 0.0)
    reader = BackgroundReader(endless, 60.0)
    reader.request()
    assert waits(lambda: reader._child is not None, 10.0)
    reader.close()
    child = reader._child
    assert child is not None
    assert waits(lambda: child.poll() is not None, 10.0)


def test_another_process_reads_the_same(tmp_path: Path) -> None:
    write_large_dbc(tmp_path, 0.01)
    path = tmp_path / "run.toml"
    path.write_text(f'model = "{leaf_model_path()}"\ndbc = "large.dbc"\nmap = "map.toml"\n')
    reader = BackgroundReader(partial(load_config, path, {}))
    reader.request()
    reader.request()  # one is under way: read once more
    for _ in range(2):
        there, here = result(reader), Reading.of(partial(load_config, path, {}))
        assert isinstance(there, Reading)
        assert there.config == here.config
        assert there.model == here.model == Model.load(leaf_model_path())
        assert there.vehicle_key == here.vehicle_key
        assert there.vehicle.current == here.vehicle.current
        decoders = (there.vehicle.current.codec.decode, here.vehicle.current.codec.decode)
        assert decoders[0](bytes(8)) == decoders[1](bytes(8))
    assert not reader.is_reading
    path.write_text("model = [")
    reader.request()
    refused = result(reader)
    assert isinstance(refused, InputError)
    assert refused.source == str(path)
    assert "not TOML" in refused.problem


def test_frames_go_on_while_a_large_dbc_is_read(tmp_path: Path) -> None:
    """Before, each megabyte stopped them for 1.5 s."""
    write_large_dbc(tmp_path, 0.5)
    port = 44_500 + time.monotonic_ns() % 400
    config, socket = tmp_path / "run.toml", tmp_path / "status.sock"
    start = (
        f'model = "{leaf_model_path()}"\ninterface = "udp_multicast"\nchannel = "{GROUP}"\n'
        f'status_socket = "{socket}"\n'
    )
    bus = f"[bus_options]\nport = {port}\n"
    config.write_text(start + bus)
    service = Command("run", "--config", config)
    sent_s: list[float] = []
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port) as watcher:

        def watch(seconds: float, enough: int = 1 << 30) -> None:
            until_s = time.monotonic() + seconds
            while time.monotonic() < until_s and len(sent_s) < enough:
                message = watcher.recv(0.1)
                if message is not None and message.arbitration_id == 0x5A0:
                    sent_s.append(time.monotonic())

        watch(30.0, 3)
        config.write_text(start + 'dbc = "large.dbc"\nmap = "map.toml"\n' + bus)
        service.process.send_signal(signal.SIGHUP)
        status = in_process("status", "--endpoint", socket, "--json").json
        for _ in range(150):
            watch(0.2)
            status = in_process("status", "--endpoint", socket, "--json").json
            if status["vehicle"] == "car of a large DBC":
                break
        assert status["config"] == {"reloading": False, "problem": None}
        assert status["vehicle"] == "car of a large DBC"
        config.write_text(start + "surprise = 1\n" + bus)
        service.process.send_signal(signal.SIGHUP)
        for _ in range(100):
            watch(0.1)
            status = in_process("status", "--endpoint", socket, "--json").json
            if status["config"]["problem"]:
                break
        assert "surprise" in status["config"]["problem"]
        assert status["vehicle"] == "car of a large DBC"
    service.process.terminate()
    ended = service.end()
    assert ended.code == 0
    assert "config.reloaded" in ended.err
    assert max(later - earlier for earlier, later in pairwise(sent_s)) < 0.5
