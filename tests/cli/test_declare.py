"""Commands declared by docstrings: what the user types, and what the function gets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
import typer
from typer.testing import CliRunner

from cangauge.cli.declare import command
from cangauge.errors import InputError

GOT: dict[str, Any] = {}


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Options of several commands.

    Parameters
    ----------
    out : -o, --out DIR
        Folder.
    rate : HZ (0.5 … 10 Hz)
        Rate.
    """

    out: str
    rate: float = 1.0


@command("rate")
def narrow_command(*, shared: Shared) -> None:
    """Leave the rate out."""
    GOT.update(shared=shared)


@command()
def wide_command(
    logs: list[Path],
    *,
    table: Path | None = None,
    starts: list[float | Literal["auto"]] | None = None,
    cells: int = 4,
    shared: Shared,
    json_output: bool = False,
) -> None:
    """Take everything.

    Parameters
    ----------
    logs : LOG
        Logs.
    table : TABLE.csv|.parquet
        Table.
    starts : --start P|auto (0 … 100 %)
        SoC at the first row, repeated.
    cells : N (1 … 2000)
        Cells in series.

    Notes
    -----
    The end.
    """
    GOT.update(logs=logs, table=table, starts=starts, cells=cells, shared=shared, json=json_output)


def run(function: Any, *words: str) -> Any:
    GOT.clear()
    app = typer.Typer()
    app.command()(function)
    return CliRunner().invoke(app, list(words))


def test_a_function_gets_numbers_words_paths_and_groups() -> None:
    ran = run(wide_command, "a.csv", "b.csv", "-o", "x", "--start", "80", "--start", "auto",
              "--table", "t.csv", "--cells", "16", "--rate", "2", "--json")  # fmt: skip
    assert ran.exit_code == 0, ran.output
    assert {
        "logs": [Path("a.csv"), Path("b.csv")], "table": Path("t.csv"), "starts": [80.0, "auto"],
        "cells": 16, "shared": Shared(out="x", rate=2.0), "json": True,
    } == GOT  # fmt: skip
    assert run(narrow_command, "--out", "y").exit_code == 0
    assert {"shared": Shared(out="y")} == GOT


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--start 101", "--start: must lie within 0 … 100 % (got 101.0)"),
        ("--start nan", "--start: must lie within 0 … 100 %"),
        ("--start half", "--start: neither a number nor auto (got 'half'); give a number of %"),
        ("--cells 0", "--cells: must lie within 1 … 2000 (got 0)"),
        ("--rate 11", "--rate: must lie within 0.5 … 10 Hz"),
        ("--table t.txt", "--table: the suffix is not .csv or .parquet"),
    ],
)
def test_what_is_out_of_bounds_is_refused_by_its_option(words: str, says: str) -> None:
    refused = run(wide_command, "a.csv", "-o", "x", *words.split()).exception
    assert isinstance(refused, InputError)
    assert says in str(refused)
    assert not GOT


def test_the_help_page_has_bounds_and_no_section_of_parameters() -> None:
    page = " ".join(run(wide_command, "--help").output.replace("│", " ").split())
    for words in ("--start", "P|auto", "within 0 … 100 %", "within 0.5 … 10 Hz", "The end."):
        assert words in page
    assert "Parameters" not in page
    assert "--rate" not in run(narrow_command, "--help").output
    assert run(narrow_command, "--out", "y", "--rate", "2").exit_code == 2


def test_a_docstring_that_is_no_declaration_fails_at_import() -> None:
    def wrong_command(*, gain: float = 1.0) -> None:
        """Scale.

        Parameters
        ----------
        gain : X of what
            Factor.
        """

    with pytest.raises(ValueError, match="gain : X of what"):
        command()(wrong_command)
