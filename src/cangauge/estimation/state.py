"""State of an estimator: everything it needs to continue as if never interrupted.

The parts are plain dataclasses that their owners update in place; `EstimatorState` collects copies
of them and validates the content of a file. NaN means "not known yet" and is null in JSON. Infinity
is refused, and every number is bounded so that no arithmetic on it overflows.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    model_validator,
)

from cangauge.types import Reason

LARGEST = 1e12
"""Upper bound of times [s], voltages, charges and counters in a state."""

PLAUSIBLE_A = 1e5
"""Upper bound of currents in a state [A]; effects may scale a sample's current."""

DELAY_LINE_AT_MOST = 200_000
"""Samples that a delay line may hold; 70 s at the least spacing of 9 ms are 8,300."""

EFFECTS_AT_MOST = 64
EFFECT_NUMBERS_AT_MOST = 50_000
FILTER_STATES_AT_MOST = 64


def _check_bound(value: float) -> float:
    if abs(value) > LARGEST:  # false for NaN
        raise ValueError(f"larger than {LARGEST:g}")
    return value


def _check_not_negative(value: float) -> float:
    if value < 0.0:  # false for NaN
        raise ValueError("negative")
    return value


_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
_NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=LARGEST)]
_Current = Annotated[
    float, Field(strict=True, allow_inf_nan=False, ge=-PLAUSIBLE_A, le=PLAUSIBLE_A)
]
_MeanSquare = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=PLAUSIBLE_A**2)]
_MaybeNan = Annotated[
    float,
    Field(strict=True),
    BeforeValidator(lambda value: math.nan if value is None else value),
    AfterValidator(_check_bound),
    PlainSerializer(lambda value: None if math.isnan(value) else value, when_used="json"),
]
_NotNegativeOrNan = Annotated[_MaybeNan, AfterValidator(_check_not_negative)]
_Flag = Annotated[bool, Field(strict=True)]
_Count = Annotated[int, Field(strict=True, ge=0, le=1 << 62)]

_NO_MORE: Any = ConfigDict(extra="forbid")


@dataclass
class ClockState:
    """State of an `EstimatorClock`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    last_s: _MaybeNan = math.nan
    """Time of the last accepted sample [s]; NaN before the first."""
    shift_s: _Finite = 0.0
    """Estimator time minus stamp [s]."""
    behind: _Count = 0
    """Consecutive samples stamped before the last accepted one."""
    behind_s: _MaybeNan = math.nan
    """Stamp of the latest of these [s]."""


@dataclass
class CounterState:
    """State of a `CoulombCounter`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    time_s: _MaybeNan = math.nan
    """Time of the last sample [s]; NaN before the first."""
    current_a: _Current = 0.0
    """Current of the last sample [A]."""
    mean_square_a2: _MeanSquare = 0.0
    """Running mean square of the current [A²]."""
    mean_a: _Current = 0.0
    """Running mean of the current [A]."""
    discharged_pct: _Finite = 0.0
    """Net charge taken out since the first sample [% of capacity]."""
    moved_pct: _NotNegative = 0.0
    """Charge moved in either direction since the first sample [% of capacity]."""
    counted_s: _NotNegative = 0.0
    """Time since the first sample in which charge was counted [s]."""


@dataclass
class DelayLineState:
    """Content of a `DelayLine`: increasing times [s] and currents [A]."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    time_s: Annotated[list[_Finite], Field(max_length=DELAY_LINE_AT_MOST)]
    current_a: Annotated[list[_Current], Field(max_length=DELAY_LINE_AT_MOST)]
    since_s: _Finite
    """Start of the gap-free stretch [s]."""


@dataclass
class EkfState:
    """State of a `SocEkf`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    x: Annotated[list[_Finite], Field(max_length=FILTER_STATES_AT_MOST)]
    p: Annotated[
        list[Annotated[list[_Finite], Field(max_length=FILTER_STATES_AT_MOST)]],
        Field(max_length=FILTER_STATES_AT_MOST),
    ]
    """Covariance of the learned states with all states, by rows."""
    mean_innovation_v: _Finite
    """Running mean of the innovation [V]."""
    mean_seconds: _NotNegative
    """Time that it covers [s]."""


Verdict = Literal["", "open", "parked", "moved", "unclear"]
"""Result of the hypothesis test on the last unobserved interval: none yet, undecided, the accepted
hypothesis, or merged without a decision."""


