"""Parameters of which a part runs on every change, and all of them in `make nightly`."""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import Any

import pytest


def nightly_except(in_suite: Container[Any], values: Iterable[Any]) -> list[Any]:
    """Return all values as parameters, marked nightly where they are not of the suite."""
    marks = {True: (), False: (pytest.mark.nightly,)}
    return [pytest.param(value, marks=marks[value in in_suite]) for value in values]
