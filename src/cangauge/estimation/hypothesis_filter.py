"""Static multiple-model filter over at most two hypotheses of the SoC.

There are two hypotheses in two cases:

- After an unobserved interval (see `counting`): under *parked* the SoC has hardly changed, under
  *moved* by an unknown amount.
- After an initial SoC was given: the first hypothesis accepts it, the second rejects it and starts
  from the first voltage.

Each hypothesis has its own filter, and both use every voltage. The second knows less: what the
first knows more is its prior alone. If the first is right, the difference of their SoCs has
therefore the variance P2 − P1 (Hausman, Econometrica 46 (1978) 1251), and with it the odds are
those of the two priors given all voltages (Savage–Dickey ratio; Verdinelli, Wasserman, J. Am. Stat.
Assoc. 90 (1995) 614). Likelihoods summed over voltages would count an error that lasts, such as
that of the curve, as new evidence each second. The output is the mean weighted by the odds; the
spread between the hypotheses is part of its standard deviation. The SoC therefore moves toward the
likelier hypothesis as evidence grows, without a jump. Once the odds are clear the other hypothesis
is dropped, and also once it no longer counts in the result. Until then both are kept: merged while
they know different things, the same voltages would count again for their mean. A rejected initial
SoC has no influence on the result.

A mixture of a narrow and a wide hypothesis is no normal distribution: what is improbable and far
away makes up most of its variance. The standard deviation stated is therefore half the half-width
of the interval about the mean that contains as much as two of a normal distribution's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from cangauge.errors import InputError
from cangauge.estimation.counting import moved_log_odds, moved_std_pct
from cangauge.estimation.ekf import (
    HIGHEST_PCT,
    LOWEST_PCT,
    SOC,
    UNKNOWN_SOC_STD_PCT,
    SocEkf,
)
from cangauge.estimation.measurement_noise import Measurement
from cangauge.estimation.state import ChargeSinceUpdate, EkfState, HypothesisFilterState, Verdict

CLEAR_LOG_ODDS = math.log(1000.0)
"""Beyond this the less likely hypothesis is dropped."""

FORGOTTEN = 0.01
"""Below this part of the second's variance the first hypothesis knows no more than the second, and
the odds stay."""

NEGLIGIBLE = 0.02
"""The less likely hypothesis is dropped where the variance of both differs by less than this part
from that of the other: σ changes by less than 1 %."""

LOG_ODDS_AT_MOST = 50.0

TWO_SIGMA = math.erf(math.sqrt(2.0))
"""Probability within two standard deviations of a normal distribution: 95.45 %."""

LAST_STEP_PCT = 1e-6
"""Last step to the half-width of a mixture [%]: by Newton's method its error is the square."""

NARROWEST_PCT = 1e-9
"""Least standard deviation in a mixture [%]."""

WRONG_LOG_ODDS = -math.log(99.0)
"""Prior log odds that a given SoC is wrong, such as one of another pack, day or scale: an
assumption, one in a hundred."""

DIVERGED_S = 180.0
"""Time without a voltage that is not an outlier, after which the filter counts as lost [s]."""

OUTLIER_STEP_AT_MOST_S = 10.0
"""Upper bound of what one outlier adds to that time [s]."""


