"""Wrong use of every command: exit code 2, one clear line, nothing written."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import small_files
from cangauge._resources import shared_file
from cangauge.cli import app as line
from cangauge.cli.app import load_command, main
from cangauge.model.model_file import Model

# `status` answers 1 where no service runs, `gap-check` draws its own cases, and an absent log is a
# row of `fleet`: see tests/service, tests/validation and tests/fleet.
ELSEWHERE = {"status", "gap-check", "fleet"}
COMMANDS: dict[str, Any] = {
    name: load_command(name) for name in line.COMMANDS if name not in ELSEWHERE
}
VALID = {
    # Complete but for an absent file, so that none of them starts to work.
    "demo": ["--folder", "file.txt"],
    "init": ["absent.log", "-o", "car"],
    "check": ["absent.toml"],
    "judge": ["absent.csv", "-m", "model.json"],
    "fit": ["absent.csv", "-o", "out.json"],
    "estimate": ["absent.csv", "-m", "model.json", "-o", "out.csv"],
    "gap": ["absent.csv", "-m", "model.json"],
    "run": ["-m", "absent.json"],
    "live": ["absent.toml"],
    "replay": ["absent.csv"],
    "inspect": ["absent.csv"],
    "twin": ["-o", "absent/out.csv"],
    "export-c": ["-m", "absent.json", "-o", "out"],
    "export-fmu": ["-m", "absent.json", "-o", "out.fmu"],
}


class Ran(NamedTuple):
    code: int
    out: str
    err: str


Run = Callable[..., Ran]


@pytest.fixture(scope="module")
def model_text() -> str:
    return Model.load(shared_file("replay", "leaf2012_published_model.json")).to_json()


@pytest.fixture
def run(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    model_text: str,
) -> Run:
    """Run `cangauge ARG…` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    Path("model.json").write_text(model_text)
    Path("file.txt").write_text("x\n")
    Path("one.csv").write_text("time_s,current_a,voltage_v,temperature_c\n0,1,380,20\n")
    Path("log.csv").write_bytes(small_files.csv_log())

    def call(*args: str) -> Ran:
        monkeypatch.setattr(sys, "argv", ["cangauge", *args])
        capfd.readouterr()
        with pytest.raises(SystemExit) as left:
            main()
        return Ran(int(left.value.code or 0), *capfd.readouterr())

    return call


@pytest.fixture
def refused(run: Run) -> Callable[..., str]:
    """Run it; return its one line of error. Nothing may be left in the folder."""

    def call(*args: str) -> str:
        before = {path: path.stat().st_mtime_ns for path in Path().iterdir()}
        ran = run(*args)
        assert ran.code == 2, ran
        assert ran.out == ""
        lines = ran.err.splitlines()
        assert len(lines) == 1, ran.err
        assert lines[0].startswith("error: ")
        assert {path: path.stat().st_mtime_ns for path in Path().iterdir()} == before
        return lines[0]

    return call


def test_all_commands_are_here() -> None:
    assert set(VALID) == set(COMMANDS)


@pytest.mark.parametrize("command", list(VALID))
def test_what_is_valid_ends_at_the_missing_file(command: str, refused: Callable[..., str]) -> None:
    line = refused(command, *VALID[command])
    assert re.search("no such file|does not exist|cannot create", line)


@pytest.mark.parametrize("command", ["", *VALID])
def test_unknown_options_and_too_many_arguments(command: str, refused: Callable[..., str]) -> None:
    given = [command, *VALID[command]] if command else []
    assert "--bogus" in refused(*given, "--bogus")
    if command not in {"fit", "gap", "init", "judge"}:  # which take any number of files
        assert "unexpected extra argument" in refused(*given, "x") or not command
    assert f"see `cangauge{' ' * bool(command)}{command} --help`" in refused(*given, "--bogus")


def test_no_such_command(refused: Callable[..., str]) -> None:
    assert "no such command: bogus" in refused("bogus")


@pytest.mark.parametrize("command", [name for name, given in VALID.items() if len(given) > 2])
def test_every_required_option_is_missed_by_name(command: str, refused: Callable[..., str]) -> None:
    needed = [p for p in COMMANDS[command].params if p.required]
    for parameter in needed:
        given = VALID[command]
        if parameter.param_type_name == "argument":
            args, name = given[1:], (parameter.metavar or parameter.name).upper()
        else:
            at = given.index(parameter.opts[0])
            args, name = given[:at] + given[at + 2 :], parameter.opts[0]
        assert name in refused(command, *args)


def options() -> Iterator[tuple[str, Any]]:
    for name, command in COMMANDS.items():
        for parameter in command.params:
            if parameter.param_type_name == "option" and not getattr(parameter, "is_flag", False):
                yield name, parameter


def _without(args: list[str], parameter: Any) -> list[str]:
    for spelling in parameter.opts:
        if spelling in args:
            at = args.index(spelling)
            return args[:at] + args[at + 2 :]
    return args


