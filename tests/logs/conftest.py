"""The drive of `log_cases` as a log."""

from __future__ import annotations

import numpy as np
import pytest
from log_cases import CURRENT_A, ROWS, SOC_PCT, TIME_S, VOLTAGE_V

from cangauge.logs.log import Log


@pytest.fixture
def drive() -> Log:
    """The drive itself."""
    return Log(TIME_S, CURRENT_A, VOLTAGE_V, np.full(ROWS, 21.5), SOC_PCT, name="drive")
