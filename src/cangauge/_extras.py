"""The one way from the core to an extra: by name and on use.

The core imports no extra, so that neither its code nor its dependencies are needed before.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from cangauge.errors import InputError

_PACKAGES: Final = {
    "fleet": ("distributed",),
    "live": ("bokeh", "jinja2", "tornado"),
    "metrics": ("prometheus_client", "tornado"),
    "mqtt": ("paho",),
    "report": ("bokeh", "jinja2"),
}
"""The packages that each extra imports."""


def extra(place: str) -> Any:
    """Return a function of an extra, named as "report.fit:fit_page"; may raise InputError."""
    module, _, name = place.partition(":")
    require_extra(module.partition(".")[0])
    return getattr(import_module(f"cangauge.extras.{module}"), name)


def require_extra(name: str, field: str | None = None) -> None:
    """Raise InputError if the packages of an extra are not installed.

    Parameters
    ----------
    name : str
        As in `pip install 'cangauge[NAME]'`.
    field : str, optional
        Option or key that needs it.
    """
    for package in _PACKAGES[name]:
        if find_spec(package) is None:
            raise InputError(
                f"needs {package}, which is not installed",
                field=field,
                cure=f"pip install 'cangauge[{name}]'",
            )
