"""The one way from the core to an extra: by name and on use.

The core imports no extra, so that neither its code nor its dependencies are needed before.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


def extra(place: str) -> Any:
    """Return a function of an extra, named as "report.fit:fit_page"."""
    module, _, name = place.partition(":")
    return getattr(import_module(f"cangauge.extras.{module}"), name)
