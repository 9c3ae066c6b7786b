"""What an estimator carries from sample to sample, and what it hands to the next one.

`EstimatorMemory` and `BlockState` are its own numbers, which it updates in place. NaN is "not known
yet". `EstimatorState` is a copy of everything, to continue as if not interrupted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from operator import add
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from cangauge._typing import FloatArray


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


@dataclass
class BlockState:
    """The block that is being filled: sums over its rows.

    Blocks of 30 s are counted in time from the first sample; the voltage corrects the filter with
    the mean of each. A log's errors last for minutes, so rows of one second repeat each other, and
    the mean holds all that they know.
    """

    number: int = 0
    """Number of the block since the first sample."""
    rows: int = 0
    is_broken: bool = False
    """Whether a gap in the current lies in it."""
    sums: Block | None = None

    def add(self, row: Block) -> None:
        """Add one row, given as a block of its own."""
        self.sums = row if self.sums is None else Block._make(map(add, self.sums, row))
        self.rows += 1

    def mean(self) -> Block | None:
        """Return the mean of the rows; None without rows, or with a gap among them."""
        if self.is_broken or self.sums is None:
            return None
        return Block._make(each / self.rows for each in self.sums)


@dataclass
class EstimatorMemory:
    """State of the `Estimator` itself; NaN: not known, or never."""

    samples: int = 0
    """Accepted samples."""
    first_s: float = math.nan
    """Time of the first sample [s]."""
    tick: int = -1
    """Number of the last row since the first sample."""
    temperature_c: float = math.nan
    """Last known temperature since the last unobserved interval [°C]."""
    row_v: float = math.nan
    row_a: float = 0.0
    """Voltage and current of the last row; NaN after a gap [V, A]."""
    steps: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    """Weight of the latest steps of the current, and their sums [V², A², V·A]."""
    is_sign_wrong: bool = False
    is_unseen: bool = False
    """Whether a block had no usable voltage, and none was used since."""
    newton_pct: float = math.nan
    """SoC by inverse of the voltage model at the last row [%]."""
    newton_std_pct: float = math.nan
    newton_inside: bool = True
    """Whether the voltage lay within the model's range."""
    voltage_model_v: float = math.nan
    residual_v: float = math.nan
    """Predicted voltage of the last row, and measured minus predicted [V]."""
    is_known: bool = False
    """Whether a start was given, or a block has been used."""
    coulomb_start_pct: float = math.nan
    """SoC by counting, plus the charge counted so far [%]."""
    coulomb_var_pct2: float = math.nan
    """Variance of the SoC that counting started from [%²]."""
    gap_until_s: float = math.nan
    """End of the degradation by the last gap in the current [s]."""
    contradicted_until_s: float = math.nan
    """End of the degradation by the last contradiction [s]."""
    mismatch_until_s: float = math.nan
    """Time at which the model-mismatch flag expires [s]."""
    innovations: list[float] = field(default_factory=list)
    """Squares of the latest normalised innovations of the likelier filter."""
    rest_since_s: float = math.nan
    """Begin of the present rest [s]; NaN: none."""
    full_since_s: float = math.nan
    """Time since which voltage and current meet the full-charge rule [s]; NaN: they do not."""
    is_full: bool = False
    is_rested: bool = False


class EstimatorState(BaseModel):
    """Everything in an estimator but its model and settings.

    The estimator that wrote it, or its equal, continues bit for bit from `block`. Any other one, as
    of another release, starts from the SoC.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    writer: str
    """Implementation, method and capacity of the estimator that can read `block`."""
    samples: Annotated[int, Field(ge=0)]
    """Accepted samples."""
    time_s: Annotated[float, Field(allow_inf_nan=False)]
    """Stamp of the last one [s]."""
    soc_pct: Annotated[float, Field(ge=0.0, le=100.0)]
    soc_std_pct: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    """Its estimate and the standard deviation [%]."""
    block: str
    """All of the state as base64."""
