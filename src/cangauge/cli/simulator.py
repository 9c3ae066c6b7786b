"""`--simulated` and `--simulator` of `cangauge gap`: a simulator in the model's place."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from runpy import run_path
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
    cure = "give MODULE:FUNCTION or path/to/file.py:FUNCTION"
    if not (place and name):
        raise InputError("not a function", field="--simulator", value=text, cure=cure)
    sys.path.insert(0, "")  # modules of the working directory too
    try:
        is_file = place.endswith(".py")
        names = run_path(place) if is_file else vars(importlib.import_module(place))
    except (Exception, SystemExit) as error:
        problem = f"cannot be imported: {type(error).__name__}: {error}"
        raise InputError(problem, field="--simulator", value=text, cure=cure) from error
    finally:
        sys.path.remove("")
    if not callable(function := names.get(name)):
        problem = f"{place} has no function {name}"
        raise InputError(problem, field="--simulator", value=text, cure=cure)
    return function  # type: ignore[no-any-return]
