"""What stands where state, configuration, map, model or DBC should: one line, and no SoC of it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from cangauge.bus.database import load_dbc
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.extras.live.addresses import read_token
from cangauge.model.model_file import Model
from cangauge.service.config import load_config
from cangauge.service.pipeline import Pipeline
from cangauge.service.state import FILE_NAME, StateKeeper, read_state
from live import frames_of, in_process, leaf_model, leaf_model_path, short_log
from processor import at_most

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pipes, owners and links of Unix")
BRIEF = Path(__file__).with_name("brief.toml")
RUN = ("run", "-m", leaf_model_path(), "--interface", "virtual", "--channel", "x")
ANOTHER = 65534
HUGE = 20 << 30


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the content of a state that a service would continue from."""
    path = tmp_path_factory.mktemp("saved") / FILE_NAME
    pipeline = Pipeline(Vehicle.load("generic"), leaf_model())
    with StateKeeper(path, pipeline, "virtual x", 86400.0):
        for frame in frames_of(short_log()):
            pipeline.handle(frame)
    return path.read_bytes()


def make_socket(path: Path, _: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def make_huge(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    os.truncate(path, HUGE)


def make_anothers(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    os.chown(path, ANOTHER, ANOTHER)


KINDS: dict[str, Callable[[Path, bytes], object]] = {
    "pipe": lambda path, _: os.mkfifo(path),
    "socket": make_socket,
    "device": lambda path, _: path.symlink_to("/dev/zero"),
    "empty": lambda path, _: path.touch(),
    "huge": make_huge,
    "cut off": lambda path, content: path.write_bytes(content[:-200]),
    "one bit": lambda path, content: path.write_bytes(content.replace(b"8", b"9", 1)),
    "brackets": lambda path, content: path.write_bytes(content[:80] + b"[" * 200_000),
}
NO_CONFIGURATION: dict[str, Callable[[Path, bytes], object]] = KINDS | {
    "folder": lambda path, _: path.mkdir(),
    "loop": lambda path, _: path.symlink_to(path),
    "one bit": lambda path, content: path.write_bytes(content.replace(b"288", b"x88")),
}
ROOT_ONLY: dict[str, Callable[[Path, bytes], object]] = {"another user's": make_anothers}


@pytest.mark.parametrize("kind", [*KINDS, *ROOT_ONLY])
def test_no_soc_comes_from_what_is_no_state(kind: str, saved: bytes, tmp_path: Path) -> None:
    if kind in ROOT_ONLY and os.geteuid() != 0:
        pytest.skip("root gives a file away")
    state = tmp_path / FILE_NAME
    (KINDS | ROOT_ONLY)[kind](state, saved)
    with at_most(2.0):
        ended = in_process(*RUN, "--config", BRIEF, "--state", state)
    assert ended.code == 0, ended.err
    (refused,) = [line for line in ended.err.splitlines() if "state.refused" in line]
    assert "starting without one" in refused
    assert "last SoC not known" in ended.err
    # It is kept under another name, and the next start is one without a state.
    assert [each.name for each in tmp_path.iterdir()] == [f"{FILE_NAME}.refused"]
    assert "no saved state" in in_process(*RUN, "--config", BRIEF, "--state", state).err


def test_a_whole_state_is_continued_from(saved: bytes, tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).write_bytes(saved)
    ended = in_process(*RUN, "--config", BRIEF, "--state", tmp_path)
    assert "state.restored" in ended.err
    assert "state.refused" not in ended.err


@pytest.mark.parametrize("kind", NO_CONFIGURATION)
def test_a_configuration_that_is_none_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "can0.toml"
    content = f'[limits]\nmin_voltage_v = 288\n[bus_options]\nname = "{"x" * 300}"\n'
    NO_CONFIGURATION[kind](path, content.encode())
    for command in (("check", path), ("run", "--config", path)):
        ended = in_process(*command)
        assert (ended.code, ended.out) == (2, "")
        assert len(ended.err.splitlines()) == 1, ended.err
        assert str(path) in ended.err


READERS: dict[str, Callable[[Path], object]] = {
    "state": read_state,
    "configuration": load_config,
    "model": Model.load,
    "map": lambda path: Vehicle.load(map=path),
    "DBC": load_dbc,
    "token": lambda path: read_token(path, {}),
}
GROWING = "import sys\nwith open(sys.argv[1], 'ab', 0) as file:\n    while True: file.write(LINES)"


@contextmanager
def growing(path: Path) -> Iterator[None]:
    """Let another process add lines as fast as it can, to a file of more than any limit."""
    lines = "LINES = b'# a line that says nothing\\n' * 30_000\n"
    writer = subprocess.Popen([sys.executable, "-c", lines + GROWING, path])
    try:
        until_s = time.monotonic() + 60.0
        while time.monotonic() < until_s and path.stat().st_size < 64 << 20:
            time.sleep(0.01)
        yield
    finally:
        writer.kill()
        writer.wait()


def test_a_file_that_grows_is_refused_in_bounded_time(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.touch()
    with growing(path):
        for name, read in READERS.items():
            with at_most(2.0, name), pytest.raises(InputError) as refused:
                read(path)
            assert refused.value.source == str(path)
    with suppress(OSError):
        path.unlink()  # soon some GB
