"""What `import cangauge` offers: names, cost, examples, data frames."""

from __future__ import annotations

import ast
import doctest
import inspect
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pytest

import cangauge


def test_every_public_name_is_there_and_documented() -> None:
    for name in cangauge.__all__:
        item = getattr(cangauge, name)
        if name != "__version__":
            assert inspect.getdoc(item), name
    assert set(cangauge.__all__) <= set(dir(cangauge))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'foo'"):
        cangauge.foo  # noqa: B018 - the access is what is tested


def test_types_and_names_loaded_on_use_agree() -> None:
    source = Path(inspect.getfile(cangauge)).read_text(encoding="utf-8")
    (typed,) = [node for node in ast.parse(source).body if isinstance(node, ast.If)]
    imported = {
        alias.asname or alias.name
        for node in typed.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert imported == set(cangauge.__all__) - {"__version__"}


def test_importing_loads_nothing_heavy() -> None:
    code = "import sys, cangauge; print([n for n in ('numpy', 'can', 'scipy') if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_examples_of_the_package_run() -> None:
    assert doctest.testmod(cangauge).failed == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "words"),
    [
        ("own_log_to_soc", "mean error of the SoC"),
        ("read_a_diagnosis", "late (time_skew"),
        ("live_bus", "SocEstimate(soc_pct="),
    ],
)
def test_each_notebook_runs(example: str, words: str, project: Path, tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    notebook = nbformat.read(project / "examples" / f"{example}.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, resources=resources).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    printed = "".join(str(output.get("text", output.get("data", ""))) for output in outputs)
    assert words in printed


def test_an_estimate_goes_to_a_data_frame(tmp_path: Path) -> None:
    log = cangauge.simulate(seed=3, hours=0.3, pack="car60").log
    model = cangauge.fit([cangauge.simulate(seed=3, discharge=True, pack="car60").log]).model
    model.save(tmp_path / "pack.json")
    table = cangauge.estimate(log, cangauge.Model.load(tmp_path / "pack.json"))
    arrow = pa.table(table)
    assert arrow.num_rows == len(log)
    assert {"time_s", "soc_pct", "soc_std_pct", "status"} <= set(arrow.column_names)
    again = cangauge.Log.from_dataframe(log.to_arrow())
    assert (again.voltage_v == log.voltage_v).all()
