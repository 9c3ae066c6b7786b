"""The fitted pseudo-OCV rises between the points that hold it, too."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.identify import voltage_fit
from cangauge.identify.fit import fit
from cangauge.identify.rows import FitOptions
from cangauge.model.voltage_model import SLOPE_POINTS
from cangauge.validation.cases import draw_scenario


def test_a_curve_that_falls_between_two_points_is_held_there_as_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Found by gap-check: a simulated day from 98 to 2 % SoC whose fit was refused by the model."""
    world = draw_scenario(27872859)
    logs = [recording.log for recording in world.training]
    options = FitOptions(capacity_ah=world.pack.capacity_ah)
    found = fit(logs, options).voltage_model
    points = np.linspace(*found.soc_range_pct, SLOPE_POINTS)
    assert (found.pseudo_ocv_slope(points) > 0.0).all()
    monkeypatch.setattr(voltage_fit, "REFINED_AT_MOST", 1)
    with pytest.raises(InputError, match="falls with SoC"):
        fit(logs, options)
