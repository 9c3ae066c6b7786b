"""Imports run down, and the core imports no extra."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

LAYERS = ("cli", "service", "replay", "inspect", "bus", "diagnosis", "estimation", "identify",
          "model", "logs")  # fmt: skip
"""Packages of the core from top to bottom: each imports those after it only."""
ABOVE = {("replay", "service"), ("inspect", "service")}
"""Neighbours that are independent of each other."""


@pytest.fixture(scope="module")
def trees(project: Path) -> dict[str, ast.Module]:
    """Syntax tree of each module of the package by its dotted name."""
    root = project / "src"
    names = {}
    for path in sorted((root / "cangauge").rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        names[name] = ast.parse(path.read_text(encoding="utf-8"))
    return names


def imported(tree: ast.AST, *, at_run_time: bool = False) -> set[str]:
    """Return the names that a module imports anywhere, or when it runs."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    if at_run_time:
        for node in ast.walk(tree):
            is_typing = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
            if is_typing:
                names -= imported(ast.Module(node.body, []))
    return names


def test_the_core_imports_no_extra(trees: dict[str, ast.Module]) -> None:
    for name, tree in trees.items():
        if name == "cangauge" or name.startswith("cangauge.extras"):
            continue  # the package itself has the names for type checkers, lazily
        extras = {each for each in imported(tree) if each.startswith("cangauge.extras")}
        assert not extras, f"{name} imports {extras}"


def test_imports_of_the_core_run_down(trees: dict[str, ast.Module]) -> None:
    for name, tree in trees.items():
        package = name.split(".")[1] if name.count(".") else ""
        if package not in LAYERS:
            continue
        above = LAYERS[: LAYERS.index(package)]
        for other in imported(tree, at_run_time=True):
            parts = other.split(".")
            if parts[0] == "cangauge" and len(parts) > 1 and parts[1] in above:
                assert (package, parts[1]) in ABOVE, f"{name} imports {other}"


def test_no_module_is_in_a_circle_of_imports(trees: dict[str, ast.Module]) -> None:
    graph = {name: loaded_first(tree, trees) - {name} for name, tree in trees.items()}
    while free := [name for name, others in graph.items() if not others & graph.keys()]:
        for name in free:
            del graph[name]
    assert not graph, f"in or above a circle: {sorted(graph)}"


def loaded_first(tree: ast.Module, trees: dict[str, ast.Module]) -> set[str]:
    """Return the modules of the package that are loaded before a module's own names exist."""
    names: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module:
            parts = {f"{node.module}.{alias.name}" for alias in node.names} & trees.keys()
            names |= parts or {node.module}
    return names & trees.keys()


def test_a_class_name_stands_for_one_thing(trees: dict[str, ast.Module]) -> None:
    places: dict[str, list[str]] = {}
    for name, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(name)
    assert {each: names for each, names in places.items() if len(names) > 1} == {}
