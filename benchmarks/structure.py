"""Measure the structure of the code: size, coupling, documentation, and the path of one frame.

    python benchmarks/structure.py                       # this checkout
    python benchmarks/structure.py --data ../shared/data # and trace one frame and one diagnosis

Tracing runs `cangauge estimate` on a Leaf capture and `cangauge gap` on two real trips in this
process and counts the calls of functions under `src`. To measure another checkout, run its own
Python with `--root`; the functions that handle a frame and start a diagnosis are options, because
their names differ between versions.
"""

from __future__ import annotations

import argparse
import ast
import statistics
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

LAYERS = (
    "logs", "model", "identify", "estimation", "diagnosis", "bus", "service", "replay", "inspect",
    "cli", "extras",
)  # fmt: skip
"""Packages from the lowest to the highest, above the root files; an import of a higher one by a
lower one is upward."""


@dataclass
class Module:
    """One source file."""

    name: str
    path: Path
    tree: ast.Module
    lines: int
    docstring_lines: int
    blank_lines: int

    @classmethod
    def of(cls, name: str, path: Path) -> Module:
        """Read and parse one file."""
        text = path.read_text(encoding="utf-8")
        tree, lines = ast.parse(text), text.splitlines()
        documented: set[int] = set()
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            for item in body if isinstance(body, list) else []:
                if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant):
                    documented |= set(range(item.lineno, (item.end_lineno or item.lineno) + 1))
        blank = sum(
            1
            for number, line in enumerate(lines, 1)
            if number not in documented and (not line.strip() or line.strip().startswith("#"))
        )
        return cls(name, path, tree, len(lines), len(documented), blank)


def read_modules(folder: Path, prefix: str = "") -> dict[str, Module]:
    """Return all modules under a folder by dotted name."""
    found = {}
    for path in sorted(folder.rglob("*.py")):
        name = ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix("__init__")
        name = f"{prefix}{name}".strip(".")
        found[name] = Module.of(name, path)
    return found


def imports_of(modules: dict[str, Module]) -> dict[str, set[str]]:
    """Return the modules of the package that each module imports, lazy imports included."""
    result: dict[str, set[str]] = {}
    for name, module in modules.items():
        result[name] = set()
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cangauge"):
                for alias in node.names:
                    full = f"{node.module}.{alias.name}"
                    result[name].add(full if full in modules else str(node.module))
    return result


def layer_of(name: str) -> int:
    """Return a module's layer; −1: a root file. What hands the names on is above all."""
    top = name.removeprefix("cangauge").strip(".").split(".")[0]
    if top in LAYERS:
        return LAYERS.index(top)
    return -1 if top not in {"", "__main__"} else len(LAYERS)


def upward_imports(modules: dict[str, Module]) -> list[tuple[str, str]]:
    """Return the imports of a higher package by a lower one."""
    return sorted(
        (name, other)
        for name, others in imports_of(modules).items()
        for other in others
        if layer_of(other) > layer_of(name)
    )


def public_names(modules: dict[str, Module]) -> int:
    """Return the number of top-level functions and classes without a leading underscore."""
    return sum(
        1
        for name, module in modules.items()
        for node in module.tree.body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and not node.name.startswith("_")
        and not any(part.startswith("_") and part != "__init__" for part in name.split("."))
    )


def constants_of(module: Module) -> int:
    """Return how many names of a module, in capitals, stand for numbers written there."""
    count = 0
    for node in module.tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [x.id for each in targets for x in ast.walk(each) if isinstance(x, ast.Name)]
            if all(map(str.isupper, names)) and _is_number(node.value):
                count += len(names)
    return count


def _is_number(value: ast.expr) -> bool:
    try:
        found = ast.literal_eval(value)
    except ValueError:  # 1.0 / 3.0
        return isinstance(value, ast.BinOp) and _is_number(value.left) and _is_number(value.right)
    values = found if isinstance(found, tuple) else (found,)
    return bool(values) and all(type(each) in {int, float} for each in values)


