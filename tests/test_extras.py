"""Without an extra the core works, and what needs the extra is refused at once with the cure."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from cangauge import InputError, Log, _extras
from live import COMMAND, in_process, leaf_model_path, refused

PYPROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Return the packages that are taken for absent, to change: those of all extras."""
    absent = {package for packages in _extras._PACKAGES.values() for package in packages}

    def find(name: str) -> Any:
        return None if name in absent else find_spec(name)

    monkeypatch.setattr(_extras, "find_spec", find)
    return absent


def requirements(extra: str) -> Iterator[str]:
    """Yield the names of what pip installs for an extra."""
    for text in PYPROJECT["project"]["optional-dependencies"][extra]:
        (name,) = re.findall(r"[\w-]+(?=[]>])", text)
        if text.startswith("cangauge["):
            yield from requirements(name)
        else:
            yield name


@pytest.mark.parametrize("extra", _extras._PACKAGES)
def test_an_extra_is_judged_by_all_that_pip_installs_for_it(extra: str) -> None:
    names = packages_distributions()
    known = {names[package][0].lower().replace("_", "-") for package in _extras._PACKAGES[extra]}
    assert known == {*requirements(extra)}


def test_http_needs_what_the_metrics_need(absent: set[str], tmp_path: Path) -> None:
    absent.clear()
    absent.add("prometheus_client")
    path = configuration(tmp_path, 'http = "127.0.0.1:0"')
    refused(
        in_process("check", path),
        "http: needs prometheus_client, which is not installed; pip install 'cangauge[metrics]'",
    )


def configuration(folder: Path, keys: str) -> Path:
    path = folder / "car.toml"
    path.write_text(
        f'model = "{leaf_model_path()}"\ninterface = "virtual"\nchannel = "x"\n{keys}\n'
    )
    return path


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
def test_pages_are_refused_before_anything_is_read(absent: set[str], command: str) -> None:
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
    absent: set[str], tmp_path: Path, key: str, name: str
) -> None:
    ended = in_process("check", configuration(tmp_path, key))
    refused(ended, f"pip install 'cangauge[{name}]'")


def test_a_figure_is_refused_too(absent: set[str]) -> None:
    log = Log.from_dataframe(
        {"time_s": [0, 1], "current_a": [1, 2], "voltage_v": [380, 379]}, temperature_c=20.0
    )
    with pytest.raises(InputError, match=r"cangauge\[report\]"):
        log.plot()


def test_a_light_install_names_what_a_command_needs() -> None:
    code = f"import sys; sys.modules['pyarrow'] = None; {COMMAND}"
    done = subprocess.run(
        [sys.executable, "-c", code, "inspect", "absent.csv"],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr == ("error: needs pyarrow, which is not installed; pip install cangauge\n")
