"""The fitted pseudo-OCV also rises between the points that constrain it."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.extras.validation.cases import draw_scenario
from cangauge.identify import voltage_fit
from cangauge.identify.fit import fit
from cangauge.model.voltage_model import SLOPE_POINTS


def test_a_fall_between_two_points_is_constrained_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Found by gap-check: a simulated day from 98 to 2 % SoC whose fit was refused by the model."""
    world = draw_scenario(27872859)
    logs = [recording.log for recording in world.training]
    found = fit(logs, capacity_ah=world.pack.capacity_ah).voltage_model
    points = np.linspace(*found.soc_range_pct, SLOPE_POINTS)
    assert (found.pseudo_ocv_slope(points) > 0.0).all()
    monkeypatch.setattr(voltage_fit, "REFINED_AT_MOST", 1)
    with pytest.raises(InputError, match="falls with SoC"):
        fit(logs, capacity_ah=world.pack.capacity_ah)
