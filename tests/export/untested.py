"""Exports whose own tests are not run: the drive of these, which Python estimates, is short."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cangauge.extras.embedded import embedded
from cangauge.model.model_file import Model


def export_untested(model: Model, folder: Path, **options: Any) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(embedded, "GOLDEN_S", 10.0)
        embedded.export_c(model, folder, **options)
