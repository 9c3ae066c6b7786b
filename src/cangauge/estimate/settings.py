"""Moments at which the SoC is known otherwise: optional rules, off unless asked for.

What a user may choose of the estimator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

from cangauge.errors import InputError
from cangauge.estimate.state import AnchorState
from cangauge.estimate.validity import Sample
from cangauge.logs.log import TemperatureSource
from cangauge.model.delay_line import GAP_S

# --- Moments at which the SoC is known otherwise: optional rules, off unless asked for


@dataclass(frozen=True)
class FullCharge:
    """The pack is full when its voltage is high and the charging current has tapered off.

    Parameters
    ----------
    voltage_v : float
        Voltage at least this high [V] …
    current_a : float
        … with a current of at most this, either way [A] …
    hold_s : float
        … for so long [s].
    soc_pct, soc_std_pct : float
        What the SoC then is, and its standard deviation [%].
    """

    voltage_v: float
    current_a: float
    hold_s: float = 60.0
    soc_pct: float = 100.0
    soc_std_pct: float = 0.5

    def __post_init__(self) -> None:
        _check("full_charge.voltage_v", self.voltage_v, 0.1, 1e4)
        _check("full_charge.current_a", self.current_a, 0.0, 5e3)
        _check("full_charge.hold_s", self.hold_s, 0.0, 86400.0)
        _check("full_charge.soc_pct", self.soc_pct, 0.0, 100.0)
        _check("full_charge.soc_std_pct", self.soc_std_pct, 0.01, 100.0)


@dataclass(frozen=True)
class LongRest:
    """After a long rest the voltage is the open-circuit voltage: its inverse is the SoC.

    Parameters
    ----------
    after_s : float
        So long without current [s].
    soc_std_pct : float
        Standard deviation of the SoC that the voltage then gives [%].
    """

    after_s: float = 7200.0
    soc_std_pct: float = 2.0

    def __post_init__(self) -> None:
        _check("long_rest.after_s", self.after_s, 60.0, 30.0 * 86400.0)
        _check("long_rest.soc_std_pct", self.soc_std_pct, 0.01, 100.0)


class Anchor(NamedTuple):
    """A SoC that is known otherwise, with its standard deviation [%]."""

    soc_pct: float
    soc_std_pct: float


class AnchorWatch:
    """Says when a rule applies: once each time that its condition comes true.

    Parameters
    ----------
    full, rest : FullCharge, LongRest, optional
        The rules; None is off.
    """

    def __init__(self, full: FullCharge | None, rest: LongRest | None) -> None:
        self._full = full
        self._rest = rest
        self._full_since_s = math.nan
        self._is_full = False
        self._is_rested = False

    def see(self, sample: Sample, rest_s: float, newton_pct: float) -> list[Anchor]:
        """Take a sample; return the anchors that hold from it on.

        Parameters
        ----------
        sample : Sample
        rest_s : float
            How long the pack has rested [s]; NaN if it does not.
        newton_pct : float
            SoC by the inverse at this sample [%]; NaN without one.
        """
        found = []
        if self._full is not None and self._becomes_full(self._full, sample):
            found.append(Anchor(self._full.soc_pct, self._full.soc_std_pct))
        if self._rest is not None and math.isfinite(newton_pct):
            was, self._is_rested = self._is_rested, rest_s >= self._rest.after_s
            if self._is_rested and not was:
                found.append(Anchor(newton_pct, self._rest.soc_std_pct))
        return found

    def _becomes_full(self, rule: FullCharge, sample: Sample) -> bool:
        if not (sample.voltage_v >= rule.voltage_v and abs(sample.current_a) <= rule.current_a):
            if not math.isnan(sample.voltage_v):
                self._full_since_s, self._is_full = math.nan, False
            return False
        if math.isnan(self._full_since_s):
            self._full_since_s = sample.time_s
        was = self._is_full
        self._is_full = sample.time_s - self._full_since_s >= rule.hold_s
        return self._is_full and not was

    def state(self) -> AnchorState:
        """Return what is to be remembered."""
        return AnchorState.model_construct(
            full_since_s=self._full_since_s, is_full=self._is_full, is_rested=self._is_rested
        )

    def restore(self, state: AnchorState) -> None:
        """Go on from a state."""
        self._full_since_s = state.full_since_s
        self._is_full = state.is_full
        self._is_rested = state.is_rested


def _check(field: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InputError(f"must lie within {low:g} … {high:g}", field=field, value=value)


# --- What a user may choose of the estimator

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
