"""The application: its commands, help, completion, and what a start imports."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from cangauge.cli.app import COMMANDS, THREADS, help_line, load_command
from cangauge.cli.output import note
from live import in_process


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_loads_and_the_listing_has_its_first_line(name: str) -> None:
    command = load_command(name)
    assert command.name == name
    assert (command.help or "").splitlines()[0] == help_line(COMMANDS[name])


def test_another_package_adds_a_command(tmp_path: Path) -> None:
    (tmp_path / "other.py").write_text(
        'def hello_command() -> None:\n    """Greet the pack."""\n    print("hello")\n'
    )
    info = tmp_path / "other-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[cangauge.commands]\nhello = other:hello_command\n")
    for words, expected in ((["hello"], "hello"), (["--help"], "Greet the pack.")):
        done = subprocess.run(
            [sys.executable, "-m", "cangauge", *words],
            capture_output=True, text=True, check=True, timeout=60,
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
        )  # fmt: skip
        assert expected in done.stdout


def test_the_root_page_and_completion_import_no_command() -> None:
    for setting, word in (({}, "--help"), (COMPLETE_R, "")):
        code = (
            f"import sys; sys.argv = ['cangauge', {word!r}]; from cangauge.cli.app import main\n"
            "try: main()\n"
            "except SystemExit: print([m for m in sys.modules if m.startswith('cangauge.cli.')])"
        )
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True, text=True, check=True, timeout=60, env=os.environ | setting,
        )  # fmt: skip
        assert "replay" in done.stdout
        assert done.stdout.splitlines()[-1] == "['cangauge.cli.output', 'cangauge.cli.app']"


COMPLETE_R = {
    "_CANGAUGE_COMPLETE": "complete_bash",
    "COMP_WORDS": "cangauge re",
    "COMP_CWORD": "1",
}


@pytest.mark.parametrize(
    ("line", "suggested"),
    [
        ("rnu", "run"),
        ("gapcheck", "gap-check"),
        ("run --modle x", "--model"),
        ("run --htp x", "--http"),
    ],
)
def test_mistyped_words_are_answered_with_the_nearest(line: str, suggested: str) -> None:
    ended = in_process(*line.split())
    assert ended.code == 2
    assert f"did you mean {suggested}" in ended.err.lower()
    assert ended.err.count("\n") == 1


@pytest.mark.parametrize("words", [["-h"], ["status", "-h"]])
def test_h_shows_help(words: list[str]) -> None:
    ended = in_process(*words)
    assert ended.code == 0
    assert "Usage: cangauge" in ended.out


@pytest.mark.parametrize(("asked", "expected"), [(None, "1"), ("2", "2")])
def test_blas_has_one_thread_unless_the_user_asks_for_more(
    asked: str | None, expected: str
) -> None:
    """Set before numpy is imported, which reads the variable once."""
    code = (
        "import os, sys; from cangauge.cli import app; loaded = 'numpy' in sys.modules\n"
        "sys.argv = ['cangauge', '--version']\n"
        "try: app.main()\n"
        "except SystemExit: print(loaded, os.environ['OPENBLAS_NUM_THREADS'])"
    )
    environment = {k: v for k, v in os.environ.items() if k not in THREADS}
    if asked:
        environment["OPENBLAS_NUM_THREADS"] = asked
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, check=True, timeout=60, env=environment,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == f"False {expected}"


def test_lines_on_a_terminal_fit_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between words: a path stays whole. What is piped stays one line."""
    said, path = io.StringIO(), "/a/long/path-of-a/" + 60 * "x" + ".csv"
    text = f"error: {path}: time_s: runs backwards in 17 rows; " + 12 * "sort the file "
    monkeypatch.setattr(sys, "stderr", said)
    monkeypatch.setenv("COLUMNS", "80")
    note(text)
    assert said.getvalue() == text.rstrip() + "\n"
    monkeypatch.setattr(said, "isatty", lambda: True, raising=False)
    said.truncate(0)
    note(text)
    lines = said.getvalue().strip("\0").splitlines()
    assert all(len(line) <= 80 or path in line for line in lines)
    assert " ".join(line.strip() for line in lines) == text.rstrip()
