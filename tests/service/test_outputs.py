"""The service names its extras, and imports none of them."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

from cangauge.service.setup import OUTPUTS


def test_each_output_is_made_by_its_module() -> None:
    for module in OUTPUTS:
        assert callable(import_module(module).output_of)


def test_a_service_without_outputs_needs_the_light_install_alone() -> None:
    absent = (
        "bokeh",
        "filterpy",
        "jinja2",
        "matplotlib",
        "paho",
        "pyarrow",
        "threadpoolctl",
        "tornado",
    )
    code = (
        "import sys, cangauge.cli.run, cangauge.cli.status, cangauge.service.run\n"
        f"print([each for each in {absent} if each in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"
