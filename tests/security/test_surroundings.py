"""Streams, environment and working folder of a command: odd ones cost neither result nor safety."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cangauge._resources import shared_file
from live import COMMAND, leaf_model_path

SHIPPED = shared_file("replay", "leaf2012_reconstruction_10min.parquet")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a Unix shell")
RUN = (
    "run", "-m", leaf_model_path(), "--interface", "virtual", "--channel", "a", "--config",
    Path(__file__).with_name("brief.toml"),
)  # fmt: skip


def shell(
    arguments: tuple[object, ...], redirection: str, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["/bin/sh", "-c", f'"$@" {redirection}', "", sys.executable, "-c", COMMAND]
        + [str(each) for each in arguments],
        capture_output=True, text=True, timeout=60.0, check=False, env=env, errors="replace",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "redirection", "code", "line"),
    [
        (("status", "--endpoint", "/absent", "--json"), ">&-", 1, "error: stdout is closed"),
        (("inspect", SHIPPED), ">&-", 1, "error: stdout is closed"),
        (("status", "--endpoint", "/absent", "--json"), ">/dev/full", 1, "error: stdout: No space"),
        (("status", "--endpoint", "/absent"), "<&- >&- 2>&-", 1, ""),
        (("status", "--absent"), "<&- >&- 2>&-", 2, ""),
        (("status", "--help"), ">/dev/full", 1, "error: stdout: No space"),
        (("status", "--help"), "| true", 0, ""),
    ],
)
def test_closed_and_full_streams(
    arguments: tuple[str, ...], redirection: str, code: int, line: str
) -> None:
    ended = shell(arguments, redirection)
    assert ended.returncode == code
    assert ended.stderr.startswith(line)
    assert "Traceback" not in ended.stderr
    assert len(ended.stderr.splitlines()) <= 1


@pytest.mark.nightly
def test_no_file_takes_the_number_of_a_closed_stream(tmp_path: Path) -> None:
    ended = shell((*RUN, "--record", tmp_path / "r.log", "--json"), "<&- >&- 2>&-")
    assert ended.returncode == 1  # the result could not be printed
    assert (tmp_path / "r.log").read_bytes() == b""


@pytest.mark.nightly
def test_odd_environments(tmp_path: Path) -> None:
    long = str(tmp_path / ("x" * 200))
    environment = {
        "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "COLUMNS": "-5",
        "TERM": "nonsense", "TMPDIR": "/absent", "XDG_RUNTIME_DIR": long,
        "NOTIFY_SOCKET": "/" + long,
        "WATCHDOG_USEC": "9" * 6000, "STATE_DIRECTORY": "::", "OMP_NUM_THREADS": "many",
    }  # fmt: skip
    ended = shell((*RUN, "--json"), "", environment)
    assert ended.returncode == 0, ended.stderr
    assert "status.unavailable" in ended.stderr
    helped = shell(("status", "--help"), "", environment)
    assert helped.returncode == 0, helped.stderr
    assert "\\xb1" in helped.stdout  # "±" in words that this locale has
