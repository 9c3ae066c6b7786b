"""What a service writes belongs to it alone, to its bus and to its car."""

from __future__ import annotations

import subprocess
import sys
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


def test_a_lock_file_with_any_content_is_quoted_safely(tmp_path: Path) -> None:
    first = holder(tmp_path / "x.log")
    (tmp_path / ".x.log.lock").write_bytes(b"\x1b[2J\xff\n" + b"9" * 100_000)
    with pytest.raises(InputError) as caught, sole_writer(tmp_path / "x.log"):
        raise AssertionError
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    first.communicate()
