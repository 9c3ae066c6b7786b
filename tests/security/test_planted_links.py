"""Links and pipes that another user placed in a shared folder are not written."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from cangauge._files import atomic_path, check_writable
from cangauge.errors import InputError
from cangauge.service.recording import Recorder
from live import in_process, leaf_model_path

needs_root = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs files of another user"
)
SOMEBODY = 12345


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    """A folder as /tmp."""
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(0o1777)
    return folder


def planted(link: Path, target: Path) -> None:
    link.symlink_to(target)
    os.lchown(link, SOMEBODY, SOMEBODY)


@needs_root
def test_planted_links_are_not_followed(shared: Path) -> None:
    """As the kernel's fs.protected_symlinks: whoever owns the link chose its target."""
    victim = shared.parent / "victim.log"
    victim.write_text("precious")
    planted(shared / "x.log", victim)
    planted(shared / "folder", shared.parent)
    planted(shared / "up", Path("..", shared.name))
    (shared.parent / "mine.log").symlink_to(shared / "x.log")
    for path in (
        shared / "x.log",
        shared / "folder" / "victim.log",
        shared / "up" / ".." / "victim.log",
        shared.parent / "mine.log",
    ):
        with pytest.raises(InputError, match="another user placed"), atomic_path(path):
            raise AssertionError(path)
        with pytest.raises(InputError, match="another user placed"):
            check_writable(path)
        with pytest.raises(InputError, match="another user placed"):
            Recorder(path)
    for option in ("-o", "--record"):
        name = shared / f"run{option}.log"
        planted(name, victim)
        planted(name.with_suffix(".csv"), victim)
        ended = in_process(
            "run", "-m", leaf_model_path(), "--interface", "virtual", "--channel", "none",
            "--duration", "0.1", option, name if option == "--record" else name.with_suffix(".csv"),
        )  # fmt: skip
        assert ended.code == 2
        assert "another user placed" in ended.err
    assert victim.read_text() == "precious"


@needs_root
def test_a_planted_pipe_is_not_written(shared: Path) -> None:
    pipe = shared / "x.csv"
    os.mkfifo(pipe)
    os.lchown(pipe, SOMEBODY, SOMEBODY)
    with pytest.raises(InputError, match="another user placed"):
        check_writable(pipe)


@needs_root
def test_links_of_ones_own_and_elsewhere_are_followed(shared: Path) -> None:
    real = shared.parent / "real.csv"
    real.write_text("old")
    (shared / "own.csv").symlink_to(real)
    planted(shared.parent / "elsewhere.csv", real)
    for path in (shared / "own.csv", shared.parent / "elsewhere.csv"):
        with atomic_path(path) as part:
            part.write_text(path.name)
        assert real.read_text() == path.name
        assert path.is_symlink()
    circle = shared.parent / "circle"
    circle.symlink_to(circle)
    with pytest.raises(InputError):
        check_writable(circle / "x.csv")


def test_an_output_that_is_a_socket_is_refused(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "x.csv"))
    with pytest.raises(InputError, match="this is a socket"):
        check_writable(tmp_path / "x.csv")


@needs_root
def test_planted_links_of_relative_paths(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planted(shared / "x.csv", shared.parent / "victim")
    inner = shared / "inner"
    inner.mkdir()
    monkeypatch.chdir(inner)
    for path in ("../x.csv", "./../inner/../x.csv", "../../shared/x.csv"):
        with pytest.raises(InputError, match="another user placed"):
            check_writable(path)
    check_writable("../y.csv")
