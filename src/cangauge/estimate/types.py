"""What goes into the estimator and what comes out of it."""

from __future__ import annotations

import enum
from typing import NamedTuple


class Sample(NamedTuple):
    """One (time, current, voltage, temperature), paired on bus time.

    `voltage_v` or `temperature_c` may be NaN where that signal is missing: charge is still
    counted, and the status says so.
    """

    time_s: float
    """Bus time [s]."""
    current_a: float
    """Pack current [A], positive = discharge."""
    voltage_v: float
    """Pack voltage [V]."""
    temperature_c: float
    """Temperature [°C]."""


class Status(enum.IntEnum):
    """How far an estimate can be trusted; the numbers are those of the published frame."""

    INITIALISING = 0
    VALID = 1
    DEGRADED = 2
    INVALID = 3


class Reason(enum.IntFlag):
    """Why the status is not plainly valid; bit numbers are those of the published frame."""

    NONE = 0
    DELAY_LINE_FILLING = 1 << 0
    """Less than the longest delay of gap-free current has been seen."""
    CURRENT_GAP = 1 << 1
    """Current was missing for longer than the allowed gap: charge is uncertain."""
    VOLTAGE_MISSING = 1 << 2
    TEMPERATURE_MISSING = 1 << 3
    VOLTAGE_OUTSIDE_MODEL = 1 << 4
    """Newton: the voltage lies outside the model's range; SoC is clipped."""
    SOC_OUTSIDE_MODEL = 1 << 5
    """SoC lies outside what the model was identified on: extrapolated, bounded."""
    TEMPERATURE_OUTSIDE_MODEL = 1 << 6
    CURRENT_OUTSIDE_MODEL = 1 << 7
    TEMPERATURE_SOURCE_MISMATCH = 1 << 8
    """The bus's temperature is not measured where the model's was."""
    INNOVATION_LARGE = 1 << 9
    """Voltage and prediction disagree persistently: the uncertainty was inflated, or the filter,
    to which every voltage was an outlier for minutes, was started anew."""
    NO_INITIAL_SOC = 1 << 10
    """No initial SoC is known yet."""
    INPUT_STALE = 1 << 11
    """No wanted frame within the time-out."""
    IMPLAUSIBLE_INPUT = 1 << 12
    """A value or sample was refused: not finite, out of its range, or changed too fast."""
    PROTECTION_FAILED = 1 << 13
    """Frames were refused, several in a row: CRC wrong, counter standing still, or too short."""
    SIGNAL_STUCK = 1 << 14
    """A signal stands still while another one proves that it should move."""
    CURRENT_MISSING = 1 << 15
    """No current within its time-out, or none that is believed: charge is not counted."""
    SOC_UNCERTAIN = 1 << 16
    """The standard deviation is larger than a valid SoC may have."""


class Estimate(NamedTuple):
    """The estimate after one sample."""

    time_s: float
    """Bus time of the sample [s]."""
    soc_pct: float
    """State of charge of the chosen method [%], within 0–100; NaN while unknown."""
    soc_std_pct: float
    """Its standard deviation [%]; NaN while unknown."""
    soc_newton_pct: float
    """State of charge by inverse of the voltage model [%]; NaN while unknown."""
    soc_coulomb_pct: float
    """State of charge by Coulomb counting alone [%]; NaN while unknown."""
    voltage_model_v: float
    """Voltage that the model predicts at `soc_pct` [V]; NaN while unknown."""
    residual_v: float
    """Measured minus predicted voltage [V]; NaN while unknown."""
    status: Status
    reasons: Reason
    samples: int
    """Samples processed so far."""
