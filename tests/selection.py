"""Parameters of which a part runs on every change, and all of them in `make nightly`."""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import Any

import pytest


def nightly_except(in_suite: Container[Any], values: Iterable[Any]) -> list[Any]:
    """Return all values as parameters, marked nightly where they are not of the suite.

    A tuple is a value for each of several names.
    """
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)),
            marks=() if value in in_suite else pytest.mark.nightly,
        )
        for value in values
    ]
