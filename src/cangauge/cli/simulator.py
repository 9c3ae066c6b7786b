"""Options of `cangauge gap` that put a simulator in the model's place."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.logs.log import Log

SYNTAX = "give MODULE:FUNCTION or path/to/file.py:FUNCTION"


@dataclass(frozen=True, slots=True)
class SimulatorOptions:
    """`--simulated` and `--simulator`.

    Parameters
    ----------
    column : str, optional
        Heading of the simulated voltage in every log.
    function : str, optional
        `MODULE:FUNCTION`, called with time [s], current [A, positive = discharge], temperature
        [°C] and the SoC at the first row [%]; returns the voltage [V].
    columns : str, optional
        Value of `--columns`, for a table with a simulated voltage.
    temperature_c : float, optional
        Constant temperature [°C].
    capacity_ah : float, optional
        Charge from 100 to 0 % [Ah].

    Raises
    ------
    InputError
        If both are given.
    """

    column: str | None
    function: str | None
    columns: str | None = None
    temperature_c: float | None = None
    capacity_ah: float | None = None

    def __post_init__(self) -> None:
        if self.column is not None and self.function is not None:
            cure = "give --simulated or --simulator"
            raise InputError("two simulators", field="--simulator", value=self.function, cure=cure)

    @property
    def are_given(self) -> bool:
        """Whether a simulator takes the model's place."""
        return self.column is not None or self.function is not None

    def simulation(self, logs: Sequence[Log], paths: Sequence[Path]) -> Any:
        """Return the simulation for `diagnose`, None without one.

        Parameters
        ----------
        logs : sequence of Log
            All logs and references.
        paths : sequence of Path
            Their files.

        Raises
        ------
        InputError
            If the column or function is missing, or the voltages do not fit the log.
        """
        if self.function is not None:
            return load_function(self.function)
        if self.column is None:
            return None
        return {
            log.source or log.name: self._of_column(log, path)
            for log, path in zip(logs, paths, strict=True)
        }

    def _of_column(self, log: Log, path: Path) -> Any:
        import numpy as np

        from cangauge.logs.column_map import ColumnMap, ColumnSpec
        from cangauge.logs.read import open_log

        specs = dict(ColumnMap.of(self.columns or {}, "--columns").specs)
        specs["voltage"] = ColumnSpec(str(self.column))
        file = open_log(path, columns=ColumnMap(specs, "--simulated"))
        simulated = file.read(temperature_c=self.temperature_c)
        if not np.array_equal(simulated.time_s, log.time_s):
            raise InputError(
                f"{len(simulated)} rows have a simulated voltage, {len(log)} a measured one",
                source=path, field="--simulated", value=self.column,
                cure="give both for every row",
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
        raise InputError(problem, field="--simulator", value=text, cure=SYNTAX) from cause
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
