"""Samples, estimates, and the conditions that make an estimate degraded or invalid."""

from __future__ import annotations

import enum
import math
from typing import Final, NamedTuple

CURRENT_AT_MOST_A = 5000.0
"""Largest plausible absolute current [A]."""
TEMPERATURE_WITHIN_C = (-60.0, 120.0)
"""Plausible temperatures [°C]."""
SOC_WITHIN_PCT = (-0.5, 100.5)
"""Plausible values of a car's own SoC [%]: a step of 1 % rounds by half of it."""
VOLTAGE_WITHIN = (0.5, 1.5)
"""Plausible voltages, relative to the pack's at half charge."""


class Sample(NamedTuple):
    """One sample of the pack's signals, paired on bus time.

    `voltage_v` and `temperature_c` are NaN where the signal is missing: charge is still counted,
    and the status reports it. Samples with a NaN time or current are refused by the estimator.
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
    """Validity of an estimate; the values are those of the published frame."""

    INITIALISING = 0
    VALID = 1
    DEGRADED = 2
    INVALID = 3


class Reason(enum.IntFlag):
    """Reasons for a status other than valid; the first 20 bits are those of the published frame."""

    NONE = 0
    DELAY_LINE_FILLING = 1 << 0
    CURRENT_GAP = 1 << 1
    """The current was missing for longer than the allowed gap, within the longest delay."""
    VOLTAGE_MISSING = 1 << 2
    TEMPERATURE_MISSING = 1 << 3
    VOLTAGE_OUTSIDE_MODEL = 1 << 4
    SOC_OUTSIDE_MODEL = 1 << 5
    TEMPERATURE_OUTSIDE_MODEL = 1 << 6
    CURRENT_OUTSIDE_MODEL = 1 << 7
    TEMPERATURE_SOURCE_MISMATCH = 1 << 8
    INNOVATION_LARGE = 1 << 9
    """The voltage rejected the SoC of the start or a high current, or the filter was restarted."""
    NO_INITIAL_SOC = 1 << 10
    INPUT_STALE = 1 << 11
    IMPLAUSIBLE_INPUT = 1 << 12
    """A value or a whole sample was refused."""
    PROTECTION_FAILED = 1 << 13
    """Several consecutive frames were refused."""
    SIGNAL_STUCK = 1 << 14
    CURRENT_MISSING = 1 << 15
    SOC_UNCERTAIN = 1 << 16
    DUPLICATE_SENDER = 1 << 17
    MODEL_MISMATCH = 1 << 18
    """Voltages contradict the model for longer than its stated errors last."""
    TIME_UNCERTAIN = 1 << 19
    SIGN_SUSPECT = 1 << 20
    """The steps of the voltage show that positive current charges. In the frame:
    `IMPLAUSIBLE_INPUT`."""


REASON_WORDS: Final = {
    Reason.DELAY_LINE_FILLING: "current has been observed for less than the model's longest delay",
    Reason.CURRENT_GAP: "the current was missing for too long: charge is uncertain",
    Reason.VOLTAGE_MISSING: "no voltage, or none compared with the model since it was missing",
    Reason.TEMPERATURE_MISSING: "the sample has no temperature",
    Reason.VOLTAGE_OUTSIDE_MODEL: "no SoC of 0–100 % gives this voltage: the inverse is clipped",
    Reason.SOC_OUTSIDE_MODEL: "the model was not identified at this SoC and is extrapolated",
    Reason.TEMPERATURE_OUTSIDE_MODEL: "the model was not identified at this temperature",
    Reason.CURRENT_OUTSIDE_MODEL: "the model was not identified at this current",
    Reason.TEMPERATURE_SOURCE_MISMATCH: "the temperature is not measured where the model's was",
    Reason.INNOVATION_LARGE: "the voltage rejected SoC or high current, or the filter restarted",
    Reason.NO_INITIAL_SOC: "the SoC is not known yet",
    Reason.INPUT_STALE: "no usable sample within the time-out",
    Reason.IMPLAUSIBLE_INPUT: "a value was refused: out of range, or changed too fast",
    Reason.PROTECTION_FAILED: "frames were refused: wrong CRC, repeated counter, or too short",
    Reason.SIGNAL_STUCK: "a signal is constant while another proves that it should change",
    Reason.CURRENT_MISSING: "no plausible current within its time-out: charge is not counted",
    Reason.SOC_UNCERTAIN: "the standard deviation exceeds the limit of a valid SoC",
    Reason.DUPLICATE_SENDER: "another node sends frames with an id that is read or published here",
    Reason.MODEL_MISMATCH: "the pack does not behave as its model: run `cangauge gap` on a log",
    Reason.TIME_UNCERTAIN: "time stamps contradict the monotonic clock",
    Reason.SIGN_SUSPECT: "the current has the wrong sign: the voltage moves with it in its steps",
}
"""Description of each reason, for pages and messages."""


class _Reasons(dict[int, Reason]):
    def __missing__(self, bits: int) -> Reason:
        return self.setdefault(bits, Reason(bits))


REASONS: Final = _Reasons()
"""Sets of reasons by their bits: slow to combine, and read for every sample."""
_NOTE_BITS: Final = int(
    Reason.TEMPERATURE_MISSING
    | Reason.VOLTAGE_OUTSIDE_MODEL
    | Reason.SOC_OUTSIDE_MODEL
    | Reason.TEMPERATURE_OUTSIDE_MODEL
    | Reason.CURRENT_OUTSIDE_MODEL
)
"""Reasons that the standard deviation contains: they leave an estimate valid."""
_UNKNOWN_BITS: Final = int(Reason.NO_INITIAL_SOC)
_INVALID_BITS: Final = int(
    Reason.INPUT_STALE | Reason.CURRENT_MISSING | Reason.MODEL_MISMATCH | Reason.SIGN_SUSPECT
)


def reason_name(reason: Reason) -> str:
    """Return the name of one reason in words, such as "delay line filling"."""
    return (reason.name or "").lower().replace("_", " ")


def reason_names(reasons: int) -> str:
    """Return the names of all reasons that are set, separated by "; "."""
    return "; ".join(reason_name(reason) for reason in Reason if reasons & reason)


def reason_sentences(reasons: int) -> str:
    """Return what the reasons that are set mean to a user, separated by "; "."""
    return "; ".join(REASON_WORDS[reason] for reason in Reason if reasons & reason)


class Estimate(NamedTuple):
    """The estimate after one sample; NaN where a quantity is not known."""

    time_s: float
    """Bus time of the sample [s]."""
    soc_pct: float
    """State of charge of the chosen method [%], within 0–100."""
    soc_std_pct: float
    """Its standard deviation [%]."""
    soc_newton_pct: float
    """State of charge by inverse of the voltage model [%]."""
    soc_coulomb_pct: float
    """State of charge by Coulomb counting alone [%]."""
    voltage_model_v: float
    """Voltage that the model predicts at `soc_pct` [V]."""
    residual_v: float
    """Measured minus predicted voltage [V]."""
    status: Status
    reasons: Reason
    samples: int
    """Number of samples accepted so far."""

    @classmethod
    def unknown(cls, reasons: Reason) -> Estimate:
        """Return the estimate before the first sample."""
        return cls(*(math.nan,) * 7, status_of(reasons), reasons, 0)


class Health(NamedTuple):
    """Health of the pack, with standard deviations."""

    capacity_ah: float
    """Charge from 100 to 0 % SoC [Ah]."""
    capacity_std_ah: float
    resistance_ratio: float
    """Resistance relative to the model's [-]; 1 where nothing is known."""
    resistance_std: float
    offset_a: float
    """Offset of the current sensor, measured minus true [A]."""
    offset_std_a: float = math.nan