def packages(modules: dict[str, Module]) -> Iterator[tuple[str, str]]:
    """Yield each package, or extra, with its modules, lines and numeric constants."""
    found: dict[str, list[Module]] = defaultdict(list)
    for name, module in modules.items():
        parts = name.split(".")[1:]
        deep = 2 if parts[:1] == ["extras"] and len(parts) > 1 else 1
        is_file = module.path.name != "__init__.py" and len(parts) == 1
        found["root files" if is_file or not parts else " ".join(parts[:deep])].append(module)
    for name, of_it in sorted(found.items()):
        lines, constants = sum(m.lines for m in of_it), sum(map(constants_of, of_it))
        yield name, f"{len(of_it)} modules, {lines} lines, {constants} numeric constants"


def docstring_coverage(modules: dict[str, Module]) -> dict[str, tuple[int, int]]:
    """Return (present, wanted) by numpydoc section, over public functions and methods."""
    counts: dict[str, list[int]] = {
        key: [0, 0] for key in ("summary", "Parameters", "Returns", "Raises")
    }

    def see(node: ast.FunctionDef) -> None:
        text = ast.get_docstring(node) or ""
        arguments = [a for a in (*node.args.args, *node.args.kwonlyargs) if a.arg != "self"]
        returns = node.returns is not None and not (
            isinstance(node.returns, ast.Constant) and node.returns.value is None
        )
        raises = any(isinstance(item, ast.Raise) for item in ast.walk(node))
        wanted = {
            "summary": True,
            "Parameters": len(arguments) > 1,
            "Returns": returns and len(arguments) > 1,
            "Raises": raises,
        }
        for key, is_wanted in wanted.items():
            if is_wanted:
                counts[key][1] += 1
                counts[key][0] += bool(text) if key == "summary" else f"{key}\n---" in text

    for module in modules.values():
        for node in module.tree.body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                see(node)
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                for item in node.body:
                    if isinstance(item, ast.FunctionDef) and not item.name.startswith("_"):
                        see(item)
    return {key: (have, want) for key, (have, want) in counts.items()}


@dataclass
class Trace:
    """Calls of the package's own functions inside each call of one entry function."""

    source: Path
    entry: str
    needs: str = ""
    """Keep only entries that call a function with this ending."""
    calls: list[list[tuple[str, str]]] = field(default_factory=list)
    _open: list[tuple[str, str]] | None = None
    _entered: FrameType | None = None
    _known: dict[Any, str | None] = field(default_factory=dict)

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """Record one event of `sys.setprofile`."""
        if event not in {"call", "return"}:
            return
        code = frame.f_code
        if code not in self._known:
            path = code.co_filename
            inside = path.startswith(str(self.source))
            self._known[code] = path[len(str(self.source)) + 1 :] if inside else None
        place = self._known[code]
        if place is None or code.co_name.startswith("<"):
            return
        name = f"{place}:{code.co_qualname}"
        if self._open is None:
            if event == "call" and name == self.entry:
                self._open, self._entered = [(place, name)], frame
        elif event == "call":
            self._open.append((place, name))
        elif frame is self._entered:
            if any(name.endswith(self.needs) for _, name in self._open):
                self.calls.append(self._open)
            self._open = self._entered = None

    def figures(self, at: Callable[[list[int]], float]) -> dict[str, float]:
        """Return calls, functions, files and changes of file of an entry, by a statistic."""
        return {
            "calls": at([len(one) for one in self.calls]),
            "functions": at([len({name for _, name in one}) for one in self.calls]),
            "files": at([len({place for place, _ in one}) for one in self.calls]),
            "changes of file": at(
                [sum(a[0] != b[0] for a, b in pairwise(one)) for one in self.calls]
            ),
        }


@contextmanager
def profiled(trace: Trace) -> Iterator[None]:
    """Trace this thread while the block runs, and discard its output."""
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        sys.setprofile(trace)
        try:
            yield
        finally:
            sys.setprofile(None)


def run_command(*arguments: object) -> None:
    """Run one command of the command line in this process."""
    from cangauge.cli.app import main  # noqa: PLC0415 - the checkout under test

    before, sys.argv = sys.argv, ["cangauge", *map(str, arguments)]
    try:
        main()
    except SystemExit as ended:
        if ended.code:
            raise RuntimeError(f"cangauge {arguments[0]} exited with {ended.code}") from None
    finally:
        sys.argv = before


