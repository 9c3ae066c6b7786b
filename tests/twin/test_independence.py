"""Imports of the validation: it shares nothing with what it validates."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

UNDER_TEST = ("cangauge.model", "cangauge.diagnosis", "cangauge.identify", "cangauge.estimation")


def modules(project: Path, folder: str) -> list[Path]:
    found = sorted((project / "src/cangauge" / folder).rglob("*.py"))
    assert len(found) >= 8
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


def test_twin_imports_nothing_under_test(project: Path) -> None:
    for path in modules(project, "extras/validation/twin"):
        bad = {name for name in imported(path) if name.startswith(UNDER_TEST)}
        assert not bad, f"{path.name} imports {bad}"


def test_validation_does_not_import_effects(project: Path) -> None:
    for path in modules(project, "extras/validation"):
        assert not {n for n in imported(path) if n.startswith("cangauge.model.effects")}, path.name


def test_twin_loads_nothing_under_test(project: Path) -> None:
    folder = project / "src/cangauge"
    names = [
        ".".join(("cangauge", *path.relative_to(folder).with_suffix("").parts))
        for path in modules(project, "extras/validation/twin")
        if path.stem != "__init__"
    ]
    code = (
        f"import importlib, sys\n[importlib.import_module(n) for n in {names!r}]\n"
        f"print([n for n in sys.modules if n.startswith({UNDER_TEST!r})])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"


def test_importing_validation_loads_nothing_heavy() -> None:
    code = (
        "import sys, cangauge.extras.validation;print(any('numpy' in name for name in sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "False"