class Power(NamedTuple):
    """Possible currents, both positive, and the energy left; NaN where not known."""

    discharge_a: float = math.nan
    """Discharge current possible for 10 s [A]."""
    discharge_std_a: float = math.nan
    charge_a: float = math.nan
    """Charge current possible for 10 s [A]."""
    charge_std_a: float = math.nan
    energy_wh: float = math.nan
    """Energy left to the cut-off [Wh]."""
    energy_std_wh: float = math.nan
    energy_to_soc_pct: float = math.nan
    """SoC at which that energy ends [%]."""


class CellReport(NamedTuple):
    """The cells as a whole; NaN where not known."""

    cells: int
    """Number of cells known."""
    weakest: int
    """Number of the cell with the least SoC; −1: not known."""
    soc_pct: float
    """Its SoC [%]."""
    soc_std_pct: float
    spread_pct: float
    """SoC of the strongest cell less that of the weakest [%]."""
    sum_error_v: float
    """Pack voltage less the sum of the cells [V]."""
    sum_std_v: float
    is_sum_wrong: bool
    """Whether that is more than both sensors' errors allow."""


def status_of(reasons: Reason) -> Status:
    """Return the status that follows from the reasons."""
    bits = int(reasons) & ~_NOTE_BITS
    if not bits:
        return Status.VALID
    if bits & _UNKNOWN_BITS:
        return Status.INITIALISING
    if bits & _INVALID_BITS:
        return Status.INVALID
    return Status.DEGRADED
