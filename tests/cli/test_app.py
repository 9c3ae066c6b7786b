"""The application: its commands, and what starting one of them imports."""

from __future__ import annotations

import subprocess
import sys

import pytest
import typer

from cangauge.cli.app import COMMANDS, app

SLOW_TO_IMPORT = ("bokeh", "pyarrow", "clarabel", "cangauge.gap", "cangauge.report.page")


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
