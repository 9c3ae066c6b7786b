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

from cangauge.cli.output import note
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.diagnosis.simulator import Run, SimulatorDiagnosis
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
            raise InputError(
                "two simulators", field="--simulator", value=self.function,
                cure="give --simulated or --simulator",
            )  # fmt: skip

    @property
    def are_given(self) -> bool:
        """Whether a simulator takes the model's place."""
        return self.column is not None or self.function is not None

    def note_model(self, model: Path | None) -> None:
        """Print on stderr what a model is for, beside a simulator."""
        if self.are_given:
            note(
                f"note: the simulator is diagnosed; {model} is taken as the voltage model of its"
                " output, in place of one identified on it"
            )

    def run(self, log: Log, path: Path) -> Run:
        """Return a log with its simulated voltage.

        Parameters
        ----------
        log : Log
        path : Path
            File of the log.

        Raises
        ------
        InputError
            If the column or function is missing, or the voltages do not fit the log.
        """
        from cangauge.diagnosis.simulator import Run, start_of

        if self.column is not None:
            return Run(log, self._of_column(log, path))
        return Run(log, self._of_function(log, start_of(log)))

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

    def _of_function(self, log: Log, start_pct: float) -> Any:
        import numpy as np

        function = load_function(str(self.function))
        try:
            volts = function(log.time_s, log.current_a, log.temperature_c, start_pct)
            return np.asarray(volts, dtype=np.float64)
        except (Exception, SystemExit) as error:
            raise InputError(
                f"raised {type(error).__name__}: {error}",
                source=log.source or log.name, field="--simulator", value=self.function,
                cure="call it with (time_s, current_a, temperature_c, initial_soc_pct)",
            ) from error  # fmt: skip


def load_function(text: str) -> Callable[..., Any]:
    """Return a function named `MODULE:FUNCTION` or `FILE.py:FUNCTION`.

    Raises
    ------
    InputError
        If the module cannot be imported or has no such function.
    """
    place, _, name = text.rpartition(":")
    if not place or not name:
        raise InputError("not a function", field="--simulator", value=text, cure=SYNTAX)
    try:
        module = _file(Path(place)) if place.endswith(".py") else _module(place)
    except (Exception, SystemExit) as error:
        raise InputError(
            f"cannot be imported: {type(error).__name__}: {error}",
            field="--simulator",
            value=text,
            cure=SYNTAX,
        ) from error
    function = getattr(module, name, None)
    if not callable(function):
        raise InputError(
            f"{place} has no function {name}", field="--simulator", value=text, cure=SYNTAX
        )
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


def corrected_paths(logs: Sequence[Path], folder: Path | None) -> list[Path]:
    """Return where `--corrected` writes each log, `FOLDER/NAME.corrected.csv`."""
    if folder is None:
        return []
    return [folder / f"{log.stem}.corrected.csv" for log in logs]


def write_corrected(found: SimulatorDiagnosis, logs: list[Path], folder: Path) -> list[Path]:
    """Write each diagnosed log with the simulated and the corrected voltage; return the files."""
    from cangauge.logs.canonical import write_table

    folder.mkdir(parents=True, exist_ok=True)
    written = corrected_paths(logs, folder)
    for run, path in zip(found.runs, written, strict=True):
        columns = {
            "time_s": run.log.time_s,
            "current_a": run.log.current_a,
            "voltage_v": run.log.voltage_v,
            "temperature_c": run.log.temperature_c,
            "soc_pct": run.log.soc_pct,
            "simulated_v": run.simulated_v,
            "corrected_v": found.corrected_v(run),
        }
        write_table({name: values for name, values in columns.items() if values is not None}, path)
    return written
