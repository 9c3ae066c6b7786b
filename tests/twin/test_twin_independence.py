"""The twin shares nothing with what it judges."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

FORBIDDEN = ("cangauge.model", "cangauge.diagnosis", "cangauge.identify", "cangauge.estimate")


def modules(project: Path) -> list[Path]:
    found = sorted((project / "src/cangauge/validation/twin").glob("*.py"))
    assert len(found) > 8
    return found


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_no_module_imports_what_is_under_test(project: Path) -> None:
    for path in modules(project):
        bad = {name for name in imported(path) if name.startswith(FORBIDDEN)}
        assert not bad, f"{path.name} imports {bad}"


@pytest.mark.slow
def test_nothing_under_test_is_loaded_by_the_twin(project: Path) -> None:
    names = [f"cangauge.validation.twin.{p.stem}" for p in modules(project) if p.stem != "__init__"]
    code = (
        f"import importlib, sys\n[importlib.import_module(n) for n in {names!r}]\n"
        f"print([n for n in sys.modules if n.startswith({FORBIDDEN!r})])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"
