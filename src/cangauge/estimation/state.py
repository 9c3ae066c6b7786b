"""State of an estimator: everything it needs to continue as if never interrupted.

The parts are plain dataclasses that their owners update in place; `EstimatorState` collects copies
of them and validates the content of a file. NaN means "not known yet" and is null in JSON.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    model_validator,
)

from cangauge._typing import FloatArray
from cangauge.types import Reason

LARGEST = 1e12
"""Upper bound of the numbers in a state: no arithmetic on it overflows."""

_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-LARGEST, le=LARGEST)]
_NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=LARGEST)]
_MaybeNan = Annotated[
    float,
    Field(strict=True),
    BeforeValidator(lambda value: math.nan if value is None else value),
    PlainSerializer(lambda value: None if math.isnan(value) else value, when_used="json"),
]
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
    current_a: _Finite = 0.0
    """Current of the last sample [A]."""
    mean_square_a2: _NotNegative = 0.0
    """Running mean square of the current [A²]."""
    turned_a2: _NotNegative = 0.0
    """Variance of the current between the last two samples [A²]."""
    discharged_pct: _Finite = 0.0
    """Net charge taken out since the first sample [% of capacity]."""
    moved_pct: _NotNegative = 0.0
    """Charge moved in either direction since the first sample [% of capacity]."""
    counted_s: _NotNegative = 0.0
    """Time since the first sample in which charge was counted [s]."""
    gap_var_pct2: _NotNegative = 0.0
    """Variance of the charge between samples since the first [%²]."""


@dataclass
class DelayLineState:
    """Content of a `DelayLine`: increasing times [s] and currents [A]."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    time_s: list[_Finite]
    current_a: list[_Finite]
    since_s: _Finite
    """Start of the gap-free stretch [s]."""


class Block(NamedTuple):
    """Means over the rows of one block."""

    counted_s: float
    """Time since the first sample in which charge was counted [s]."""
    discharged_pct: float
    """Net charge taken out since the first sample [% of capacity]."""
    voltage_v: float
    temperature_c: float
    """NaN without one."""
    drop_v: float
    """Part of the load voltage that is proportional to the resistances [V]."""
    unseen_v2: float
    """Variance of the load voltage by currents between the samples [V²]."""
    load: FloatArray
    """Load row, shape (k,)."""
    drives: FloatArray
    """Drives of the model's effects."""


SCALARS = len(Block._fields) - 2
"""Fields of a block that are numbers; load row and drives follow."""


@dataclass
class BlockState:
    """The block that is being filled: sums over its rows.

    Blocks of 30 s are counted in time from the first sample; the voltage corrects the filter with
    the mean of each. A log's errors last for minutes, so rows of one second repeat each other, and
    the mean holds all that they know.
    """

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    number: _Count = 0
    """Number of the block since the first sample."""
    rows: _Count = 0
    is_broken: _Flag = False
    """Whether a gap in the current lies in it."""
    columns: _Count = 0
    """Columns of the load row."""
    sums: list[_MaybeNan] = field(default_factory=list)
    """Of the fields of a `Block`, in their order."""

    def add(self, row: Block) -> None:
        """Add one row, given as a block of its own."""
        values = (*row[:SCALARS], *row.load.tolist(), *row.drives.tolist())
        sums = self.sums or [0.0] * len(values)
        self.columns = row.load.size
        self.sums = [a + b for a, b in zip(sums, values, strict=True)]
        self.rows += 1

    def mean(self) -> Block | None:
        """Return the mean of the rows; None without rows, or with a gap among them."""
        if self.is_broken or not self.rows:
            return None
        numbers, load, drives = np.split(
            np.array(self.sums) / self.rows, [SCALARS, SCALARS + self.columns]
        )
        return Block._make([*numbers.tolist(), load, drives])


@dataclass
class BiasState:
    """State of a `SeparateBias`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    b: list[_Finite]
    p: list[list[_Finite]]
    v: list[list[_Finite]]


@dataclass
class FilterState:
    """State of a `SocFilter`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    x: list[_Finite]
    p: list[list[_Finite]]
    evidence: _Finite
    bias: BiasState


