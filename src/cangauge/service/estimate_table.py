"""The estimate table, written while the service runs, in memory that does not grow."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from cangauge._io import atomic_path
from cangauge.errors import CangaugeError, InputError
from cangauge.estimate.validity import Estimate, reason_names

NUMBERS: Final = (
    "soc_pct",
    "soc_std_pct",
    "soc_newton_pct",
    "soc_coulomb_pct",
    "voltage_model_v",
    "residual_v",
)
_SCHEMA: Final = pa.schema(
    [
        *((name, pa.float64()) for name in ("time_s", *NUMBERS)),
        ("status", pa.string()),
        ("reasons", pa.string()),
    ]
)
_ROWS_AT_ONCE: Final = 4096


class EstimateWriter:
    """Writes a row per sample, as `cangauge estimate` does; use it in a `with` block.

    All or nothing: the file appears when the block ends well.

    Parameters
    ----------
    path : path-like
        `.parquet` or `.csv`.
    warn : callable, optional
        Takes a line of text when the disk is full or fails: the table is then given up, and
        whoever adds to it goes on. Without it, the OSError is raised.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is absent or not writable.
    """

    def __init__(
        self, path: str | PathLike[str], warn: Callable[[str], None] | None = None
    ) -> None:
        self._path = Path(path)
        if self._path.suffix.lower() not in {".parquet", ".csv"}:
            raise InputError(
                "the suffix says neither CSV nor Parquet",
                source=self._path,
                field="--output",
                value=self._path.suffix,
                cure="name it .csv or .parquet",
            )
        self._rows: list[tuple[Any, ...]] = []
        self._names: dict[int, str] = {}
        self._stack = ExitStack()
        self._sink: Any = None
        self._warn = warn
        self._error: OSError | None = None
        self.rows = 0

    @property
    def failed(self) -> bool:
        """Whether the table was given up; there is then no file."""
        return self._error is not None

    def __enter__(self) -> Self:
        part = self._stack.enter_context(atomic_path(self._path))
        if self._path.suffix.lower() == ".csv":
            # The header by hand: pyarrow always puts quotes around names.
            file = self._stack.enter_context(part.open("wb"))
            file.write((",".join(_SCHEMA.names) + "\n").encode())
            options = pacsv.WriteOptions(include_header=False, quoting_style="none")
            self._sink = pacsv.CSVWriter(file, _SCHEMA, write_options=options)
        else:
            self._sink = pq.ParquetWriter(part, _SCHEMA)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._error is not None:
            # The temporary file goes, and nothing is put in place.
            with suppress(OSError):
                self._sink.close()
            with suppress(OSError, CangaugeError):
                self._stack.__exit__(OSError, self._error, None)
            return
        if kind is None:
            self._write()
        self._sink.close()
        self._stack.__exit__(kind, error, trace)

    def add(self, time_s: float, estimate: Estimate) -> None:
        """Add the row of a sample: its time [s] and the estimate after it."""
        if self._error is not None:
            return
        reasons = int(estimate.reasons)
        words = self._names.get(reasons)
        if words is None:
            words = self._names[reasons] = reason_names(reasons)
        # The numbers of an estimate stand in the table's order, after its time.
        numbers = estimate[1 : 1 + len(NUMBERS)]
        self._rows.append((time_s, *numbers, estimate.status.name.lower(), words))
        self.rows += 1
        if len(self._rows) >= _ROWS_AT_ONCE:
            self._write_or_give_up()

    def _write_or_give_up(self) -> None:
        try:
            self._write()
        except OSError as error:
            if self._warn is None:
                raise
            self._error = error
            self._rows.clear()
            self._warn(f"warning: {self._path}: cannot be written ({error}); given up")

    def _write(self) -> None:
        if not self._rows:
            return
        columns = [
            pa.array(values, field.type, from_pandas=True)
            for field, values in zip(_SCHEMA, zip(*self._rows, strict=True), strict=True)
        ]
        self._sink.write_table(pa.Table.from_arrays(columns, schema=_SCHEMA))
        self._rows.clear()
