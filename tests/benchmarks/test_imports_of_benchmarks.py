"""Every benchmark imports what is there: they run nightly, and a renamed piece shows only then."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CODE = """
import importlib, pathlib, sys
sys.path[:0] = ["benchmarks", "."]
for path in sorted(pathlib.Path("benchmarks").glob("*.py")):
    importlib.import_module(path.stem)
for path in sorted(pathlib.Path("benchmarks").glob("*/__main__.py")):
    package = "benchmarks." * (path.parent.name == "weights") + path.parent.name
    importlib.import_module(f"{package}.__main__")
"""


def test_every_benchmark_imports(project: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE], cwd=project, capture_output=True, text=True,
        check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
