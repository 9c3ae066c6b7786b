"""The service names its extras, and imports none of them."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

from cangauge.service.run import OUTPUTS


def test_each_output_is_made_by_its_module() -> None:
    for module in OUTPUTS:
        assert callable(import_module(module).make_output)


def test_a_service_without_outputs_needs_no_web_server() -> None:
    code = (
        "import sys, cangauge.service.run\n"
        "print([each for each in ('tornado', 'bokeh', 'paho') if each in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"
