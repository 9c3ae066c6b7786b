"""Declared options: what the user types, and what the function of a command gets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from cangauge.cli.options import CELLS, Json, argument, command, option
from cangauge.errors import InputError

GOT: dict[str, Any] = {}


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Options of several commands."""

    out: Annotated[str, option("-o, --out", "DIR", "Folder.")]
    rate: Annotated[float, option("--rate", "HZ", "Rate.", within=(0.5, 10.0), unit="Hz")] = 1.0


@command("rate")
def narrow_command(*, shared: Shared) -> None:
    """Leave the rate out."""
    GOT.update(shared=shared)


@command()
def wide_command(
    logs: Annotated[list[Path], argument("LOG", "Logs.")],
    *,
    table: Annotated[
        Path | None, option("--table", "TABLE", "Table.", suffixes=(".csv", ".parquet"))
    ] = None,
    starts: Annotated[
        list[Any] | None,
        option(
            "--start",
            "P|auto",
            "SoC at the first row, repeated.",
            within=(0.0, 100.0),
            unit="%",
            word="auto",
        ),
    ] = None,
    cells: Annotated[int, CELLS] = 4,
    shared: Shared,
    json_output: Json = False,
) -> None:
    """Take everything.

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


def test_the_help_page_has_bounds_and_the_whole_docstring() -> None:
    page = " ".join(run(wide_command, "--help").output.replace("│", " ").split())
    for words in ("--start", "P|auto", "within 0 … 100 %", "within 0.5 … 10 Hz", "The end."):
        assert words in page
    assert "--rate" not in run(narrow_command, "--help").output
    assert run(narrow_command, "--out", "y", "--rate", "2").exit_code == 2