@dataclass
class HypothesesState:
    """State of `Hypotheses`."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    filters: Annotated[list[FilterState], Field(min_length=1, max_length=2)]
    prior_log_odds: _Finite
    decision: Annotated[int, Field(strict=True, ge=-1, le=1)]


@dataclass
class EstimatorMemory:
    """State of the `Estimator` itself; NaN: not known, or never."""

    __pydantic_config__: ClassVar[Any] = _NO_MORE
    samples: _Count = 0
    """Accepted samples."""
    resets: _Count = 0
    """How often the filter was lost and restarted."""
    first_s: _MaybeNan = math.nan
    """Time of the first sample [s]."""
    tick: Annotated[int, Field(strict=True, ge=-1, le=1 << 62)] = -1
    """Number of the last row since the first sample."""
    temperature_c: _MaybeNan = math.nan
    """Last known temperature since the last unobserved interval [°C]."""
    row_v: _MaybeNan = math.nan
    row_a: _Finite = 0.0
    """Voltage and current of the last row; NaN after a gap [V, A]."""
    steps: _NotNegative = 0.0
    steps_v2: _NotNegative = 0.0
    steps_a2: _NotNegative = 0.0
    steps_va: _Finite = 0.0
    """Weight of the latest steps of the current, and their sums [V², A², V·A]."""
    is_sign_wrong: _Flag = False
    newton_pct: _MaybeNan = math.nan
    """SoC by inverse of the voltage model at the last row [%]."""
    newton_std_pct: _MaybeNan = math.nan
    newton_inside: _Flag = True
    """Whether the voltage lay within the model's range."""
    voltage_model_v: _MaybeNan = math.nan
    residual_v: _MaybeNan = math.nan
    """Predicted voltage of the last row, and measured minus predicted [V]."""
    is_known: _Flag = False
    """Whether a start was given, or a block has been used."""
    filter_discharged_pct: _Finite = 0.0
    filter_counted_s: _NotNegative = 0.0
    filter_gap_var_pct2: _NotNegative = 0.0
    """The counter's charge, time and gaps at the filter's state."""
    coulomb_start_pct: _MaybeNan = math.nan
    """SoC by counting, plus the charge counted so far [%]."""
    coulomb_var_pct2: _MaybeNan = math.nan
    """Variance of the SoC that counting started from [%²]."""
    coulomb_counted_s: _NotNegative = 0.0
    coulomb_moved_pct: _NotNegative = 0.0
    coulomb_gap_var_pct2: _NotNegative = 0.0
    """The counter's time, moved charge and gaps when counting started."""
    gap_until_s: _MaybeNan = math.nan
    """Until when the last gap in the current degrades the estimate [s]."""
    contradicted_until_s: _MaybeNan = math.nan
    """Until when the last contradiction degrades the estimate [s]."""
    mismatch_until_s: _MaybeNan = math.nan
    """Until when the evidence that model and pack disagree lasts [s]."""
    innovations: list[_Finite] = field(default_factory=list)
    """Squares of the latest normalised innovations of the likelier filter."""
    rest_since_s: _MaybeNan = math.nan
    """Since when the pack has rested [s]; NaN: it does not."""
    full_since_s: _MaybeNan = math.nan
    """Since when voltage and current have met the full-charge rule [s]; NaN: they do not."""
    is_full: _Flag = False
    is_rested: _Flag = False


class EstimatorState(BaseModel):
    """Everything in an `Estimator` but its model and settings."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: Annotated[str, Field(strict=True)]
    capacity_ah: _NotNegative
    clock: ClockState
    counter: CounterState
    line: DelayLineState
    online: list[list[_MaybeNan]]
    """State of the voltage model: low-passed currents, then each effect."""
    block: BlockState
    hypotheses: HypothesesState
    memory: EstimatorMemory
    estimate: Annotated[list[_MaybeNan], Field(min_length=7, max_length=7)]
    """Numbers of the last `Estimate`, in its order, from `time_s` to `residual_v`."""
    reasons: Annotated[int, Field(strict=True, ge=0, lt=2 * max(Reason))]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not (math.isnan(self.soc_pct) or 0.0 <= self.soc_pct <= 100.0):
            raise ValueError("the SoC must lie within 0 … 100 %")
        if self.soc_std_pct < 0.0:
            raise ValueError("the standard deviation of the SoC is negative")
        if self.memory.samples > 0 and math.isnan(self.memory.first_s):
            raise ValueError("the time of the first sample is missing")
        if len(self.line.time_s) != len(self.line.current_a):
            raise ValueError("the delay line needs one current per time")
        for each in self.hypotheses.filters:
            for matrix in (each.p, each.bias.p, each.bias.v):
                if len({len(row) for row in matrix}) != 1:
                    raise ValueError("the rows of a matrix need one length")
        return self

    @property
    def soc_pct(self) -> float:
        """The last estimate of the state of charge [%]; NaN if there was none."""
        return self.estimate[1]

    @property
    def soc_std_pct(self) -> float:
        """Its standard deviation [%]."""
        return self.estimate[2]
