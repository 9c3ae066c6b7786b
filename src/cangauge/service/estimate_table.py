"""The table of estimates as a file: one row per sample, CSV or Parquet by the suffix."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from cangauge._typing import FloatArray
from cangauge.estimation.offline import EstimateTable

_PLAIN_CSV: Final = pacsv.WriteOptions(include_header=False, quoting_style="none")
"""No cell needs quotes."""


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
        file.write((",".join(columns.column_names) + "\n").encode())  # pyarrow would quote them
        pacsv.write_csv(columns, file, _PLAIN_CSV)
