"""What a service writes belongs to it alone, to its bus and to its car."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from cangauge.errors import InputError
from cangauge.service.lifecycle import sole_writer
from live import Command, in_process, leaf_model_path

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="flock is Unix's")
RUN = ("run", "-m", leaf_model_path(), "--interface", "virtual", "--channel", "a")
BRIEF = ("--config", Path(__file__).with_name("brief.toml"))
HOLD = (
    "import sys; from cangauge.service.lifecycle import sole_writer\n"
    "with sole_writer(sys.argv[1]): print('held', flush=True); sys.stdin.read()"
)


def holder(path: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_writer_is_refused_until_the_first_ends(tmp_path: Path) -> None:
    path, link = tmp_path / "x.log", tmp_path / "link.log"
    link.symlink_to(path)
    for end in ("kill", "terminate"):
        first = holder(path)
        for name in (path, link, tmp_path / "." / "x.log"):
            with (
                pytest.raises(InputError, match=f"process {first.pid}. writes this file"),
                sole_writer(name),
            ):
                raise AssertionError(name)
        with sole_writer(tmp_path / "y.log"):
            pass
        getattr(first, end)()
        first.communicate()
        with sole_writer(path):
            assert [each.name for each in tmp_path.glob(".*")] == [".x.log.lock"]
        assert not list(tmp_path.glob(".*"))


def test_a_second_service_with_a_file_of_the_first_is_refused(tmp_path: Path) -> None:
    record, state = tmp_path / "r.log", tmp_path / "s.json"
    first = Command(*RUN, "--record", record, "--state", state)
    first.wait_for("service.ready")
    try:
        for options in (
            ("--record", record),
            ("--state", state),
        ):
            second = in_process(*RUN, *options, *BRIEF)
            assert second.code == 2, options
            assert f"(process {first.process.pid})" in second.err
            assert str(options[1]) in second.err
    finally:
        first.process.terminate()
    assert first.end().code == 0
    assert sorted(each.name for each in tmp_path.iterdir()) == ["r.log"]


@pytest.mark.parametrize("rights", [0o600, 0o644, 0o666])
def test_a_token_that_others_can_read_is_reported(tmp_path: Path, rights: int) -> None:
    token = tmp_path / "token"
    token.write_text("a-token-of-some-length")
    token.chmod(rights)
    config = tmp_path / "run.toml"
    config.write_text('http_token_file = "token"\nduration_s = 0.1\n')
    ended = in_process(*RUN, "--http", "127.0.0.1:0", "--config", config)
    assert ended.code == 0
    assert ("http.token_exposed" in ended.err) == (rights != 0o600)


def test_of_many_that_start_at_once_one_writes(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path / "x.log")]
    pipe, crowd = subprocess.PIPE, list[subprocess.Popen[bytes]]()
    for _ in range(6):
        crowd.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL))
    lines = [each.stdout.readline() for each in crowd if each.stdout is not None]
    assert sorted(lines) == [b""] * 5 + [b"held\n"]
    for each in crowd:
        each.communicate()


def enter_often(path: Path, marker: Path, times: int) -> int:
    """Return how often this process and another one held a file at once."""
    both = 0
    for _ in range(times):
        with suppress(InputError), sole_writer(path):
            try:
                os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
                time.sleep(0.0005)
                marker.unlink()
            except FileExistsError:
                both += 1
    return both


def test_services_that_come_and_go_never_share_a_file(tmp_path: Path) -> None:
    crowd = []
    for _ in range(4):
        child = os.fork()
        if child == 0:
            code = 99
            try:
                code = min(enter_often(tmp_path / "x.log", tmp_path / "marker", 400), 98)
            finally:
                os._exit(code)
        crowd.append(child)
    assert [os.waitstatus_to_exitcode(os.waitpid(each, 0)[1]) for each in crowd] == [0] * 4
    assert not list(tmp_path.iterdir())


def test_a_lock_file_with_any_content_is_quoted_safely(tmp_path: Path) -> None:
    first = holder(tmp_path / "x.log")
    (tmp_path / ".x.log.lock").write_bytes(b"\x1b[2J\xff\n" + b"9" * 100_000)
    with pytest.raises(InputError) as caught, sole_writer(tmp_path / "x.log"):
        raise AssertionError
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    first.communicate()
