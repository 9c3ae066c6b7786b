"""Checks beside the filter: impossible values, a wrong sign, another pack, and SoC references.

A reference is a moment at which the SoC is known by other means than counting and the filter: the
end of a full charge, or a long rest. Both rules are off by default.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from scipy.special import chdtri

from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.state import EstimatorMemory
from cangauge.model.extended import OnlineModel
from cangauge.model.prior import SLOW_S
from cangauge.types import TEMPERATURE_WITHIN_C, VOLTAGE_WITHIN, Reason, Sample

REST_CURRENT_C_RATE: Final = 0.02
"""Below this current the pack is at rest [1/h]: 1.2 A at 60 Ah."""

REST_S: Final = 600.0
"""Interval without samples that counts as rest [s]: slow polarisation has decayed."""

STEP_C_RATE: Final = 0.05
"""Least change of the current between rows that shows its sign [1/h]: 3 A at 60 Ah."""

STEPS_MEMORY: Final = 10.0
"""Steps over which voltage and current are correlated."""

STEPS_AT_LEAST: Final = 6.0
"""Weight of the steps from which the correlation counts: some ten, or a minute of a drive."""

STEPS_CORRELATION: Final = 0.9
"""Correlation from which the current has the wrong sign [-]. With the right one it is −0.5 or less
in all recorded drives; a skew of one to five seconds between both gives up to 0.9."""


MISMATCH_S: Final = 2.0 * SLOW_S
"""Time over which innovations are tested against the model, and for which a failed test makes the
estimate invalid [s]: twice the memory of the voltage's slow error."""

ALARM: Final = 1e-6
"""Probability that the innovations of a pack that agrees with its model fail the test."""


class Limits(NamedTuple):
    """How far a pack may be from its model."""

    tested_blocks: int
    """Number of blocks tested together."""
    innovations_at_most: float
    """Largest sum of the squares of their normalised innovations."""
    residual_at_most: float
    """Largest residual of one row over its standard deviation."""
    strain_at_most: float
    """Largest `SocFilter.strain`: its mean under the model, times the relative strain of the
    left-out logs of the fit."""

    @classmethod
    def of(cls, model: OnlineModel) -> Limits:
        """Return the limits of a model."""
        blocks = max(round(MISMATCH_S / model.noise.block_s), 1)
        innovations, residual = chdtri([blocks, 1], ALARM).tolist()
        strain = (model.functions.number + 4.0) * model.noise.left_out_strain
        return cls(blocks, innovations, math.sqrt(residual), strain)


def drop_implausible(sample: Sample, nominal_v: float) -> tuple[Sample, Reason]:
    """Return the sample with an implausible voltage or temperature replaced by NaN, and why.

    `nominal_v` is the pack's voltage at half charge [V]; behind open contactors it is close to 0.
    """
    low, high = VOLTAGE_WITHIN
    coldest_c, hottest_c = TEMPERATURE_WITHIN_C
    reason = Reason.NONE  # comparisons with NaN are false
    if sample.voltage_v < low * nominal_v or sample.voltage_v > high * nominal_v:
        sample, reason = sample._replace(voltage_v=math.nan), Reason.IMPLAUSIBLE_INPUT
    if sample.temperature_c < coldest_c or sample.temperature_c > hottest_c:
        sample, reason = sample._replace(temperature_c=math.nan), Reason.IMPLAUSIBLE_INPUT
    return sample, reason


def watch_sign(memory: EstimatorMemory, sample: Sample, capacity_ah: float) -> None:
    """Correlate the steps of voltage and current: of a battery they are opposite.

    Parameters
    ----------
    memory : EstimatorMemory
        Of the estimator; its sums of steps and `is_sign_wrong` are updated.
    sample : Sample
        Of a row, with its voltage.
    capacity_ah : float
        [Ah].
    """
    step_v, step_a = sample.voltage_v - memory.row_v, sample.current_a - memory.row_a
    memory.row_v, memory.row_a = sample.voltage_v, sample.current_a
    if math.isnan(step_v) or abs(step_a) < STEP_C_RATE * capacity_ah:
        return
    keep = 1.0 - 1.0 / STEPS_MEMORY
    step = 1.0, step_v * step_v, step_a * step_a, step_v * step_a
    memory.steps = tuple(keep * each + new for each, new in zip(memory.steps, step, strict=True))
    weight, v2, a2, va = memory.steps
    if va < 0.0:
        memory.is_sign_wrong = False
    elif weight >= STEPS_AT_LEAST and va > STEPS_CORRELATION * math.sqrt(v2 * a2):
        memory.is_sign_wrong = True


def detect_references(
    settings: EstimatorSettings, memory: EstimatorMemory, sample: Sample
) -> list[tuple[float, float]]:
    """Return SoC and deviation [%] of the references that a row establishes.

    A reference is given once each time that its rule becomes true.

    Parameters
    ----------
    settings : EstimatorSettings
    memory : EstimatorMemory
        Of the estimator; the state of the rules in it is updated.
    sample : Sample
        Its voltage may be NaN.
    """
    found, full, rest = [], settings.full_charge, settings.long_rest
    if full is not None and not math.isnan(sample.voltage_v):  # a missing voltage proves nothing
        is_high = sample.voltage_v >= full.voltage_v and abs(sample.current_a) <= full.current_a
        memory.full_since_s = _since(memory.full_since_s, is_high, sample.time_s)
        was, memory.is_full = memory.is_full, sample.time_s - memory.full_since_s >= full.hold_s
        if memory.is_full and not was:
            found.append((full.soc_pct, full.soc_std_pct))
    if rest is not None and not math.isnan(memory.newton_pct):
        was = memory.is_rested
        memory.is_rested = sample.time_s - memory.rest_since_s >= rest.after_s
        if memory.is_rested and not was:
            found.append((memory.newton_pct, rest.soc_std_pct))
    return found


def track_rest(memory: EstimatorMemory, sample: Sample, seconds: float, capacity_ah: float) -> None:
    """Note since when the pack rests; an interval without samples [s] may be a rest too."""
    is_rest = abs(sample.current_a) <= REST_CURRENT_C_RATE * capacity_ah
    memory.rest_since_s = _since(memory.rest_since_s, is_rest, sample.time_s)
    if seconds > REST_S:
        memory.rest_since_s = sample.time_s - seconds


def _since(start_s: float, holds: bool, now_s: float) -> float:
    """Return since when a condition has held [s], given the time so far; NaN: it does not."""
    if not holds:
        return math.nan
    return now_s if math.isnan(start_s) else start_s
