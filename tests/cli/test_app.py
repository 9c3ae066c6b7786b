"""The application: its commands, and what starting one of them imports."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import typer

from cangauge._resources import THREADS
from cangauge.cli.app import COMMANDS, app

SLOW_TO_IMPORT = ("bokeh", "pyarrow", "clarabel", "cangauge.diagnosis", "cangauge.report.page")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_there_and_has_help(name: str) -> None:
    command = typer.main.get_command(app).get_command(None, name)  # type: ignore[attr-defined, arg-type] # a group, which needs no context
    assert command.name == name
    assert command.help


def test_the_service_starts_without_what_only_others_need() -> None:
    code = (
        "import sys; from cangauge.cli.app import LazyGroup, app; import typer;"
        "typer.main.get_command(app).get_command(None, 'run');"
        f"print([name for name in {SLOW_TO_IMPORT!r} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(("asked", "expected"), [(None, "1"), ("2", "2")])
def test_linear_algebra_has_one_thread_unless_the_user_says_more(
    asked: str | None, expected: str
) -> None:
    """It is asked for before numpy is imported, which would not hear of it later."""
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
