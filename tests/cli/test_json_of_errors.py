"""`--json` of a command that fails: one object on stdout; stderr and exit code as without it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cangauge._files import atomic_path
from cangauge.cli.app import COMMANDS, main
from cangauge.errors import CangaugeError, InputError
from live import Ended, in_process
from selection import nightly_except

PARTS = {"message", "source", "field", "value", "cure"}


def failed(*arguments: object, code: int = 2) -> dict[str, Any]:
    """Run a command that must fail; return its error, which stderr must tell in one line too."""
    ended = in_process(*arguments, "--json")
    error = error_of(ended, code)
    # Remarks on the log may come before.
    assert ended.err.splitlines()[-1] == f"error: {error['message']}"
    assert ended.err.count("error: ") == 1
    assert in_process(*arguments).out == ""
    return error


def error_of(ended: Ended, code: int) -> dict[str, Any]:
    assert ended.code == code, ended
    assert len(ended.out.splitlines()) == 1
    found = strictly(ended.out)
    assert set(found) == {"error", "exit_code"}
    assert found["exit_code"] == code
    assert set(found["error"]) == PARTS
    return dict(found["error"])


def strictly(text: str) -> dict[str, Any]:
    """Parse JSON that has no NaN."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    found: dict[str, Any] = json.loads(text, parse_constant=refuse)
    return found


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("fit", ["-o", "out.json"]), ("estimate", ["-m", "{model}", "-o", "out.csv"]),
        ("gap", ["-m", "{model}"]), ("inspect", []), ("replay", []),
    ],
)  # fmt: skip
def test_a_bad_log(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, options: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "bad.csv"
    rows = "".join(f"{t},1,380,{'nan' if t % 5 == 2 else 20}\n" for t in range(30))
    log.write_text("time_s,current_a,voltage_v,temperature_c\n" + rows)
    error = failed(command, log, *(o.format(model=made / "model.json") for o in options))
    assert (error["source"], error["field"]) == (str(log), "temperature_c")
    assert "6 of 30 rows lack" in error["message"]
    assert error["value"] is None
    assert error["cure"] == "check the export: the first is row 3"
    assert list(tmp_path.iterdir()) == [log]


@pytest.mark.parametrize("command", ["estimate", "gap", "run"])
def test_a_missing_model(made: Path, tmp_path: Path, command: str) -> None:
    log = [] if command == "run" else [made / "part.csv"]
    output = ["-o", tmp_path / "out.csv"] if command == "estimate" else []
    error = failed(command, *log, "-m", tmp_path / "none.json", *output)
    assert error["source"] == str(tmp_path / "none.json")
    assert "cangauge fit" in error["cure"]


@pytest.mark.parametrize("command", nightly_except(("fit", "run"), COMMANDS))
def test_usage_that_typer_refuses(command: str) -> None:
    assert failed(command, "--bogus")["field"] == "--bogus"
    # Spelt nearly like --help, which is suggested.
    assert failed(command, "--hel")["field"] == "--hel"


@pytest.mark.parametrize(
    ("words", "field", "say"),
    [
        ("fit", "LOG", ""),
        ("fit x.csv", "-o/--output", ""),
        ("fit x.csv -o m.json --rate-hz x", "--rate-hz", "must be a valid number"),
        ("bogus", None, "no such command"),
    ],
)
def test_more_usage_that_typer_refuses(words: str, field: str | None, say: str) -> None:
    error = failed(*words.split())
    assert error["field"] == field
    assert say in error["message"]


def test_json_takes_no_value_and_after_two_dashes_it_is_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = in_process("fit", "x.csv", "-o", "m.json", "--json=yes")
    assert error_of(ended, 2)["field"] == "--json"
    ended = in_process("inspect", "--", "--json")
    assert (ended.code, ended.out) == (2, "")


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_a_service_that_fails(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, log_format: str
) -> None:
    def fail(*_: object) -> None:
        raise CangaugeError("the bus is on fire")

    monkeypatch.setattr("cangauge.service.run.Service.run", fail)
    config = tmp_path / "run.toml"
    config.write_text(f'log_format = "{log_format}"\n')
    ended = in_process("run", "-m", made / "model.json", "--config", config, "--json")
    assert error_of(ended, 1) == dict.fromkeys(PARTS) | {"message": "the bus is on fire"}
    (line,) = ended.err.splitlines()
    if log_format == "text":
        assert line == "error: the bus is on fire"
    else:
        assert strictly(line)["event"] == "service.failed"


def test_a_disk_that_is_full(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        with atomic_path(tmp_path / "soc.csv"):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("cangauge.cli.estimate.write_estimates", full)
    error = failed(
        "estimate", made / "part.csv", "-m", made / "model.json", "-o", tmp_path / "soc.csv", code=1
    )
    assert "writing failed: No space left on device" in error["message"]


def test_a_mistake_of_ours_keeps_its_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr("cangauge.bus.recording.open_recording", fail)
    monkeypatch.setattr(sys, "argv", ["cangauge", "inspect", "x.csv", "--json"])
    with pytest.raises(ZeroDivisionError):  # Python prints it and exits with 1
        main()
    ended = Ended(1, capsys.readouterr().out, "")
    assert error_of(ended, 1)["message"] == "ZeroDivisionError: by nothing"


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, None),
        (True, True),
        (7, 7),
        (np.float64(2.5), 2.5),
        (np.int64(3), 3),
        (np.nan, None),
        (np.float32(np.inf), None),
        pytest.param(10**5000, "a huge int", id="huge"),
        ([1, 2], "[1, 2]"),
        ({1: {2}}, "{1: {2}}"),
        (b"\xff", "b'\\xff'"),
        ("x" * 1000, "x" * 160 + "…"),
    ],
)
def test_any_value_can_be_told(
    monkeypatch: pytest.MonkeyPatch, value: object, expected: object
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise InputError("is wrong", source=Path("x.csv"), field="a", value=value)

    monkeypatch.setattr("cangauge.bus.recording.open_recording", fail)
    error = error_of(in_process("inspect", "x.csv", "--json"), 2)
    assert error["value"] == expected
    assert type(error["value"]) is type(expected)
    assert (error["source"], error["field"], error["cure"]) == ("x.csv", "a", None)


def test_a_name_that_is_no_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ended = in_process("inspect", os.fsdecode(b"\xff\xe4.csv"), "--json")
    assert ended.out.isascii()
    assert error_of(ended, 2)["source"] == "\udcff\udce4.csv"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_the_exit_code_stays_where_nobody_can_read(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "cangauge", "inspect", "none.csv", "--json"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False, cwd=tmp_path,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr == "error: none.csv: no such file; check the path\n"
