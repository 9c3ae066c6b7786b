"""The table of estimates as a file: one row per sample, CSV or Parquet by the suffix.

`write_estimates` writes a finished table, `EstimateWriter` row by row while the service runs, in
bounded memory.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from cangauge._files import atomic_path, require_suffix
from cangauge._logging import emit
from cangauge._typing import FloatArray
from cangauge.errors import CangaugeError
from cangauge.estimation.offline import NUMBERS, EstimateTable
from cangauge.service.output import Output
from cangauge.service.worker import Worker
from cangauge.types import Estimate, Reason, Sample, Status, reason_name, reason_names

if TYPE_CHECKING:
    from cangauge.service.run import Service

_SCHEMA: Final = pa.schema(
    [*((name, pa.float64()) for name in NUMBERS), ("status", pa.string()), ("reasons", pa.string())]
)
_PLAIN_CSV: Final = pacsv.WriteOptions(include_header=False, quoting_style="none")
"""No cell needs quotes."""
_BLOCK_ROWS: Final = 4096
_BLOCKS_WAITING: Final = 40
"""Blocks that wait for a slow disk: 64 MB as Python objects; beyond it the table is abandoned."""
_CLOSE_WITHIN_S: Final = 3.0
"""Time limit for writing what is left at the end [s]."""
_LOG = logging.getLogger(__name__)


def write_estimates(path: Path, time_s: FloatArray, table: EstimateTable) -> None:
    """Write one row per sample, as CSV or Parquet by the suffix.

    Parameters
    ----------
    path : Path
        Ends in .csv or .parquet; a device gets CSV.
    time_s : array of shape (n,)
        The samples' own time [s]: a refused sample's estimate is the one before.
    table : EstimateTable
        n estimates; an unknown value becomes empty (CSV) or null (Parquet).
    """
    columns = replace(table, time_s=time_s).to_arrow()
    if path.suffix.lower() == ".parquet":
        pq.write_table(columns, path)
        return
    with path.open("wb") as file:
        _write_header(file)
        pacsv.write_csv(columns, file, _PLAIN_CSV)


def read_estimates(path: Path) -> EstimateTable:
    """Read a Parquet file of estimates, as `write_estimates` or the service wrote it."""
    columns = pq.read_table(path).to_pydict()
    flags = {reason_name(reason): int(reason) for reason in Reason}
    reasons = {
        text: sum(flags[name] for name in text.split("; ") if name)
        for text in set(columns["reasons"])
    }
    numbers: dict[str, Any] = {name: np.array(columns[name], np.float64) for name in NUMBERS}
    return EstimateTable(
        **numbers,
        status=np.array([Status[name.upper()] for name in columns["status"]], dtype=np.int64),
        reasons=np.array([reasons[text] for text in columns["reasons"]], dtype=np.int64),
    )


def _write_header(file: BinaryIO) -> None:
    # pyarrow would quote the names.
    file.write((",".join(_SCHEMA.names) + "\n").encode())


class EstimateWriter(Output):
    """Write one row per sample, as `cangauge estimate` does.

    All or nothing: the file appears at the end. If the disk is full, fails or hangs, the table is
    abandoned with an event, and the service continues.

    Parameters
    ----------
    path : path-like
        `.parquet` or `.csv`; a device gets CSV.

    Attributes
    ----------
    failed : bool
        True once the table is abandoned; there is then no file.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is missing or not writable.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self._path = Path(path)
        require_suffix(self._path, ".csv", ".parquet", field="--output")
        self._block: list[tuple[Any, ...]] = []
        self._names: dict[int, str] = {}
        self.failed = False
        self._stack = ExitStack()
        self._part = part = self._stack.enter_context(atomic_path(self._path))
        self._sink: Any
        if self._path.suffix.lower() == ".parquet":
            self._sink = pq.ParquetWriter(part, _SCHEMA)
        else:
            file = self._stack.enter_context(part.open("wb"))
            _write_header(file)
            self._sink = pacsv.CSVWriter(file, _SCHEMA, write_options=_PLAIN_CSV)
        self._worker = Worker("cangauge-table", self._abandon, _BLOCKS_WAITING)

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        """Add the row of a sample and the estimate after it."""
        if self.failed:
            return
        reasons = int(estimate.reasons)
        words = self._names.get(reasons)
        if words is None:
            words = self._names[reasons] = reason_names(reasons)
        # The fields of an estimate are in the table's order; its time is that of the sample.
        numbers = estimate[1 : len(NUMBERS)]
        self._block.append((sample.time_s, *numbers, estimate.status.name.lower(), words))
        if len(self._block) >= _BLOCK_ROWS:
            self._submit()

    def close(self) -> None:
        """Write what is left, and give the file its name."""
        self._submit()
        self._worker.submit(self._finish)
        if not self._worker.close(_CLOSE_WITHIN_S):
            self._fail(TimeoutError("the disk is too slow"))
            with suppress(OSError):
                self._part.unlink()

    def _submit(self) -> None:
        block, self._block = self._block, []
        if block and not self.failed and not self._worker.submit(partial(self._write, block)):
            self._fail(TimeoutError("the disk is too slow"))

    def _write(self, block: list[tuple[Any, ...]]) -> None:
        if not self.failed:
            columns = [
                pa.array(values, field.type, from_pandas=True)
                for field, values in zip(_SCHEMA, zip(*block, strict=True), strict=True)
            ]
            self._sink.write_table(pa.Table.from_arrays(columns, schema=_SCHEMA))

    def _finish(self) -> None:
        if not self.failed:
            self._sink.close()
            self._stack.close()
            return
        # An exception makes `atomic_path` remove its temporary file.
        with suppress(OSError):
            self._sink.close()
        with suppress(OSError, CangaugeError):
            self._stack.__exit__(OSError, OSError(), None)

    def _abandon(self, error: Exception) -> None:
        if not self.failed:
            self._fail(error)
            self._finish()

    def _fail(self, error: Exception) -> None:
        if not self.failed:
            self.failed = True
            text = f"{self._path}: cannot be written ({error}); the table is abandoned"
            emit(_LOG, logging.WARNING, "file.failed", text)


def make_output(service: Service) -> EstimateWriter:
    """Return the table that a service's configuration asks for."""
    return EstimateWriter(str(service.config.output))
