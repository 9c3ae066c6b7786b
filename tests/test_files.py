"""Files are written all or nothing, with clear errors, by one process at a time."""

from __future__ import annotations

import bz2
import errno
import os
import tracemalloc
from pathlib import Path

import pytest

from cangauge import _files
from cangauge._files import atomic_path, check_writable, read_bounded, write_text_atomic
from cangauge.errors import CangaugeError, InputError


def test_the_new_content_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text("old")
    write_text_atomic(path, "new °C\n")
    assert path.read_bytes() == "new °C\n".encode()
    assert [p.name for p in tmp_path.iterdir()] == ["model.json"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text("old")

    def write_half() -> None:
        with atomic_path(path) as part:
            part.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_half()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["model.json"]


def test_readers_see_the_old_file_until_the_end(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    path.write_text("old")
    with atomic_path(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"


def test_absent_folder_folder_and_file_as_folder_are_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path, words in (
        (tmp_path / "absent" / "x.json", "folder of this file does not exist"),
        (tmp_path, "this is a folder"),
        (tmp_path / "file" / "x.json", "is a file, not a folder"),
        (tmp_path / ("n" * 150 + "." + "s" * 250), "file name is too long"),
        (tmp_path / ("n" * 300 + ".json"), "file name is too long"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            write_text_atomic(path, "x")
        assert caught.value.source == str(path)
        with pytest.raises(InputError, match=words):
            check_writable(path)


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_rights_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="not writable"):
        write_text_atomic(tmp_path / "x.json", "x")


def test_a_full_disk_is_one_line_and_leaves_no_part(tmp_path: Path) -> None:
    path = tmp_path / "x.json"

    def fill_up() -> None:
        with atomic_path(path):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(CangaugeError, match=r"x\.json: writing failed: .*free some space"):
        fill_up()
    assert list(tmp_path.iterdir()) == []


def test_links_are_followed_and_rights_kept(tmp_path: Path) -> None:
    real = tmp_path / "real.json"
    real.write_text("old")
    real.chmod(0o640)
    link = tmp_path / "link.json"
    link.symlink_to(real)
    write_text_atomic(link, "new")
    assert link.is_symlink()
    assert real.read_text() == "new"
    assert real.stat().st_mode & 0o777 == 0o640


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no /dev/null here")
def test_a_device_is_written_and_never_replaced() -> None:
    write_text_atomic("/dev/null", "x")
    check_writable("/dev/null")
    assert Path("/dev/null").is_char_device()


def test_checking_leaves_nothing_behind(tmp_path: Path) -> None:
    check_writable(tmp_path / "later.json")
    assert list(tmp_path.iterdir()) == []


def test_runs_in_bzip2_count_for_no_more_than_they_are(tmp_path: Path) -> None:
    """A block of bzip2 holds the least where each run has four bytes."""
    path, content = tmp_path / "log.csv", b"11112222" * (_files.MIB // 4)
    path.write_bytes(bz2.compress(content))
    with bz2.open(path) as file:
        assert _files.read_all(file, path, 4 * len(content), "a log") == content


def test_a_large_file_takes_its_size_once(tmp_path: Path) -> None:
    path, content = tmp_path / "log.csv", os.urandom(_files.MIB) * 16
    path.write_bytes(content)
    tracemalloc.start()
    read = read_bounded(path, 64 * _files.MIB, "a log")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert read == content
    assert peak < 1.4 * len(content)
