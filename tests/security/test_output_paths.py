"""Paths that are written: nothing of somebody else's is moved, replaced or followed."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from live import in_process, leaf_model_path


def run(*more: object) -> tuple[int, str]:
    ended = in_process(
        "run", "-m", leaf_model_path(), "--interface", "virtual", "--channel", "none",
        "--duration", "0.1", *more,
    )  # fmt: skip
    return ended.code, ended.err


def device(path: Path) -> None:
    try:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    except OSError as error:
        pytest.skip(f"no device can be made here: {error}")


def bound(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


FOREIGN: dict[str, tuple[Callable[[Path], object], str]] = {
    "device": (device, "device"),
    "pipe": (os.mkfifo, "FIFO"),
    "fstab": (lambda path: path.write_text("/dev/sda1 / ext4 defaults 0 1\n"), "not a cangauge"),
    "binary": (lambda path: path.write_bytes(b"\x00\x01"), "not a cangauge state"),
    "model": (lambda path: path.write_text('{"format": "cangauge-model"}'), "not a cangauge state"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_state_path_that_is_no_state_is_refused(tmp_path: Path, name: str) -> None:
    make, words = FOREIGN[name]
    path = tmp_path / "x"
    make(path)
    before = path.lstat()
    code, message = run("--state", path)
    assert code == 2
    assert words in message
    after = path.lstat()
    assert (after.st_ino, after.st_size, after.st_mtime_ns) == (
        before.st_ino, before.st_size, before.st_mtime_ns,
    )  # fmt: skip
    assert os.listdir(tmp_path) == ["x"]  # noqa: PTH208 - names


def test_a_state_in_a_folder_that_is_absent_is_refused(tmp_path: Path) -> None:
    code, message = run("--state", tmp_path / "absent" / "state.json")
    assert code == 2
    assert "folder of this file does not exist" in message


@pytest.mark.parametrize("content", [None, b"", b'{"format": "cangauge-state", "version": 9}'])
def test_a_state_that_is_absent_empty_or_old_is_accepted(
    tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "state"
    if content is not None:
        path.write_bytes(content)
    assert run("--state", path)[0] == 0