@dataclass
class HypothesisFilterState:
    """State of a `HypothesisFilter`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    hypotheses: Annotated[list[EkfState], Field(min_length=1, max_length=2)]
    is_untested: _Flag
    """Whether no voltage has tested a given initial SoC yet."""
    log_odds: _Finite
    """Log odds of the second hypothesis against the first."""
    outlier_s: _NotNegative
    """Time for which every voltage has been an outlier [s]."""
    verdict: Verdict
    prior_log_odds: _Finite = 0.0
    """Log odds of the second hypothesis before any voltage."""
    wide_std_pct: _NotNegative = 0.0
    """Prior standard deviation of the SoC under the second hypothesis [%]."""


@dataclass
class ChargeSinceUpdate:
    """Charge and time since the last voltage update."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    seconds: _NotNegative = 0.0
    away_s: _NotNegative = 0.0
    """Part of it in unobserved intervals, in which no charge was counted [s]."""
    discharged_pct: _Finite = 0.0
    moved_pct: _NotNegative = 0.0
    gap_var_pct2: _NotNegative = 0.0
    """Variance of the charge counted across gaps [%²]."""
    unseen_var_pct2: _NotNegative = 0.0
    """Variance of the charge of unobserved intervals, if the car was parked [%²]."""


@dataclass
class ReferenceState:
    """State of a `SocReferenceDetector`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    full_since_s: _MaybeNan = math.nan
    """Since when voltage and current have met the full-charge rule [s]; NaN: they do not."""
    is_full: _Flag = False
    is_rested: _Flag = False


_HealthSums = Annotated[list[_Finite], Field(min_length=4, max_length=4)]
_HealthPair = Annotated[list[_MaybeNan], Field(min_length=2, max_length=2)]


@dataclass
class ResistanceState:
    """State of a `ResistanceEstimator`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    block: Annotated[list[_Finite], Field(min_length=4, max_length=4)] = field(
        default_factory=lambda: [0.0] * 4
    )
    """Sums of residual and drop [V], number and time [s] of the block that is being filled."""
    waiting: Annotated[list[_HealthPair], Field(min_length=4, max_length=4)] = field(
        default_factory=lambda: [[math.nan] * 2 for _ in range(4)]
    )
    """Mean residual and drop [V] of the block that waits for its neighbour, by scale."""
    sums: Annotated[list[_HealthSums], Field(min_length=4, max_length=4)] = field(
        default_factory=lambda: [[0.0] * 4 for _ in range(4)]
    )
    """Sums of drop², drop · residual, residual² [V²] of the details, and their number, by scale."""


@dataclass
class HealthState:
    """State of a `HealthEstimator`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    capacity_ah: Annotated[float, Field(strict=True, gt=0.0, le=LARGEST)] = 1.0
    """Reference capacity of the filter [Ah]."""
    x: Annotated[list[_Finite], Field(max_length=FILTER_STATES_AT_MOST)] = field(
        default_factory=list
    )
    p: Annotated[
        list[_Finite], Field(max_length=FILTER_STATES_AT_MOST * (FILTER_STATES_AT_MOST + 1) // 2)
    ] = field(default_factory=list)
    """Lower triangle of the covariance, by rows."""
    is_started: _Flag = False
    """Whether the SoC is known since the last unobserved interval."""
    seconds: _NotNegative = 0.0
    away_s: _NotNegative = 0.0
    discharged_pct: _Finite = 0.0
    moved_pct: _NotNegative = 0.0
    gap_var_pct2: _NotNegative = 0.0
    """Charge since the filter was propagated, as in `ChargeSinceUpdate`."""
    sum_v: _Finite = 0.0
    sum_drop_v: _Finite = 0.0
    ticks: _Count = 0
    window_s: _NotNegative = 0.0
    """Voltages of the window that is being filled: sums [V], number and time [s]."""
    resistance: ResistanceState = field(default_factory=ResistanceState)


@dataclass
class EstimatorMemory:
    """State of the `Estimator` itself; NaN: not known, or never."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    samples: _Count = 0
    """Accepted samples."""
    resets: _Count = 0
    """How often the filter was lost and restarted."""
    first_s: _Finite = 0.0
    """Time of the first sample [s]."""
    tick: Annotated[int, Field(strict=True, ge=-1, le=1 << 62)] = -1
    """Last tick of the model's rate at which the voltage was used."""
    temperature_c: _MaybeNan = math.nan
    """Last known temperature [°C]."""
    newton_pct: _MaybeNan = math.nan
    """SoC by inverse of the voltage model [%]."""
    newton_inside: _Flag = True
    """Whether the voltage lay within the model's range."""
    newton_std_pct: _NotNegativeOrNan = math.nan
    coulomb_start_pct: _MaybeNan = math.nan
    """SoC by counting, plus the charge counted so far [%]."""
    coulomb_var_pct2: _NotNegativeOrNan = math.nan
    """Variance of the SoC that counting started from, plus gaps [%²]."""
    coulomb_counted_s: _NotNegative = 0.0
    coulomb_moved_pct: _NotNegative = 0.0
    """The counter's `counted_s` and `moved_pct` when that variance was last known."""
    gap_until_s: _MaybeNan = math.nan
    """Until when the last gap in the current degrades the estimate [s]."""
    contradicted_until_s: _MaybeNan = math.nan
    """Until when the last contradiction degrades the estimate [s]."""
    mismatch_until_s: _MaybeNan = math.nan
    """Until when the evidence that model and pack disagree lasts [s]."""
    bias_pct: _Finite = 0.0
    """Bias of the voltage model in SoC [%]."""
    rest_since_s: _MaybeNan = math.nan
    """Since when the pack has rested [s]; NaN: it does not."""
    level_s: _MaybeNan = math.nan
    """When the levels were last updated [s]; NaN: never."""
    level_residual_v: _Finite = 0.0
    level_drop_v: _Finite = 0.0
    """Levels of the residual, and of the predicted drop over the same time [V]."""


