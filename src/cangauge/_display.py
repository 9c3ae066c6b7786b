"""What results show of themselves in a notebook: figures and HTML, made by `cangauge.report`.

The report draws logs, estimates and diagnoses, and so stands above them. A result that is asked to
draw itself finds it by name, as data frames are found in `_dataframes`; nothing is imported, and no
bokeh is needed, before.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


def figure(function: str, result: object, **options: Any) -> Any:
    """Return the bokeh figure that a function of `report.figures` draws of a result."""
    return getattr(import_module("cangauge.report.figures"), function)(result, **options)


def html(function: str, result: object) -> str:
    """Return the HTML that a function of `report.summary` makes of a result."""
    text: str = getattr(import_module("cangauge.report.summary"), function)(result)
    return text
