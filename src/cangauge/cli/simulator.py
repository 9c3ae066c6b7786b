"""`--simulated` and `--simulator` of `cangauge gap`: a simulator in the model's place."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge._typing import FloatArray
    from cangauge.cli.options import ReadingOptions
    from cangauge.logs.log import Log


def column_of(log: Log, path: Path, heading: str, reading: ReadingOptions) -> FloatArray:
    """Return the simulated voltage [V] in a column of a log's file, shape (n,).

    Raises
    ------
    InputError
        If the file lacks the column, or a value where the log has a measured voltage.
    """
    import numpy as np

    from cangauge.logs.column_map import ColumnMap, ColumnSpec
    from cangauge.logs.read import open_log

    specs = dict(ColumnMap.of(reading.columns or {}, "--columns").specs)
    specs["voltage"] = ColumnSpec(heading)
    file = open_log(path, columns=ColumnMap(specs, "--simulated"))
    simulated = file.read(temperature_c=reading.temperature)
    if not np.array_equal(simulated.time_s, log.time_s):
        raise InputError(
            f"{len(simulated)} rows have a simulated voltage, {len(log)} a measured one",
            source=path, field="--simulated", value=heading, cure="give both for every row",
        )  # fmt: skip
    return simulated.voltage_v


def load_function(text: str) -> Callable[..., Any]:
    """Return a function named `MODULE:FUNCTION` or `FILE.py:FUNCTION`; may raise InputError."""
    place, _, name = text.rpartition(":")
    problem, cause = "" if place and name else "not a function", None
    function: Any = None
    if not problem:
        try:
            module = _file(Path(place)) if place.endswith(".py") else _module(place)
            function = getattr(module, name, None)
            problem = "" if callable(function) else f"{place} has no function {name}"
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever the user's module does
            problem, cause = f"cannot be imported: {type(error).__name__}: {error}", error
    if problem:
        cure = "give MODULE:FUNCTION or path/to/file.py:FUNCTION"
        raise InputError(problem, field="--simulator", value=text, cure=cure) from cause
    return function  # type: ignore[no-any-return]


def _module(name: str) -> ModuleType:
    """Import a module, also from the working directory."""
    sys.path.insert(0, "")
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove("")


def _file(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