class EstimatorState(BaseModel):
    """Everything in an `Estimator` but its model and settings."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: Annotated[str, Field(strict=True)]
    capacity_ah: _NotNegative
    clock: ClockState
    counter: CounterState
    line: DelayLineState
    effects: Annotated[
        list[Annotated[list[_MaybeNan], Field(max_length=EFFECT_NUMBERS_AT_MOST)]],
        Field(max_length=EFFECTS_AT_MOST),
    ]
    filter: HypothesisFilterState
    since: ChargeSinceUpdate
    references: ReferenceState
    memory: EstimatorMemory
    health: HealthState
    estimate: Annotated[list[_MaybeNan], Field(min_length=7, max_length=7)]
    """Numbers of the last `Estimate`, in its order, from `time_s` to `residual_v`."""
    reasons: Annotated[int, Field(strict=True, ge=0, lt=2 * max(Reason))]

    @model_validator(mode="after")
    def _check_estimate(self) -> Self:
        _, soc_pct, std_pct, newton_pct, coulomb_pct, _, _ = self.estimate
        for value in (soc_pct, newton_pct, coulomb_pct, self.memory.newton_pct):
            if value < 0.0 or value > 100.0:
                raise ValueError("a state of charge lies outside 0–100 %")
        if std_pct < 0.0:
            raise ValueError("a standard deviation is negative")
        return self

    @model_validator(mode="after")
    def _check_times(self) -> Self:
        """Refuse times that do not increase, or lie after the latest sample."""
        latest_s, counted_s, line = self.clock.last_s, self.counter.time_s, self.line.time_s
        if len(line) != len(self.line.current_a):
            raise ValueError("the delay line needs one current per time")
        if any(b <= a for a, b in itertools.pairwise(line)):
            raise ValueError("the delay line's times must increase")
        if (line[-1] if line else math.nan) != counted_s and (line or not math.isnan(counted_s)):
            raise ValueError("counter and delay line end at different times")
        if math.isnan(latest_s) and not math.isnan(counted_s):
            raise ValueError("a sample was counted before the first")
        for name, value in (
            ("counter.time_s", counted_s),
            ("line.since_s", self.line.since_s if line else math.nan),
            ("memory.first_s", self.memory.first_s if self.memory.samples else math.nan),
            ("memory.rest_since_s", self.memory.rest_since_s),
            ("memory.level_s", self.memory.level_s),
            ("references.full_since_s", self.references.full_since_s),
            ("clock.behind_s", self.clock.behind_s + self.clock.shift_s),
        ):
            if value > latest_s:
                raise ValueError(f"{name} is later than the latest sample")
        if self.since.away_s > self.since.seconds:
            raise ValueError("since.away_s is longer than since.seconds")
        if (
            self.memory.coulomb_counted_s > self.counter.counted_s
            or self.memory.coulomb_moved_pct > self.counter.moved_pct
        ):
            raise ValueError("counting started after the latest count")
        return self

    @property
    def soc_pct(self) -> float:
        """The last estimate of the state of charge [%]; NaN if there was none."""
        return self.estimate[1]

    @property
    def soc_std_pct(self) -> float:
        """Its standard deviation [%]."""
        return self.estimate[2]
