"""The file of estimates: one row a sample, as CSV or Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from cangauge.errors import InputError
from cangauge.estimate.offline import EstimateTable
from cangauge.estimate.types import Status
from cangauge.report.words import reason_names
from cangauge.service.table import NUMBERS

SUFFIXES = (".csv", ".parquet")


def check_suffix(output: Path) -> None:
    """Raise InputError if the name says neither CSV nor Parquet."""
    if output.suffix.lower() not in SUFFIXES:
        raise InputError(
            "the suffix says neither CSV nor Parquet",
            source=output,
            field="--output",
            value=output.suffix,
            cure="name it .csv or .parquet",
        )


def write_estimates(path: Path, time_s: NDArray[np.float64], table: EstimateTable) -> None:
    """Write estimates; the suffix says how.

    Parameters
    ----------
    path : Path
        Ends in .csv or .parquet.
    time_s : array of shape (n,)
        The samples' own time [s]: a refused sample's estimate is the one before.
    table : EstimateTable
        n estimates; what is not known becomes empty (CSV) or null (Parquet).
    """
    columns: dict[str, Any] = {"time_s": pa.array(time_s)}
    columns |= {name: pa.array(getattr(table, name), from_pandas=True) for name in NUMBERS}
    columns["status"] = pa.array([Status(value).name.lower() for value in table.status.tolist()])
    words = {value: reason_names(value) for value in np.unique(table.reasons).tolist()}
    columns["reasons"] = pa.array([words[value] for value in table.reasons.tolist()])
    if path.suffix.lower() == ".parquet":
        pa.parquet.write_table(pa.table(columns), path)
        return
    with path.open("wb") as file:
        # The header by hand: pyarrow always puts quotes around names; no cell needs any.
        file.write((",".join(columns) + "\n").encode())
        plain = pa.csv.WriteOptions(include_header=False, quoting_style="none")
        pa.csv.write_csv(pa.table(columns), file, plain)
