"""A log, a part of one and a model for the tests of commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from cangauge.identify.fit import fit
from cangauge.logs.canonical import write_log
from synthetic import synthetic_log


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a full discharge, a part of one, and the model of the first; only to read."""
    folder = tmp_path_factory.mktemp("made")
    full = synthetic_log(hours=1.2, noise_v=0.5, name="full")
    part = synthetic_log(hours=0.4, start_pct=80.0, end_pct=60.0, noise_v=0.5, seed=3, name="part")
    write_log(full, folder / "full.parquet")
    write_log(part, folder / "part.csv")
    fit([full]).model.save(folder / "model.json")
    return folder
