"""Export of tables to pandas, polars and any library that reads the Arrow C interface."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np

from cangauge.errors import InputError


class ArrowExport:
    """Base of tables that convert to data frames through Arrow.

    pandas and polars are optional: each is imported by its own method.
    """

    __slots__ = ()

    @abstractmethod
    def to_arrow(self) -> Any:
        """Return a pyarrow.Table."""

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame, unknown numbers NaN; InputError if pandas is missing."""
        _import("pandas")
        return self.to_arrow().to_pandas()

    def to_polars(self) -> Any:
        """Return a polars.DataFrame, unknown numbers null; InputError if polars is missing."""
        return _import("polars").from_arrow(self.to_arrow())

    def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
        """Export the columns through the Arrow PyCapsule interface."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)


def arrow_table(columns: Mapping[str, Any], metadata: Mapping[bytes, str] | None = None) -> Any:
    """Return a pyarrow.Table of arrays; NaN becomes null."""
    pa = import_module("pyarrow")
    arrays = {
        name: pa.array(values, from_pandas=True) if isinstance(values, np.ndarray) else values
        for name, values in columns.items()
    }
    return pa.table(arrays, metadata=metadata)


def _import(package: str) -> Any:
    try:
        return import_module(package)
    except ImportError as error:
        raise InputError(
            f"{package} is not installed", cure=f"install it: pip install {package}"
        ) from error
