"""The service names its extras, and imports none of them."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from cangauge import service
from cangauge.service.run import OUTPUTS


def imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(str(node.module))
    return found


def test_the_service_imports_no_extra() -> None:
    for path in Path(str(service.__file__)).parent.glob("*.py"):
        assert not [each for each in imported(path) if each.startswith("cangauge.extras")], path


def test_each_output_is_made_by_its_module() -> None:
    for module in OUTPUTS.values():
        assert callable(import_module(module).make_output)


def test_a_service_without_outputs_needs_no_web_server() -> None:
    code = (
        "import sys, cangauge.service.run\n"
        "print([each for each in ('tornado', 'bokeh', 'paho') if each in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"