class HypothesisFilter:
    """Filter of one or two hypotheses of the SoC.

    Parameters
    ----------
    make_ekf : callable
        Returns a new `SocEkf`.

    Attributes
    ----------
    verdict : str
        Result of the test on the last unobserved interval (`state.Verdict`).
    """

    def __init__(self, make_ekf: Callable[[], SocEkf]) -> None:
        self._make_ekf = make_ekf
        # The null hypothesis first: parked, or the given SoC is right.
        self._filters = [make_ekf()]
        self._is_untested = False
        self._log_odds = 0.0
        self._prior_log_odds = 0.0
        self._wide_std_pct = UNKNOWN_SOC_STD_PCT
        self._outlier_s = 0.0
        # σ stated of two hypotheses [%]; NaN until it is needed.
        self._stated_pct = math.nan
        self.verdict: Verdict = ""

    def start(self, soc_pct: float, std_pct: float) -> None:
        """Restart from a SoC with its standard deviation [%]."""
        self._stated_pct = math.nan
        self._filters = [self._make_ekf()]
        self._filters[0].start(soc_pct, std_pct)
        self._is_untested = std_pct < UNKNOWN_SOC_STD_PCT
        self._outlier_s = 0.0
        if self.verdict == "open":
            self.verdict = "unclear"

    def predict(self, since: ChargeSinceUpdate) -> None:
        """Propagate all hypotheses over the charge counted since the last call."""
        self._stated_pct = math.nan
        parked_var_pct2 = since.gap_var_pct2 + since.unseen_var_pct2
        variances = [parked_var_pct2, parked_var_pct2]
        if since.away_s:
            self._merge("unclear")
            moved_pct = moved_std_pct(since.away_s)
            moved = self._restored(self._filters[0].snapshot())
            self._add(moved, moved_log_odds(since.away_s), moved_pct)
            self.verdict = "open"
            variances[1] = since.gap_var_pct2 + moved_pct * moved_pct
        for each, variance in zip(self._filters, variances, strict=False):
            each.predict(
                since.seconds, since.discharged_pct, since.moved_pct, variance, since.away_s
            )

    def update(self, measurement: Measurement, since: ChargeSinceUpdate) -> bool:
        """Update with one voltage.

        Returns
        -------
        bool
            Whether it shows that the SoC was wrong until now.
        """
        self._stated_pct = math.nan
        if self._is_untested:
            self._is_untested = False
            if len(self._filters) == 1:
                rejecting = self._make_ekf()
                rejecting.start(measurement.soc_pct, UNKNOWN_SOC_STD_PCT)
                self._add(rejecting, WRONG_LOG_ODDS, UNKNOWN_SOC_STD_PCT)
        first, second = self._filters[0], self._filters[-1]
        is_contradicted = is_second_contradicted = first.update(measurement, since.seconds)
        if second is not first:
            is_second_contradicted = second.update(measurement, since.seconds)
        if first.was_outlier and second.was_outlier:
            self._outlier_s += min(since.seconds, OUTLIER_STEP_AT_MOST_S)
        else:
            self._outlier_s = 0.0
        if second is first:
            return is_contradicted
        is_open = self._weigh()
        if is_contradicted != is_second_contradicted:
            return self._decide(int(is_contradicted))
        # The prior odds against a wrong initial SoC alone must not count as a clear decision.
        prior = 0.0 if self.verdict == "open" else self._prior_log_odds
        is_clear = self._log_odds > CLEAR_LOG_ODDS or self._log_odds < prior - CLEAR_LOG_ODDS
        if is_open and not (is_contradicted or is_clear):
            return False
        return self._decide(int(self._log_odds > 0.0), is_contradicted=is_contradicted)

    def correct(self, soc_pct: float, std_pct: float) -> None:
        """Update with an external SoC reference and its standard deviation [%]."""
        self._stated_pct = math.nan
        self._merge("unclear")
        self._is_untested = False
        self._filters[0].correct(soc_pct, std_pct)

    def shrink_bias(self) -> None:
        """Reduce the slow bias of all hypotheses after a long rest."""
        self._stated_pct = math.nan
        for each in self._filters:
            each.shrink_bias()

    def is_lost(self) -> bool:
        """Return whether the filter must be restarted: only outliers for long, or invalid."""
        if self._outlier_s > DIVERGED_S:
            return True
        for each in self._filters:  # noqa: SIM110 - called for every voltage
            if not each.is_valid():
                return True
        return False

    def soc_after(self, since: ChargeSinceUpdate) -> tuple[float, float]:
        """Return SoC and standard deviation [%] after the charge counted since the last update."""
        soc_pct, std_pct, offset_pct = self._soc_and_std_pct(since.seconds - since.away_s)
        soc_pct -= since.discharged_pct - offset_pct
        since_var_pct2 = since.gap_var_pct2 + since.unseen_var_pct2
        if since.away_s:
            odds = math.exp(moved_log_odds(since.away_s))
            moved_pct = moved_std_pct(since.away_s)
            since_var_pct2 += odds / (1.0 + odds) * (moved_pct * moved_pct)
        return min(max(soc_pct, 0.0), 100.0), math.sqrt(std_pct * std_pct + since_var_pct2)

    def _soc_and_std_pct(self, counted_s: float) -> tuple[float, float, float]:
        """Return SoC, the σ stated, and the charge that the offset adds in a time [%]."""
        if len(self._filters) == 1:
            return self._filters[0].summary(counted_s)
        first, second = (each.summary(counted_s) for each in self._filters)
        soc_pct, _, offset_pct = map(self._mean, zip(first, second, strict=True))
        if math.isnan(self._stated_pct):
            self._stated_pct = self._stated_std_pct(
                [(abs(soc - soc_pct), std) for soc, std, _ in (first, second)]
            )
        return soc_pct, self._stated_pct, offset_pct

    @property
    def soc_pct(self) -> float:
        """State of charge [%], within 0–100."""
        if len(self._filters) == 1:
            return self._filters[0].soc_pct
        return self._mean([each.soc_pct for each in self._filters])

    @property
    def offset_a(self) -> float:
        """Estimated offset of the current sensor [A]."""
        if len(self._filters) == 1:
            return self._filters[0].offset_a
        return self._mean([each.offset_a for each in self._filters])

    @property
    def offset_std_a(self) -> float:
        """Standard deviation of that offset, under the likelier hypothesis [A]."""
        return self.likelier.offset_std_a

    @property
    def likelier(self) -> SocEkf:
        """Filter of the likelier hypothesis."""
        return self._filters[int(len(self._filters) > 1 and self._log_odds > 0.0)]

    def snapshot(self) -> HypothesisFilterState:
        """Return a copy of the state."""
        return HypothesisFilterState(
            [each.snapshot() for each in self._filters],
            self._is_untested,
            self._log_odds,
            self._outlier_s,
            self.verdict,
            self._prior_log_odds,
            self._wide_std_pct,
        )

    def restore(self, state: HypothesisFilterState) -> None:
        """Continue from a state.

        Raises
        ------
        InputError
            If a hypothesis is not a valid filter with a SoC within 0–100 %.
        """
        filters = [self._restored(each) for each in state.hypotheses]
        if not all(
            each.is_valid() and LOWEST_PCT <= each.soc_pct <= HIGHEST_PCT for each in filters
        ):
            raise InputError(
                f"not a valid filter, or a SoC outside {LOWEST_PCT:g} … {HIGHEST_PCT:g} %",
                field="filter.hypotheses",
            )
        self.resume(state)

    def resume(self, state: HypothesisFilterState) -> None:
        """Continue from a state that this filter had."""
        self._filters = []
        for each in state.hypotheses:
            self._filters.append(self._make_ekf())
            self._filters[-1].resume(each)
        self._stated_pct = math.nan
        self._is_untested = state.is_untested
        self._log_odds = _bounded(state.log_odds)
        self._prior_log_odds = _bounded(state.prior_log_odds)
        self._wide_std_pct = state.wide_std_pct
        self._outlier_s = state.outlier_s
        self.verdict = state.verdict

    def _restored(self, state: EkfState) -> SocEkf:
        ekf = self._make_ekf()
        ekf.restore(state)
        return ekf

    def _weigh(self) -> bool:
        """Set the odds from all voltages; return whether the less likely one still counts."""
        (soc1_pct, std1_pct, _), (soc2_pct, std2_pct, _) = (
            each.summary(0.0) for each in self._filters
        )
        first_pct2, second_pct2 = std1_pct * std1_pct, std2_pct * std2_pct
        more_pct2 = second_pct2 - first_pct2
        apart_pct = soc2_pct - soc1_pct
        if more_pct2 > FORGOTTEN * second_pct2:
            square = apart_pct * apart_pct / more_pct2
            ratio = self._wide_std_pct * math.sqrt(more_pct2) / second_pct2
            self._log_odds = _bounded(self._prior_log_odds + 0.5 * square - math.log(ratio))
        second = self._second_probability()
        spread_pct2 = (1.0 - second) * second * apart_pct * apart_pct
        if second > 0.5:
            return abs(spread_pct2 - (1.0 - second) * more_pct2) > NEGLIGIBLE * second_pct2
        return abs(spread_pct2 + second * more_pct2) > NEGLIGIBLE * first_pct2

    def _second_probability(self) -> float:
        return 1.0 / (1.0 + math.exp(-self._log_odds))

    def _stated_std_pct(self, hypotheses: Sequence[tuple[float, float]]) -> float:
        """Return half of the half-width that contains `TWO_SIGMA` of the probability [%].

        Parameters
        ----------
        hypotheses : sequence of two pairs of floats
            Distance from the mean, and standard deviation, of each [%].
        """
        (away1, std1), (away2, std2) = hypotheses
        low, high = 0.0, max(away1 + 3.0 * std1, away2 + 3.0 * std2)
        width = min(2.0 * self._mean((std1, std2)), high)
        step = high
        # Newton's method, halving the bracket where it would leave it.
        while abs(step) > LAST_STEP_PCT:
            first, second = _within(width, away1, std1), _within(width, away2, std2)
            missing = TWO_SIGMA - self._mean((first[0], second[0]))
            low, high = (width, high) if missing > 0.0 else (low, width)
            density = self._mean((first[1], second[1]))
            following = width + missing / density if density > 0.0 else math.inf
            if not low < following < high:
                following = 0.5 * (low + high)
            step, width = following - width, following
        return 0.5 * width

    def _mean(self, values: Sequence[float]) -> float:
        second = self._second_probability()
        return (1.0 - second) * values[0] + second * values[1]

    def _add(self, ekf: SocEkf, log_odds: float, wide_std_pct: float) -> None:
        """Open a second hypothesis, with its prior and standard deviation of the SoC [%]."""
        self._filters.append(ekf)
        self._stated_pct = math.nan
        self._log_odds = self._prior_log_odds = log_odds
        self._wide_std_pct = wide_std_pct

    def _decide(self, accepted: int, *, is_contradicted: bool = False) -> bool:
        """Keep one hypothesis; return whether this changes the SoC assumed so far."""
        self._filters = [self._filters[accepted]]
        if self.verdict != "open":
            return is_contradicted or accepted == 1
        self.verdict = "moved" if accepted else "parked"
        return is_contradicted

    def _merge(self, verdict: Verdict) -> None:
        """Replace two hypotheses by one with their mean, covariance, and the σ stated.

        The moments of the mixture, with the SoC scaled: what is improbable and far away makes up
        most of the mixture's variance, and is given up here as it is not in the σ stated.
        """
        if len(self._filters) == 1:
            return
        std_pct = self._soc_and_std_pct(0.0)[1]
        first, second = (each.snapshot() for each in self._filters)
        x = [self._mean(pair) for pair in zip(first.x, second.x, strict=True)]
        away = [[at - mean for at, mean in zip(each.x, x, strict=True)] for each in (first, second)]
        p = [
            [
                self._mean((a + d1 * e1, b + d2 * e2))
                for a, b, e1, e2 in zip(row1, row2, *away, strict=True)
            ]
            for row1, row2, d1, d2 in zip(first.p, second.p, *away, strict=False)
        ]
        scale = std_pct / math.sqrt(p[SOC][SOC]) if p[SOC][SOC] > 0.0 else 1.0
        p[SOC] = [scale * value for value in p[SOC]]
        for row in p:
            row[SOC] *= scale
        likelier = second if self._log_odds > 0.0 else first
        self._filters = [self._restored(replace(likelier, x=x, p=p))]
        if self.verdict == "open":
            self.verdict = verdict


def _within(width: float, away: float, std: float) -> tuple[float, float]:
    """Return the probability of ±width of a normal distribution with mean `away`, and its slope."""
    scale = max(std, NARROWEST_PCT) * math.sqrt(2.0)
    low, high = (-width - away) / scale, (width - away) / scale
    density = (math.exp(-(low * low)) + math.exp(-(high * high))) / (scale * math.sqrt(math.pi))
    return 0.5 * (math.erf(high) - math.erf(low)), density


def _bounded(log_odds: float) -> float:
    return min(max(log_odds, -LOG_ODDS_AT_MOST), LOG_ODDS_AT_MOST)
