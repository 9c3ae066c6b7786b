"""What a user may choose of the estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cangauge.errors import InputError
from cangauge.estimate.anchors import FullCharge, LongRest
from cangauge.logs.log import TemperatureSource
from cangauge.model.delay_line import GAP_S

Method = Literal["ekf", "newton", "coulomb"]

VALID_STD_PCT = 1.5
"""A valid SoC is so certain at least [%], one standard deviation: 19 of 20 lie within 3 %.

On real trips of a vehicle with a fitted model (noise of 1.4 V, a third of it lasting) the filter
settles at 0.9–1.5 % and stays there; 1 % would call most undisturbed driving degraded, and 2 %
would call a SoC valid that is found anew from the voltage, a few minutes after the start.
"""


@dataclass(frozen=True)
class EstimatorSettings:
    """What a user may choose.

    Parameters
    ----------
    method : {"ekf", "newton", "coulomb"}
        Whose SoC is published.
    initial_soc_pct : float, optional
        SoC at the first sample [%]; by default from the first voltages.
    initial_soc_std_pct : float
        Its standard deviation [%].
    valid_std_pct : float
        A SoC with a larger standard deviation is degraded, whatever its inputs [%].
    capacity_ah : float, optional
        Overrides the model's capacity [Ah].
    gap_s : float
        A longer step between current samples is a gap [s].
    temperature_source : str
        What the input's temperature is measured on.
    full_charge : FullCharge, optional
    long_rest : LongRest, optional
        Rules that say what the SoC is at some moments; None is off.
    """

    method: Method = "ekf"
    initial_soc_pct: float | None = None
    initial_soc_std_pct: float = 1.0
    valid_std_pct: float = VALID_STD_PCT
    capacity_ah: float | None = None
    gap_s: float = GAP_S
    temperature_source: TemperatureSource = "unknown"
    full_charge: FullCharge | None = None
    long_rest: LongRest | None = None

    def __post_init__(self) -> None:
        for name, low, high in (
            ("initial_soc_pct", 0.0, 100.0),
            ("initial_soc_std_pct", 0.0, 100.0),
            ("valid_std_pct", 0.01, 100.0),
            ("capacity_ah", 1e-3, 1e5),
            ("gap_s", 1e-3, 3600.0),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"must lie within {low:g} … {high:g}", field=name, value=value)
