"""What an estimator must remember to go on as if it had not been interrupted.

Plain numbers, strictly checked where they come from a file. NaN ("not known yet") is null in JSON,
infinity is refused; every number is bounded, so that no arithmetic on it overflows.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    model_validator,
)

LARGEST = 1e12
"""No time [s], current, voltage or charge in a state is larger."""

DELAY_LINE_AT_MOST = 200_000
"""Samples that a delay line may hold: 70 s thinned to 9 ms are 8,300."""

EFFECTS_AT_MOST = 64
EFFECT_NUMBERS_AT_MOST = 50_000


def _nan_for_null(value: object) -> object:
    return math.nan if value is None else value


def _bounded(value: float) -> float:
    if abs(value) > LARGEST:  # NaN is not
        raise ValueError(f"larger than {LARGEST:g}")
    return value


def _not_negative(value: float) -> float:
    if value < 0.0:
        raise ValueError("negative")
    return value


def _null_for_nan(value: float) -> float | None:
    return None if math.isnan(value) else value


PLAUSIBLE_A = 1e5
"""No current in a state is larger [A]: that of a sample, which `validity` bounds, and what effects
make of it."""

Finite = Annotated[float, Field(allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
Current = Annotated[float, Field(allow_inf_nan=False, ge=-PLAUSIBLE_A, le=PLAUSIBLE_A)]
NotNegative = Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=LARGEST)]
MaybeNan = Annotated[
    float,
    BeforeValidator(_nan_for_null),
    AfterValidator(_bounded),
    PlainSerializer(_null_for_nan, when_used="json"),
]
MaybeSize = Annotated[MaybeNan, AfterValidator(_not_negative)]
Count = Annotated[int, Field(ge=0, le=1 << 62)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class CounterState(_Strict):
    """A `CoulombCounter`."""

    time_s: MaybeNan
    """Time of the last sample [s]; NaN before the first."""
    current_a: Current
    mean_square_a2: Annotated[float, Field(allow_inf_nan=False, ge=0.0, le=PLAUSIBLE_A**2)]
    mean_a: Current
    discharged_pct: Finite
    moved_pct: NotNegative
    counted_s: NotNegative


class DelayLineState(_Strict):
    """A `DelayLine`: times [s], increasing, and currents [A]."""

    time_s: Annotated[list[Finite], Field(max_length=DELAY_LINE_AT_MOST)]
    current_a: Annotated[list[Current], Field(max_length=DELAY_LINE_AT_MOST)]
    since_s: Finite

    @model_validator(mode="after")
    def _increasing(self) -> Self:
        if len(self.time_s) != len(self.current_a):
            raise ValueError("as many currents as times are needed")
        if any(b <= a for a, b in zip(self.time_s, self.time_s[1:], strict=False)):
            raise ValueError("times must increase")
        return self


class FilterState(_Strict):
    """A `SocEkf`: state x, covariance P, and the running mean of its innovations."""

    x: Annotated[list[Finite], Field(max_length=64)]
    p: Annotated[list[Annotated[list[Finite], Field(max_length=64)]], Field(max_length=64)]
    mean_innovation_v: Finite
    mean_seconds: NotNegative


class HypothesisFilterState(_Strict):
    """A `HypothesisFilter`: one filter, or two while it is open which of two stories is true."""

    filters: Annotated[list[FilterState], Field(max_length=2)]
    is_untried: bool = False
    """Whether a given SoC has not met a voltage yet."""
    log_odds: Finite
    open_s: NotNegative
    outlier_s: NotNegative
    verdict: Literal["", "open", "parked", "moved", "unclear"]


class SinceState(_Strict):
    """Charge since the last voltage that was used."""

    seconds: NotNegative
    away_s: NotNegative
    discharged_pct: Finite
    moved_pct: NotNegative
    gap_var_pct2: NotNegative
    unseen_var_pct2: NotNegative


class ClockState(_Strict):
    """An `EstimatorClock`."""

    last_s: MaybeNan
    shift_s: Finite
    behind: Count
    behind_s: MaybeNan


class AnchorState(_Strict):
    """An `AnchorWatch`."""

    full_since_s: MaybeNan
    is_full: bool
    is_rested: bool


class EstimatorState(_Strict):
    """All of an `Estimator` but its model and settings."""

    method: str
    capacity_ah: NotNegative
    clock: ClockState
    counter: CounterState
    line: DelayLineState
    effects: Annotated[
        list[Annotated[list[MaybeNan], Field(max_length=EFFECT_NUMBERS_AT_MOST)]],
        Field(max_length=EFFECTS_AT_MOST),
    ]
    belief: HypothesisFilterState
    since: SinceState
    anchors: AnchorState
    samples: Count
    resets: Count
    first_s: Finite
    tick: Annotated[int, Field(ge=-1, le=1 << 62)]
    temperature_c: MaybeNan
    newton_pct: MaybeNan
    newton_inside: bool
    newton_std_pct: MaybeSize
    coulomb_start_pct: MaybeNan
    coulomb_var_pct2: MaybeSize
    coulomb_counted_s: NotNegative
    coulomb_moved_pct: NotNegative
    gap_until_s: MaybeNan
    contradicted_until_s: MaybeNan
    rest_since_s: MaybeNan
    estimate: Annotated[list[MaybeNan], Field(min_length=7, max_length=7)]
    """Numbers of the last `Estimate`, in its order, from `time_s` to `residual_v`."""
    reasons: Annotated[int, Field(ge=0, le=0x1FFFF)]

    @model_validator(mode="after")
    def _believable(self) -> Self:
        _, soc_pct, std_pct, newton_pct, coulomb_pct, _, _ = self.estimate
        for value in (soc_pct, newton_pct, coulomb_pct, self.newton_pct):
            if value < 0.0 or value > 100.0:
                raise ValueError("a state of charge lies outside 0–100 %")
        if std_pct < 0.0:
            raise ValueError("a standard deviation is negative")
        return self

    @model_validator(mode="after")
    def _one_time(self) -> Self:
        """Nothing remembered may lie after the latest sample: time would run backwards."""
        latest_s, taken_s, line = self.clock.last_s, self.counter.time_s, self.line.time_s
        if (line[-1] if line else math.nan) != taken_s and (line or not math.isnan(taken_s)):
            raise ValueError("counter and delay line end at different times")
        if math.isnan(latest_s) and not math.isnan(taken_s):
            raise ValueError("a sample was counted before the first")
        for name, value in (
            ("counter.time_s", taken_s),
            ("line.since_s", self.line.since_s if line else math.nan),
            ("first_s", self.first_s if self.samples else math.nan),
            ("rest_since_s", self.rest_since_s),
            ("anchors.full_since_s", self.anchors.full_since_s),
            ("clock.behind_s", self.clock.behind_s + self.clock.shift_s),
        ):
            if value > latest_s:
                raise ValueError(f"{name} is later than the latest sample")
        if self.since.away_s > self.since.seconds:
            raise ValueError("longer away than time passed")
        if (
            self.coulomb_counted_s > self.counter.counted_s
            or self.coulomb_moved_pct > self.counter.moved_pct
        ):
            raise ValueError("the count began after its end")
        return self

    @property
    def soc_pct(self) -> float:
        """The last estimate of the state of charge [%]; NaN if there was none."""
        return self.estimate[1]

    @property
    def soc_std_pct(self) -> float:
        """Its standard deviation [%]."""
        return self.estimate[2]
