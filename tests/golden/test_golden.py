"""What the program gives equals the golden records; see `make.py`."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from selection import nightly_except

HERE = Path(__file__).resolve().parent
_spec = importlib.util.spec_from_file_location("golden_make", HERE / "make.py")
assert _spec is not None
assert _spec.loader is not None
make = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(make)

NAMES = [path.name for path in make.captures()] or ["absent"]
IN_SUITE = (
    "10bars.csv.gz", "62kWh-Battery-only-EVcan.txt.gz", "AZE0w40kWhv2.48.log.gz",
    "bmw_i3_battery_only.trc.gz",
)  # fmt: skip
"""Captures of three makes in four formats; `make nightly` compares the others too."""


def recorded(name: str) -> dict[str, Any]:
    return json.loads((HERE / f"{name}.json").read_text())


def plain(found: Any) -> Any:
    return json.loads(json.dumps(found))


@pytest.mark.real
@pytest.mark.parametrize("name", nightly_except(IN_SUITE, NAMES))
def test_a_capture_gives_the_same_samples(name: str, shared_data: Path) -> None:
    found = plain(make.capture_records(next(shared_data.glob(f"*/{name}"))))
    assert found == recorded("captures")["captures"][name]


@pytest.mark.real
def test_every_capture_has_a_record(shared_data: Path) -> None:
    assert sorted(recorded("captures")["captures"]) == sorted(NAMES)


def test_bad_inputs_have_the_same_errors() -> None:
    assert plain(make.bad_inputs()) == recorded("captures")["bad_inputs"]


def without_lists_empty_in(value: Any, other: Any) -> Any:
    """Return a shape without what an empty list of the other shape does not show."""
    if isinstance(value, dict) and isinstance(other, dict):
        return {key: without_lists_empty_in(each, other.get(key)) for key, each in value.items()}
    return [] if isinstance(value, list) and other == [] else value


def test_json_of_commands_has_the_same_keys() -> None:
    found, expected = plain(make.command_records()), recorded("commands")
    assert without_lists_empty_in(found, expected) == without_lists_empty_in(expected, found)


@pytest.mark.parametrize("name", nightly_except(("oxide",), make.FROZEN))
def test_a_frozen_model_gives_the_same_frames(name: str) -> None:
    assert plain(make.model_record(name)) == recorded("models")[name]