@pytest.mark.parametrize(
    ("command", "parameter"), [pytest.param(c, p, id=f"{c} {p.opts[0]}") for c, p in options()]
)
def test_every_option_with_every_kind_of_wrong_value(
    command: str, parameter: Any, refused: Callable[..., str]
) -> None:
    """Valid ones fail at the absent file; none may end in a traceback or write a file."""
    if command != "demo":  # whose folder may have any name
        for value in WRONG:
            spelt = f"{parameter.opts[-1]}={value}"
            refused(command, *_without(VALID[command], parameter), spelt)
    refused(command, *_without(VALID[command], parameter), parameter.opts[-1])


WRONG = ("", "nan", "inf", "-inf", "-1", "1e999", "x", ".", "/dev/zero", "a" * 5000, "é=ä")
NUMBERS = {
    "fit": ("--capacity-ah", "--initial-soc", "--rate-hz", "--epsilon", "--t-ref", "--temperature"),
    "estimate": ("--initial-soc", "--initial-soc-std", "--capacity-ah", "--temperature"),
    "gap": ("--initial-soc", "--capacity-ah", "--temperature"),
    "run": ("--temperature", "--initial-soc", "--initial-soc-std"),
    "replay": ("--speed", "--temperature"),
    "inspect": ("--temperature",),
}  # fmt: skip
PRESENT = {
    "fit": ["log.csv", "-o", "out.json"],
    "estimate": ["log.csv", "-m", "model.json", "-o", "out.csv"],
    "gap": ["log.csv", "-m", "model.json"],
    "run": ["-m", "model.json"],
    "replay": ["log.csv", "--vehicle", "generic"],
    "inspect": ["log.csv"],
}


@pytest.mark.parametrize("value", ["nan", "inf", "-1e9"])
@pytest.mark.parametrize(
    ("command", "option"), [(name, option) for name, all_ in NUMBERS.items() for option in all_]
)
def test_no_number_of_an_option_is_out_of_its_range(
    command: str, option: str, value: str, refused: Callable[..., str]
) -> None:
    line = refused(command, *PRESENT[command], option, value)
    assert option in line
    assert not re.search(r"[Ii]nput should|less than or equal|greater than or equal", line)


@pytest.mark.parametrize("option", ["--initial-soc", "--initial-soc-std"])
def test_a_soc_beyond_100_is_refused(option: str, refused: Callable[..., str]) -> None:
    for command in ("run", "estimate"):
        line = refused(command, *PRESENT[command], option, "150")
        assert re.search(f"{option}: must (lie within 0 … 100|be at most 100) ", line)
        assert "(got 150.0)" in line


def test_single_rows(refused: Callable[..., str]) -> None:
    for args in (
        ("fit", "one.csv", "-o", "out.json"),
        ("fit", "one.csv", "-o", "out.json", "--capacity-ah", "from-soc"),
        ("estimate", "one.csv", "-m", "model.json", "-o", "out.csv"),
        ("gap", "one.csv", "-m", "model.json"),
    ):
        assert refused(*args).startswith("error: one.csv: a single row: charge is counted")


def test_a_reference_that_rises_while_discharging(refused: Callable[..., str]) -> None:
    rows = (f"{t},20,{380 - 0.001 * t},20,{50 + 0.005 * t}" for t in range(2000))
    head = "time_s,current_a,voltage_v,temperature_c,soc_pct\n"
    Path("log.csv").write_text(head + "\n".join(rows) + "\n")
    line = refused("fit", "log.csv", "-o", "out.json", "--capacity-ah", "from-soc")
    assert "sign of current is inverted: reference SoC rises as charge is taken out" in line
    assert "correct soc_pct or leave it out" in line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"capacity_a": 50.0}, "capacity_a: unknown key; did you mean capacity_ah?"),
        ({"range": {"soc_pc": [0, 100]}}, "range.soc_pc: unknown key; did you mean soc_pct?"),
        ({"published": {"epsilo": 0.05}}, "published.epsilo: unknown key; did you mean epsilon?"),
        ({"published": {"delays_s": [70.0, 30.0, 10.0, 0.0]}}, "published.delays_s: must increase"),
        ({"published": {"delays_s": [0.0, 10.0]}}, "coefficients: unknown are R3, R4"),
        ({"capacity_ah": -1}, "capacity_ah: must be at least 0.001 (got -1"),
        ({"name": 3}, "name: must be a valid string (got 3)"),
        ({"made": None}, "made: must be a table"),
    ],
)
def test_mistakes_in_a_model_file(
    change: dict[str, Any], words: str, refused: Callable[..., str], model_text: str
) -> None:
    tree = json.loads(model_text)
    for key, value in change.items():
        tree[key] = {**tree[key], **value} if isinstance(value, dict) else value
    Path("model.json").write_text(json.dumps(tree))
    assert words in refused("estimate", "log.csv", "-m", "model.json", "-o", "out.csv")


@pytest.mark.parametrize("name", ["x.log", "x.blf", "x.csv", "x.asc"])
def test_junk_is_neither_log_nor_capture(name: str, refused: Callable[..., str]) -> None:
    Path(name).write_bytes(bytes(range(256)) * 40)
    for args in (("inspect", name), ("replay", name), ("fit", name, "-o", "out.json"),
                 ("inspect", name, "--vehicle", "leaf_ze0")):  # fmt: skip
        line = refused(*args)
        assert f"{name}: not a known kind of log, nor of capture" in line
        assert "candump" in line
