"""Figures of the documents: kept by the commands that measure them, shown by the pages.

    python benchmarks/figures.py           # brings the tables of all pages up to date

A command that measures calls `publish`; with `--keep` it writes `figures/NAME.json`: date, commit,
command, tables, and a digest of the code and constants that the figures describe, without comments.
A page shows them between `<!-- figures NAME -->` and `<!-- end -->`. Figures whose code has changed
since are marked.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

ROOT: Final = Path(__file__).resolve().parents[1]
FOLDER: Final = Path(__file__).with_name("figures")
SHOWN: Final = re.compile(r"(<!-- figures ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
C_COMMENT: Final = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
OLDER: Final = "**Older than the code**"


def publish(
    name: str, tables: Sequence[Table], describes: Iterable[str], *, keeps: bool, width: int = 130
) -> None:
    """Print the tables of a command, and keep them as the figures of a page.

    Parameters
    ----------
    name : str
        Name of the file, and of the place in a page.
    tables : sequence of rich.table.Table
    describes : iterable of str
        Files and folders of the repository whose change makes the figures older.
    keeps : bool
        Whether to write them.
    width : int
        Of the print.
    """
    for table in tables:
        Console(width=width).print(table)
    if not keeps:
        return
    FOLDER.mkdir(exist_ok=True)
    commit = _git("rev-parse", "--short=8", "HEAD")
    content = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": f"{commit}, changed" if _git("status", "--porcelain", "--", "src") else commit,
        "command": _command(sys.argv),
        "describes": {path: digest(path) for path in describes},
        "tables": [_content(table) for table in tables],
    }
    text = json.dumps(content, indent=1, ensure_ascii=False)
    (FOLDER / f"{name}.json").write_text(f"{text}\n", encoding="utf-8")
    write_pages()


def _content(table: Table) -> dict[str, Any]:
    """Return title, heads and rows of a table as texts."""
    columns = [[Text.from_markup(str(cell)).plain for cell in each.cells] for each in table.columns]
    return {
        "title": str(table.title or ""),
        "columns": [str(each.header) for each in table.columns],
        "rows": [list(row) for row in zip(*columns, strict=True)],
    }


def _command(given: Sequence[str]) -> str:
    """Return a command line as a reader would type it, without the places of this machine."""
    module = sys.modules["__main__"].__spec__
    if module is None:
        script = f"python {Path(given[0]).resolve().relative_to(ROOT)}"
    elif "." in module.parent:
        script = f"python -m {module.parent}"
    else:
        script = f"cd benchmarks && python -m {module.parent}"
    arguments = [each for each in given[1:] if each != "--keep"]
    places = {"--data": "FOLDER", "--cases": "FOLDER", "--peers": "PYTHON"}
    for place, each in enumerate(arguments[:-1]):
        if each in places:
            arguments[place + 1] = places[each]
    return " ".join([script, *arguments])


@functools.cache
def digest(path: str) -> str:
    """Return a digest of a file, or of code and constants in a folder, without comments."""
    place = ROOT / path
    files = [place] if place.is_file() else sorted(place.rglob("*.*"))
    found = hashlib.sha256()
    for file in files:
        if file.suffix in WITHOUT_COMMENTS:
            code = WITHOUT_COMMENTS[file.suffix](file.read_text(encoding="utf-8"))
            found.update(code.encode())
    return found.hexdigest()[:16]


def _python_code(text: str) -> str:
    """Return Python without comments, docstrings and layout."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [each for each in node.body if not _is_text(each)]
    return ast.dump(tree)


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def _c_code(text: str) -> str:
    """Return C without comments and layout."""
    return " ".join(C_COMMENT.sub(" ", text).split())


def _constants(text: str) -> str:
    """Return TOML without comments and layout."""
    return json.dumps(tomllib.loads(text))


WITHOUT_COMMENTS: Final = {
    ".py": _python_code,
    ".c": _c_code,
    ".h": _c_code,
    ".toml": _constants,
    ".json": str,
}


def shown(name: str, *, marks_older: bool = True) -> str:
    """Return what a page shows of kept figures, as Markdown."""
    content: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    lines = [f"{content['date']}, commit {content['commit']}: `{content['command']}`"]
    changed = [path for path, was in content["describes"].items() if digest(path) != was]
    if changed and marks_older:
        lines.append(f"{OLDER}: {', '.join(changed)} changed since.")
    lines += [_markdown(**table) for table in content["tables"]]
    return "\n\n".join(lines) + "\n"


def _markdown(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{title}:\n\n{text}" if title else text


def with_figures(page: str, *, marks_older: bool = True) -> str:
    """Return a page with the kept figures in their places."""
    return SHOWN.sub(
        lambda found: f"{found[1]}{shown(found[2], marks_older=marks_older)}{found[3]}", page
    )


def without_marks(page: str) -> str:
    """Return a page without the marks of older figures."""
    return re.sub(rf"{re.escape(OLDER)}.*\n\n", "", page)


def write_pages() -> None:
    """Bring the figures of all pages up to date."""
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        page = path.read_text(encoding="utf-8")
        if (new := with_figures(page)) != page:
            path.write_text(new, encoding="utf-8")
            sys.stderr.write(f"brought up to date: {path.relative_to(ROOT)}\n")


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


if __name__ == "__main__":
    write_pages()
