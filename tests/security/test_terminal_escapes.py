"""Foreign text reaches terminals and journals without its control characters."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path
from typing import Any

import pytest
from rich.table import Table

from cangauge._logging import emit
from cangauge.cli.output import PlainConsole, emit_json, note, print_table
from cangauge.service.events import LogFormat, logging_to
from live import in_process, leaf_model_path

HOSTILE = "a\x1b]0;owned\x07b\x1b[2Jc\x9bd\x08e\rf\x7fg\x00h"
CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
LOG = logging.getLogger("cangauge.test")


def test_notes_and_results(capsys: pytest.CaptureFixture[str]) -> None:
    note(HOSTILE + "\n\ttwo lines")
    print_table(HOSTILE, ("name", "<value"), [(HOSTILE, "[red]1[/]")])
    emit_json({HOSTILE: HOSTILE})
    shown = capsys.readouterr()
    assert not CONTROLS.search(shown.out + shown.err)
    assert shown.err.endswith("\n\ttwo lines\n")
    assert r"a\x1b]0;owned\x07b" in shown.out
    assert json.loads(shown.out.splitlines()[-1]) == {HOSTILE: HOSTILE}


def test_rich_keeps_its_own_styles(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table(HOSTILE)
    table.add_row(HOSTILE)
    PlainConsole(force_terminal=True, width=200).print(f"[bold]{HOSTILE}[/]", table)
    shown = capsys.readouterr().out
    assert not CONTROLS.search(re.sub(r"\x1b\[[0-9;]*m", "", shown))
    assert "\x1b[1m" in shown


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_events(log_format: LogFormat, capsys: pytest.CaptureFixture[str]) -> None:
    with logging_to(log_format):
        emit(LOG.warning, "bus.lost", HOSTILE + "\nforged", channel=HOSTILE)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert not CONTROLS.search(lines[0])
    if log_format == "json":
        content: dict[str, Any] = json.loads(lines[0])
        assert content["message"] == HOSTILE + "\nforged"


def test_names_of_files_and_channels(tmp_path: Path) -> None:
    log = tmp_path / f"{HOSTILE[:-2]}.csv"
    rows = "".join(f"{0.1 * n:.1f},{n % 7},{350 + n % 5},20,{n % 3}\n" for n in range(300))
    heading = "time_s,current_a,voltage_v,temperature_c,[link=file:///x]x[/link]\x1b[2J\x9b\n"
    log.write_text(heading + rows, encoding="utf-8")
    runs = [
        in_process("inspect", log),
        in_process("inspect", tmp_path / HOSTILE[:-2]),
        in_process("estimate", log, "-m", leaf_model_path(), "-o", tmp_path / "soc.csv"),
        in_process("estimate", log, "-m", tmp_path / HOSTILE[:-2]),
        in_process("run", "-m", leaf_model_path(), "--interface", HOSTILE[:-2]),
        in_process("run", HOSTILE[:-2]),
    ]
    for each in runs:
        assert not CONTROLS.search(each.out + each.err), each
    assert runs[0].code == 0
    assert r"a\x1b]0;owned" in runs[0].out
