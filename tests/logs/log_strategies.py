"""Random valid logs."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cangauge.logs.log import TEMPERATURE_SOURCES, Log


@st.composite
def logs(draw: st.DrawFn) -> Log:
    rows = draw(st.integers(1, 20))

    def channel(low: float, high: float) -> np.ndarray:
        return draw(hnp.arrays(float, rows, elements=st.floats(low, high)))

    soc = draw(st.none() | st.just(channel(2.0, 100.0)))
    if soc is not None:
        soc[draw(hnp.arrays(bool, rows))] = np.nan
    return Log(
        time_s=draw(st.floats(-1e3, 1e9)) + np.cumsum(channel(1e-3, 50.0)),
        current_a=channel(-2000.0, 2000.0),
        voltage_v=channel(1.0, 1500.0),
        temperature_c=channel(-60.0, 61.0),
        soc_pct=soc,
        temperature_source=draw(st.sampled_from(TEMPERATURE_SOURCES)),
    )
