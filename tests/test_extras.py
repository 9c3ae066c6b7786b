"""Without an extra the core works, and what needs the extra is refused at once with the cure."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from cangauge import InputError, Log, _extras
from live import in_process, leaf_model_path, refused


@pytest.fixture
def core_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the packages of all extras for absent."""

    def of_the_core(name: str) -> Any:
        return None if name in _extras._PACKAGES.values() else find_spec(name)

    monkeypatch.setattr(_extras, "find_spec", of_the_core)


@pytest.mark.parametrize(
    "command",
    [
        "fit absent.csv -o x.json --report x.html",
        "estimate absent.csv -m m.json -o x.csv --report x.html",
        "gap absent.csv -m m.json --report x.html",
        "judge absent.csv -m m.json --report x.html",
        "inspect absent.csv --report x.html",
        "demo",
    ],
)
def test_pages_are_refused_before_anything_is_read(core_alone: None, command: str) -> None:
    refused(in_process(*command.split()), "bokeh", "pip install 'cangauge[report]'")


@pytest.mark.parametrize(
    ("key", "name"),
    [
        ('dashboard = "8642"', "live"),
        ('http = "127.0.0.1:9464"', "metrics"),
        ('[mqtt]\nbroker = "localhost"', "mqtt"),
    ],
)
def test_outputs_of_the_service_are_refused_by_check(
    core_alone: None, tmp_path: Path, key: str, name: str
) -> None:
    path = tmp_path / "car.toml"
    path.write_text(f'model = "{leaf_model_path()}"\ninterface = "virtual"\nchannel = "x"\n{key}\n')
    refused(in_process("check", path), f"pip install 'cangauge[{name}]'")


def test_a_figure_is_refused_too(core_alone: None) -> None:
    log = Log.from_dataframe(
        {"time_s": [0, 1], "current_a": [1, 2], "voltage_v": [380, 379]}, temperature_c=20.0
    )
    with pytest.raises(InputError, match=r"cangauge\[report\]"):
        log.plot()
