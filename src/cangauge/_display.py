"""Figures and HTML of results in a notebook, made by `cangauge.extras.report`.

The one place where a lower layer calls the report: by name and on use, so that neither the import
nor bokeh is needed before.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


def figure(function: str, result: object, **options: Any) -> Any:
    """Return the bokeh figure that a function of `report.figures` draws of a result."""
    return getattr(import_module("cangauge.extras.report.figures"), function)(result, **options)


def html(function: str, result: object) -> str:
    """Return the HTML that a function of `report.summary` makes of a result."""
    text: str = getattr(import_module("cangauge.extras.report.summary"), function)(result)
    return text
