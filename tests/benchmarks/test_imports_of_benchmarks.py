"""Every benchmark imports what is there: they run nightly, and a renamed piece shows only then."""

from __future__ import annotations

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path


def test_every_benchmark_imports_what_the_package_has(project: Path) -> None:
    names = {
        (node.module, each.name)
        for path in (project / "benchmarks").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cangauge")
        for each in node.names
    }
    assert len(names) > 100
    for module, name in sorted(names):
        found = hasattr(import_module(module), name) or find_spec(f"{module}.{name}")
        assert found, f"{module} has no {name}"
