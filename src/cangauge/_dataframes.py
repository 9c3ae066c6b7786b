"""Export of tables to pandas, polars and any library that reads the Arrow C interface."""

from __future__ import annotations

from abc import abstractmethod
from importlib import import_module
from typing import Any

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


def _import(package: str) -> Any:
    try:
        return import_module(package)
    except ImportError as error:
        cure = f"install it: pip install {package}"
        raise InputError(f"{package} is not installed", cure=cure) from error
