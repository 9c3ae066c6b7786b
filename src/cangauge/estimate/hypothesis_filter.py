"""What the estimator believes of the SoC: one filter, or two while there are two stories of it.

There are two after a time that nobody saw (`pause`): *parked* keeps the SoC to within a little,
*moved* knows next to nothing of it. And there are two after a SoC was given: the first takes it as
it was told, the second as *wrong*, and begins from the first voltage as if none had been told. Both
filters take every voltage, and the likelihood of what each saw moves the odds between them (a
static multiple-model estimator; Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
Tracking and Navigation, 2001, ch. 11.6). What is published is the mean of both, weighed by the
odds, with the spread between them in its standard deviation; so the SoC goes toward the voltage as
far as the voltage proves, and does not jump. Once the odds are clear the other story is dropped; if
they never are, the two are merged. A given SoC that the voltages refute thus leaves no trace.

A pause is thereby also the check of a SoC that was kept in a file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from cangauge.errors import InputError
from cangauge.estimate.counting import ChargeStep, moved_log_odds, moved_std_pct
from cangauge.estimate.ekf import UNKNOWN_SOC_STD_PCT, Measurement, SocEkf
from cangauge.estimate.state import FilterState, HypothesisFilterState, SinceState

CLEAR_LOG_ODDS = math.log(1000.0)
"""Beyond this the less likely story is dropped."""

WRONG_LOG_ODDS = -math.log(1000.0)
"""Of a SoC that was given, before any voltage, that it is another pack's or another day's: a
guess. It says what error at the start is believed to be a wrong SoC, and not a wrong voltage."""

OPEN_AT_MOST_S = 900.0
"""After this long with voltages the stories are merged, if the odds are not clear [s]."""

DIVERGED_S = 180.0
"""Voltages that are outliers, all of them and for so long, mean that the filter is lost [s]."""

OUTLIER_STEP_AT_MOST_S = 10.0
"""A single outlier counts for no longer than this, however long ago the last voltage was [s]."""

Verdict = Literal["", "open", "parked", "moved", "unclear"]
"""How the last pause was judged: not at all, still open, one of the stories, or neither."""


@dataclass
class Since:
    """Charge since the last voltage that was used."""

    seconds: float = 0.0
    away_s: float = 0.0
    """Time of it in which no charge was counted [s]."""
    discharged_pct: float = 0.0
    moved_pct: float = 0.0
    gap_var_pct2: float = 0.0
    """Variance of the charge of gaps that were counted over [%²]."""
    unseen_var_pct2: float = 0.0
    """Variance of the charge of times that were not, if nobody charged or drove [%²]."""

    def add(self, charge: ChargeStep) -> None:
        """Take one step of the counter."""
        self.seconds += charge.seconds
        self.discharged_pct += charge.discharged_pct
        self.moved_pct += abs(charge.discharged_pct)
        if charge.away_s:
            self.away_s += charge.away_s
            self.unseen_var_pct2 += charge.parked_std_pct**2
        else:
            self.gap_var_pct2 += charge.gap_std_pct**2

    @property
    def counted_s(self) -> float:
        """Time in which charge was counted [s]."""
        return self.seconds - self.away_s

    def spread_pct2(self) -> float:
        """Return the variance of the charge of all gaps, both stories weighed [%²]."""
        total = self.gap_var_pct2 + self.unseen_var_pct2
        if self.away_s:
            odds = math.exp(moved_log_odds(self.away_s))
            total += odds / (1.0 + odds) * moved_std_pct(self.away_s) ** 2
        return total

    def state(self) -> SinceState:
        """Return what is to be remembered."""
        return SinceState.model_construct(**asdict(self))

    @classmethod
    def of(cls, state: SinceState) -> Since:
        """Return it from a state."""
        return cls(**state.model_dump())


class HypothesisFilter:
    """One filter or two; takes the place of a `SocEkf`.

    Parameters
    ----------
    make : callable
        Returns a new `SocEkf`.
    """

    def __init__(self, make: Callable[[], SocEkf]) -> None:
        self._make = make
        # Parked, as told, or the only one first.
        self._filters = [make()]
        self._is_untried = False
        self._log_odds = 0.0
        self._open_s = 0.0
        self._outlier_s = 0.0
        self.verdict: Verdict = ""

    def start(self, soc_pct: float, std_pct: float) -> None:
        """Begin from a SoC with its standard deviation [%]; everything before is forgotten."""
        self._filters = [self._make()]
        self._filters[0].start(soc_pct, std_pct)
        self._is_untried = std_pct < UNKNOWN_SOC_STD_PCT
        self._outlier_s = 0.0
        if self.verdict == "open":
            self.verdict = "unclear"

    def predict(self, since: Since) -> None:
        """Carry the state over the charge counted since the last call."""
        variances = [since.gap_var_pct2 + since.unseen_var_pct2]
        if since.away_s:
            self._merge("unclear")
            self._open(self._copy(self._filters[0].state()), moved_log_odds(since.away_s))
            self.verdict = "open"
            variances.append(since.gap_var_pct2 + moved_std_pct(since.away_s) ** 2)
        elif len(self._filters) > 1:
            variances *= 2
        for each, variance in zip(self._filters, variances, strict=True):
            each.predict(
                since.seconds, since.discharged_pct, since.moved_pct, variance, since.away_s
            )

    def update(self, measurement: Measurement, since: Since) -> bool:
        """Take one voltage in; return True if it shows that the SoC was wrong all the time."""
        if self._is_untried:
            self._try(measurement)
        contradicted = [each.update(measurement, since.seconds) for each in self._filters]
        self._watch(since)
        if len(self._filters) == 1:
            return contradicted[0]
        first, second = self._filters
        change = second.log_likelihood - first.log_likelihood
        self._log_odds = min(max(self._log_odds + change, -50.0), 50.0)
        self._open_s += since.counted_s
        if contradicted[0] != contradicted[1]:
            return self._settle(contradicted.index(False))
        if contradicted[0] or self._is_clear:
            return self._settle(int(self._log_odds > 0.0), is_doubted=contradicted[0])
        if self._open_s > OPEN_AT_MOST_S:
            self._merge("unclear")
        return False

    def anchor(self, soc_pct: float, std_pct: float) -> None:
        """Take a SoC in that is known otherwise, with its standard deviation [%]."""
        self._merge("unclear")
        self._is_untried = False
        self._filters[0].anchor(soc_pct, std_pct)

    def rested(self) -> None:
        """Take note of a long rest: slow polarisation has decayed, so the bias is smaller."""
        for each in self._filters:
            each.rested()

    @property
    def is_lost(self) -> bool:
        """Whether the filter cannot be trusted any more and is to be started anew."""
        return self._outlier_s > DIVERGED_S or not all(each.is_sound for each in self._filters)

    @property
    def soc_pct(self) -> float:
        """State of charge [%], within 0–100."""
        if len(self._filters) == 1:
            return self._filters[0].soc_pct
        return self._mean([each.soc_pct for each in self._filters])

    @property
    def soc_std_pct(self) -> float:
        """Its standard deviation [%], the spread between the stories included."""
        if len(self._filters) == 1:
            return self._filters[0].soc_std_pct
        mean = self.soc_pct
        return math.sqrt(
            self._mean([each.soc_std_pct**2 + (each.soc_pct - mean) ** 2 for each in self._filters])
        )

    @property
    def offset_a(self) -> float:
        """Estimated offset of the current sensor [A]."""
        if len(self._filters) == 1:
            return self._filters[0].offset_a
        return self._mean([each.offset_a for each in self._filters])

    def offset_pct(self, seconds: float) -> float:
        """Return the SoC that the offset alone would feign in some seconds [%]."""
        if len(self._filters) == 1:
            return self._filters[0].offset_pct(seconds)
        return self._mean([each.offset_pct(seconds) for each in self._filters])

    def count_std_pct(self, start_var_pct2: float, hours: float, moved_pct: float) -> float:
        """Return the standard deviation of counting alone [%]; see `SocEkf.count_std_pct`."""
        return self._filters[0].count_std_pct(start_var_pct2, hours, moved_pct)

    def state(self) -> HypothesisFilterState:
        """Return what is to be remembered."""
        return HypothesisFilterState.model_construct(
            filters=[each.state() for each in self._filters],
            is_untried=self._is_untried,
            log_odds=self._log_odds,
            open_s=self._open_s,
            outlier_s=self._outlier_s,
            verdict=self.verdict,
        )

    def restore(self, state: HypothesisFilterState) -> None:
        """Go on from a state.

        Raises
        ------
        InputError
            If it is not that of such filters.
        """
        if not state.filters:
            raise InputError("holds no filter", field="belief.filters")
        filters = [self._copy(each) for each in state.filters]
        if not all(each.is_sound and 0.0 <= each.soc_pct <= 100.0 for each in filters):
            raise InputError("holds no covariance, or no SoC", field="belief.filters")
        self._filters = filters
        self._is_untried = state.is_untried
        self._log_odds = min(max(state.log_odds, -50.0), 50.0)
        self._open_s = state.open_s
        self._outlier_s = state.outlier_s
        self.verdict = state.verdict

    # --- inside -----------------------------------------------------------------------------

    def _copy(self, state: FilterState) -> SocEkf:
        copy = self._make()
        copy.restore(state)
        return copy

    @property
    def _second(self) -> float:
        """Probability of the second story."""
        return 1.0 / (1.0 + math.exp(-self._log_odds))

    def _mean(self, values: Sequence[float]) -> float:
        return (1.0 - self._second) * values[0] + self._second * values[1]

    def _open(self, other: SocEkf, log_odds: float) -> None:
        """Let another filter tell a second story."""
        self._filters.append(other)
        self._log_odds = log_odds
        self._open_s = 0.0

    def _try(self, measurement: Measurement) -> None:
        """Set the story beside a given SoC that it is wrong, and only the voltage is known."""
        self._is_untried = False
        if len(self._filters) == 1:
            told_wrong = self._make()
            told_wrong.start(measurement.soc_pct, UNKNOWN_SOC_STD_PCT)
            self._open(told_wrong, WRONG_LOG_ODDS)

    @property
    def _is_clear(self) -> bool:
        """Whether the voltages leave one story only.

        That a given SoC is wrong is so unlikely from the beginning that this alone must not end it.
        """
        unlikely = 0.0 if self.verdict == "open" else WRONG_LOG_ODDS
        return self._log_odds > CLEAR_LOG_ODDS or self._log_odds < unlikely - CLEAR_LOG_ODDS

    def _settle(self, story: int, *, is_doubted: bool = False) -> bool:
        """Keep one of two stories; return whether the SoC believed so far was wrong."""
        self._filters = [self._filters[story]]
        if self.verdict != "open":
            return is_doubted or story == 1
        self.verdict = "moved" if story else "parked"
        return is_doubted

    def _merge(self, verdict: Verdict) -> None:
        """Replace two filters by one with their mean and spread, weighed by the odds."""
        if len(self._filters) == 1:
            return
        states = [each.state() for each in self._filters]
        weights = (1.0 - self._second, self._second)
        xs, ps = [np.array(each.x) for each in states], [np.array(each.p) for each in states]
        x = weights[0] * xs[0] + weights[1] * xs[1]
        p = sum(
            weight * (cov + np.outer(at - x, at - x))
            for weight, at, cov in zip(weights, xs, ps, strict=True)
        )
        likelier = states[int(self._second > 0.5)]
        self._filters = [
            self._copy(likelier.model_copy(update={"x": x.tolist(), "p": np.asarray(p).tolist()}))
        ]
        if self.verdict == "open":
            self.verdict = verdict

    def _watch(self, since: Since) -> None:
        """Note for how long every voltage has been an outlier, to all filters."""
        if all(each.was_outlier for each in self._filters):
            self._outlier_s += min(since.seconds, OUTLIER_STEP_AT_MOST_S)
        else:
            self._outlier_s = 0.0
