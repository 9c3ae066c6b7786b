"""Fixtures that many tests share."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

PROJECT = Path(__file__).resolve().parent.parent
SHARED_DATA = PROJECT.parent / "shared" / "data"

# How long an example takes is a matter of the machine's other work, not of the code.
settings.register_profile("cangauge", deadline=None, max_examples=20)
settings.register_profile("nightly", deadline=None, max_examples=300)
settings.load_profile("cangauge")


@pytest.fixture(scope="session")
def project() -> Path:
    """Top level of the checkout."""
    return PROJECT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the recorded logs; skips the test where they are not beside the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip("recorded logs (../shared/data) are not beside the project")
    return SHARED_DATA
