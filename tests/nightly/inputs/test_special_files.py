"""Pipes, devices and the like are refused at once, in one line, by every reader."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cangauge.bus.captures import open_capture
from cangauge.bus.database import load_dbc
from cangauge.bus.recording import read_log
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.extras.live.addresses import read_token
from cangauge.model.model_file import Model
from cangauge.service.config import load_config
from cangauge.service.state import read_state

READERS: dict[str, Callable[[Path], object]] = {
    "log": read_log,
    "capture": open_capture,
    "dbc": load_dbc,
    "map": lambda path: Vehicle.load(map=path),
    "config": load_config,
    "model": Model.load,
    "state": read_state,
    "token": lambda path: read_token(path, {}),
}


@pytest.fixture(autouse=True)
def _no_waiting() -> Iterator[None]:
    """Stop a reader that waits for a pipe."""

    def stop(*_: object) -> None:
        raise TimeoutError("a reader waits")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def _link_to_a_pipe(path: Path) -> None:
    os.mkfifo(path.with_name("pipe"))
    path.symlink_to(path.with_name("pipe"))


MAKERS: dict[str, Callable[[Path], object]] = {
    "absent": lambda _: None,
    "folder": Path.mkdir,
    "pipe": os.mkfifo,
    "link to a pipe": _link_to_a_pipe,
    "socket": _socket,
    "loop": lambda path: path.symlink_to(path),
    "empty": Path.touch,
}


def special(folder: Path, kind: str) -> Path:
    if kind.startswith("/dev"):
        return Path(kind)
    if kind in MAKERS:
        MAKERS[kind](folder / "it")
        return folder / "it"
    (folder / "file").write_text("x")
    return {
        "no name": Path("a\x00b"),
        "long name": folder / ("x" * 5000),
        "below a file": folder / "file" / "it",
    }[kind]


WORDS = {
    "absent": "no such file",
    "below a file": "no such file",
    "folder": "this is a folder, not a file",
    "pipe": "this is a pipe",
    "link to a pipe": "this is a pipe",
    "socket": "this is a device",
    "/dev/zero": "this is a device",
    "/dev/null": "this is a device",
    "/dev/full": "this is a device",
    "loop": "cannot be read: .*symbolic links",
    "no name": "cannot be read: .*null",
    "long name": "cannot be read: .*too long",
    "empty": ".",  # each reader in its own words
}


@pytest.mark.parametrize("kind", list(WORDS))
@pytest.mark.parametrize("reader", list(READERS))
def test_it_is_refused_by_name(tmp_path: Path, reader: str, kind: str) -> None:
    path = special(tmp_path, kind)
    with pytest.raises(InputError, match=WORDS[kind]) as caught:
        READERS[reader](path)
    assert str(caught.value).isprintable()
    assert caught.value.exit_code == 2
    if kind not in {"no name", "long name"}:
        # An empty configuration is one without a model.
        assert caught.value.source == str(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_what_may_not_be_read(tmp_path: Path) -> None:
    path = tmp_path / "secret"
    path.write_text("x")
    path.chmod(0)
    for reader in READERS.values():
        with pytest.raises(InputError, match="cannot be read: Permission denied; change its"):
            reader(path)
