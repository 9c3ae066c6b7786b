"""What `import cangauge` offers: names, cost, examples, data frames."""

from __future__ import annotations

import ast
import doctest
import inspect
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import cangauge
from cangauge.logs.canonical import write_log


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


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("example", "words"),
    [
        ("own_log_to_soc", "mean error of the SoC"),
        ("read_a_diagnosis", "late (time_skew"),
        ("live_bus", "'soc_pct': "),
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


@pytest.fixture(scope="module")
def drives() -> list[cangauge.Log]:
    return [cangauge.simulate(seed=1, drive=number, hours=0.4).log for number in (1, 2)]


@pytest.fixture(scope="module")
def fitted(drives: list[cangauge.Log]) -> cangauge.Identification:
    return cangauge.fit(drives, capacity_ah=60.0)


def test_a_log_and_a_model_are_taken_in_every_form(
    drives: list[cangauge.Log], fitted: cangauge.Identification, tmp_path: Path
) -> None:
    log, path = drives[0], tmp_path / "pack.json"
    fitted.model.save(path)
    drive = tmp_path / "drive.parquet"
    write_log(log, drive)
    plain = cangauge.estimate(log, fitted.model).soc_pct
    for same in (log.to_arrow(), drive, str(drive)):
        assert np.array_equal(cangauge.estimate(same, fitted.model).soc_pct, plain, equal_nan=True)
    for model in (fitted, path, str(path)):
        assert np.array_equal(cangauge.estimate(log, model).soc_pct, plain, equal_nan=True)
        assert isinstance(cangauge.Estimator(model), cangauge.Estimator)
    for same in (drive, log.to_arrow()):
        assert cangauge.fit(same, capacity_ah=60.0).model.capacity_ah == 60.0


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda log, model: cangauge.estimate(model, log), "not a log .got 'Model'.; give a Log"),
        (lambda log, _: cangauge.estimate(log, 7), "model: not a model .got 'int'.; give a Model"),
        (lambda log, _: cangauge.estimate(log, log), "not a model .got 'Log'"),
        (lambda *_: cangauge.fit(7), "not a log .got 'int'"),
        (lambda *_: cangauge.fit([]), "no log given"),
        (lambda log, _: cangauge.fit(log, capacity_ah="60"), "capacity_ah: not a number .got '60'"),
        (lambda log, _: cangauge.fit(log, capacity_ah=[60]), "capacity_ah: not a number"),
        (lambda log, _: cangauge.fit(log, chemistry="x"), "chemistry: not a known value .*oxide"),
        (lambda log, _: cangauge.fit(log, equation="x"), "equation: not a known value .*knots"),
        (lambda _, model: cangauge.diagnose([], model), "logs: no log to diagnose"),
        (lambda log, _: cangauge.diagnose(log, 7), "not a model .got 'int'"),
        (lambda log, m: cangauge.estimate(log, m, method="x"), "method: not a known value .*ekf"),
        (lambda log, m: cangauge.estimate(log, m, initial_soc_pct="x"), "soc_pct: not a number"),
        (lambda *_: cangauge.simulate(seed="x"), "seed: not a number"),
        (lambda log, _: cangauge.read_log(log), "not a path .got 'Log'.; give the path of a file"),
        (lambda *_: cangauge.Model.load(7), "not a path .got 'int'"),
        (lambda *_: cangauge.Estimator(7), "not a model .got 'int'"),
        (lambda *_: cangauge.Log.from_dataframe(7), "not a log .got 'int'"),
        (lambda *_: cangauge.Log(["a"], [1], [2], [3]), "holds values that are not numbers"),
    ],
)
def test_a_wrong_type_is_one_line_with_a_cure(
    drives: list[cangauge.Log], fitted: cangauge.Identification, call: Any, words: str
) -> None:
    with pytest.raises(cangauge.InputError, match=words) as caught:
        call(drives[0], fitted.model)
    assert "\n" not in str(caught.value)


def test_errors_in_python_name_its_arguments(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("Time,Current,Voltage\n0,1,380000\n1,2,380000\n")
    with pytest.raises(cangauge.InputError, match=r"give a constant: temperature_c=25$"):
        cangauge.read_log(path)
    with pytest.raises(cangauge.InputError, match=r"unit: columns='voltage=Voltage\[mV\]'"):
        cangauge.read_log(path, temperature_c=20.0)
    path.write_text("Time,Current,Voltage\n0,1,380\n1,2,380\n")
    with pytest.raises(cangauge.InputError, match=r"^temperature_c: must lie within .*got 293.0.$"):
        cangauge.read_log(path, temperature_c=293.0)


def test_a_fit_is_shown_in_ten_lines(fitted: cangauge.Identification) -> None:
    low, high = fitted.model.range.soc_pct
    assert 5 < len(repr(fitted).splitlines()) <= 10
    for text in (repr(fitted), fitted._repr_html_()):
        assert f"{low:.1f} … {high:.1f} %" in text


def test_an_estimate_shows_itself_in_a_line(
    drives: list[cangauge.Log], fitted: cangauge.Identification
) -> None:
    table = cangauge.estimate(drives[0], fitted)
    assert repr(table).startswith(f"<EstimateTable: {len(drives[0])} samples, ")
    assert f"… {table.soc_pct[-1]:.1f} %" in repr(table)
