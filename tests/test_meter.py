"""What the package holds, counted, and what was added: `python tests/test_meter.py` prints both.

`names.txt` lists the names of the last release. A further name needs an entry in the CHANGELOG that
has it in backticks and says what it replaces: "`--scheduler` replaces …".
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import typer

import cangauge
from cangauge.cli.app import COMMANDS, load_command
from cangauge.service.config import config_keys

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "cangauge"
COUNTED = {tokenize.NAME, tokenize.OP, tokenize.STRING, tokenize.NUMBER}
DISTRIBUTION = re.compile(r"[\w.-]+")


def options_of(command: typer.core.TyperGroup, path: str) -> Iterator[str]:
    """Yield a command with its options, and those of its subcommands."""
    yield f"command {path}"
    for parameter in command.params:
        if parameter.param_type_name == "option":
            yield f"option {path} {max(parameter.opts, key=len)}"
    for name, below in getattr(command, "commands", {}).items():
        yield from options_of(below, f"{path} {name}")


def names() -> Iterator[str]:
    """Yield kind and name of everything that a user can name."""
    for name in COMMANDS:
        yield from options_of(load_command(name), name)
    yield from (f"key {name}" for name in config_keys())
    yield from (f"public cangauge.{name}" for name in cangauge.__all__)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for line in project["dependencies"]:
        yield f"dependency {DISTRIBUTION.match(line)[0]}"
    for lines in project["optional-dependencies"].values():
        yield from (f"extra {DISTRIBUTION.match(line)[0]}" for line in lines)


def counts() -> dict[str, Counter[str]]:
    """Return tokens, classes, module-level numbers and lambdas by package."""
    found: dict[str, Counter[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        folders = path.relative_to(PACKAGE).parts[:-1]
        count = found.setdefault("/".join(folders[:2]) or "cangauge", Counter())
        source = path.read_bytes()
        tokens = tokenize.tokenize(io.BytesIO(source).readline)
        tree = ast.parse(source)
        nodes = list(ast.walk(tree))
        count["tokens"] += sum(token.type in COUNTED for token in tokens)
        count["classes"] += sum(isinstance(node, ast.ClassDef) for node in nodes)
        count["lambdas"] += sum(isinstance(node, ast.Lambda) for node in nodes)
        count["numbers"] += sum(map(holds_number, tree.body))
    return found


def holds_number(statement: ast.stmt) -> bool:
    """Return whether a statement assigns a value with a number in it."""
    return isinstance(statement, ast.Assign | ast.AnnAssign) and any(
        isinstance(node, ast.Constant) and type(node.value) in {int, float}
        for node in ast.walk(statement)
    )


def added(changelog: str) -> list[str]:
    """Return the names beyond `names.txt` for which a CHANGELOG names nothing replaced."""
    known = (ROOT / "tests" / "names.txt").read_text(encoding="utf-8").splitlines()
    entries = [entry for entry in re.split(r"\n(?=- |#)", changelog) if "replaces" in entry]
    return [
        name
        for name in sorted(set(names()) - set(known))
        if not any(f"`{name.split()[-1]}`" in entry for entry in entries)
    ]


def test_what_is_added_names_what_it_replaces() -> None:
    table()
    assert added((ROOT / "CHANGELOG.md").read_text(encoding="utf-8")) == []


def table() -> None:
    """Print the counts of each package and of the whole."""
    columns = ("tokens", "classes", "numbers", "lambdas")
    by_package = counts()
    by_package["all"] = sum(by_package.values(), Counter())
    for package, count in by_package.items():
        print(f"{package:20}", *(f"{count[name]:7} {name}" for name in columns))
    print(Counter(name.split()[0] for name in names()))


if __name__ == "__main__":
    table()
