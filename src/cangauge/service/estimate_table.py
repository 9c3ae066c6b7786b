"""Write the table of estimates while the service runs, in bounded memory."""

from __future__ import annotations

import logging
from contextlib import ExitStack, suppress
from functools import partial
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from cangauge._io import atomic_path
from cangauge._logging import emit
from cangauge.errors import CangaugeError, InputError
from cangauge.estimate.validity import Estimate, reason_names
from cangauge.service.async_writer import AsyncWriter

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
_BLOCK_ROWS: Final = 4096
_ROW_BYTES: Final = 400
"""Memory of a row in Python objects [bytes], roughly."""
_CLOSE_WITHIN_S: Final = 30.0
_LOG = logging.getLogger(__name__)


class EstimateWriter:
    """Write one row per sample, as `cangauge estimate` does; use it in a `with` block.

    All or nothing: the file appears when the block ends without an exception. If the disk is full
    or fails, the table is abandoned with an event, and the service continues.

    Parameters
    ----------
    path : path-like
        `.parquet` or `.csv`.

    Attributes
    ----------
    rows : int
        Number of rows added.
    failed : bool
        True once the table is abandoned; there is then no file.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder is missing or not writable.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self._path = Path(path)
        if self._path.suffix.lower() not in {".parquet", ".csv"}:
            raise InputError(
                "the suffix is neither .csv nor .parquet",
                source=self._path,
                field="--output",
                value=self._path.suffix,
                cure="name it .csv or .parquet",
            )
        self._block: list[tuple[Any, ...]] = []
        self._names: dict[int, str] = {}
        self._stack = ExitStack()
        self._sink: Any = None
        self._writer = AsyncWriter(
            "cangauge-table", max_waiting_bytes=64 << 20, on_error=self._abandon
        )
        self.rows = 0
        self.failed = False

    def __enter__(self) -> Self:
        part = self._stack.enter_context(atomic_path(self._path))
        if self._path.suffix.lower() == ".csv":
            # pyarrow always quotes the names of the header.
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
        if kind is None:
            self._submit()
            self._writer.submit(lambda: None if self.failed else self._sink.close())
        if self._writer.close(_CLOSE_WITHIN_S):
            self._abandon(TimeoutError("the disk is too slow"))
        if kind is None and not self.failed:
            self._stack.__exit__(None, None, None)
            return
        # An exception makes `atomic_path` remove its temporary file.
        with suppress(OSError):
            self._sink.close()
        with suppress(OSError, CangaugeError):
            self._stack.__exit__(kind or OSError, error or OSError(), trace)

    def add(self, time_s: float, estimate: Estimate) -> None:
        """Add the row of a sample: its time [s] and the estimate after it."""
        if self.failed:
            return
        reasons = int(estimate.reasons)
        words = self._names.get(reasons)
        if words is None:
            words = self._names[reasons] = reason_names(reasons)
        # The fields of an estimate are in the table's order, after its time.
        numbers = estimate[1 : 1 + len(NUMBERS)]
        self._block.append((time_s, *numbers, estimate.status.name.lower(), words))
        self.rows += 1
        if len(self._block) >= _BLOCK_ROWS:
            self._submit()

    def _submit(self) -> None:
        block, self._block = self._block, []
        if block and not self._writer.submit(partial(self._write, block), _ROW_BYTES * len(block)):
            self._abandon(TimeoutError("the disk is too slow"))

    def _write(self, block: list[tuple[Any, ...]]) -> None:
        if self.failed:
            return
        columns = [
            pa.array(values, field.type, from_pandas=True)
            for field, values in zip(_SCHEMA, zip(*block, strict=True), strict=True)
        ]
        self._sink.write_table(pa.Table.from_arrays(columns, schema=_SCHEMA))

    def _abandon(self, error: Exception) -> None:
        if not self.failed:
            self.failed = True
            text = f"{self._path}: cannot be written ({error}); the table is abandoned"
            emit(_LOG, logging.WARNING, "file.failed", text)
