"""The commands as a user meets them: arguments in; exit code, stdout and stderr out."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import typer

from cangauge.cli.app import main
from cangauge.cli.estimate import estimate_command
from cangauge.cli.fit import fit_command
from cangauge.cli.gap import gap_command
from cangauge.cli.inspect import inspect_command
from cangauge.extras.validation.gap_check_command import gap_check_command
from cangauge.identify.fit import fit
from cangauge.logs.canonical import write_log
from synthetic import synthetic_log

app = typer.Typer()
app.command("fit")(fit_command)
app.command("estimate")(estimate_command)
app.command("gap")(gap_command)
app.command("gap-check")(gap_check_command)
app.command("inspect")(inspect_command)


@dataclass
class Ran:
    code: int
    out: str
    err: str


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """Run `cangauge ARG…` through its own `main`."""

    def call(*args: object) -> Ran:
        monkeypatch.setattr("cangauge.cli.app.app", app)
        monkeypatch.setattr(sys, "argv", ["cangauge", *map(str, args)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main()
        said = capsys.readouterr()
        return Ran(int(left.value.code or 0), said.out, said.err)

    return call


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a full discharge, a part of one, and the model of the first; only to read."""
    folder = tmp_path_factory.mktemp("made")
    full = synthetic_log(hours=1.2, noise_v=0.5, name="full")
    part = synthetic_log(hours=0.4, start_pct=80.0, end_pct=60.0, noise_v=0.5, seed=3, name="part")
    write_log(full, folder / "full.parquet")
    write_log(part, folder / "part.csv")
    fit([full]).model.save(folder / "model.json")
    return folder