def trace_frames(root: Path, data: Path, entry: str) -> Trace:
    """Trace every frame of a Leaf capture through the offline path of the service."""
    trace = Trace(root / "src/cangauge", entry, needs="Pipeline._estimate")
    model = root / "replay/leaf2012_published_model.json"
    with tempfile.TemporaryDirectory() as folder:
        arguments = ("-m", model, "-o", Path(folder) / "soc.csv", "--vehicle", "leaf_ze0")
        with profiled(trace):
            run_command("estimate", data / "leaf_can/ZE0w24kWhstock.log.gz", *arguments)
    return trace


def trace_trips(root: Path, data: Path, fit_entry: str, diagnosis_entry: str) -> list[Trace]:
    """Trace a fit of three summer trips, and the diagnosis of a winter trip with two of them."""
    fit, diagnosis = (Trace(root / "src/cangauge", entry) for entry in (fit_entry, diagnosis_entry))
    trips = data / "bmw_i3"
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model.json"
        summer = [trips / f"TripA{number}.csv.gz" for number in ("11", "13", "15")]
        with profiled(fit):
            run_command("fit", *summer, "--capacity-ah", "60", "-o", model)
        with profiled(diagnosis):
            run_command(
                "gap", trips / "TripB03.csv.gz", "-m", model, "--reference", summer[0],
                "--reference", summer[1],
            )  # fmt: skip
    return [fit, diagnosis]


def traced(root: Path, data: Path, options: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """Yield what a frame, a fit and a diagnosis go through."""
    frames = trace_frames(root, data, options.frame_entry)
    fit, diagnosis = trace_trips(root, data, options.fit_entry, options.diagnosis_entry)
    for name, trace, at in (
        ("a frame that completes a sample, median", frames, statistics.median),
        ("a frame that completes a sample, largest", frames, max),
        ("a fit of three trips", fit, max),
        ("a diagnosis", diagnosis, max),
    ):
        yield name, ", ".join(f"{value:.0f} {key}" for key, value in trace.figures(at).items())


def main() -> None:
    """Print the figures as a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[1])
    parser.add_argument("--data", type=Path, help="folder of recorded logs; without: no traces")
    parser.add_argument("--frame-entry", default="service/pipeline.py:Pipeline.handle")
    parser.add_argument("--fit-entry", default="identify/fit.py:fit")
    parser.add_argument("--diagnosis-entry", default="diagnosis/diagnose.py:diagnose")
    parser.add_argument("--list", action="store_true", help="also list upward imports")
    options = parser.parse_args()
    root = options.root.resolve()

    rows: list[tuple[str, str]] = []
    for folder in ("src/cangauge", "tests", "benchmarks"):
        found = read_modules(root / folder).values()
        total, documented = sum(m.lines for m in found), sum(m.docstring_lines for m in found)
        blank = sum(m.blank_lines for m in found)
        code = total - documented - blank
        rows.append((f"{folder}: modules", f"{len(found)}"))
        rows.append(
            (
                f"{folder}: lines (code, docstrings, blank and comments)",
                f"{total} ({code}, {documented}, {blank})",
            )
        )
    modules = read_modules(root / "src/cangauge", "cangauge.")
    rows += packages(modules)
    importers: Counter[str] = Counter()
    by: dict[str, set[str]] = defaultdict(set)
    for name, others in imports_of(modules).items():
        for other in others:
            by[other].add(name)
    importers.update({name: len(by[name]) for name in modules})
    rows.append(
        ("modules imported by exactly one other", f"{sum(1 for c in importers.values() if c == 1)}")
    )
    upward = upward_imports(modules)
    rows.append(("upward imports", f"{len(upward)}"))
    rows.append(("public functions and classes", f"{public_names(modules)}"))
    for key, (have, want) in docstring_coverage(modules).items():
        rows.append((f"docstrings of public functions: {key}", f"{have} of {want}"))
    rows.append(("README: lines", f"{len((root / 'README.md').read_text().splitlines())}"))
    if options.data is not None:
        rows += traced(root, options.data.resolve(), options)
    print("| | |\n|---|---|")
    for label, value in rows:
        print(f"| {label} | {value} |")
    if options.list:
        for name, other in upward:
            print(f"{name} imports {other}")


if __name__ == "__main__":
    main()
