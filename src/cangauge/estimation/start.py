"""Which start is right: one or two Kalman filters, weighed by their likelihoods.

A start that was given may be wrong, and after an interval without samples the car may have been
charged or driven. Both are the same question: a narrow hypothesis (the SoC is the stated one) and a
wide one (it is not), each with a filter of its own that uses every voltage. With the log-odds

    ln p(wide)/p(narrow) = ln prior odds + Σ ln N(y; 0, S) of the wide − of the narrow one

the result is the mean weighted by both probabilities, and its variance includes the spread between
them (static multiple model; Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking
and Navigation, 2001, ch. 11.6). A hypothesis is dropped once its probability no longer counts.

A filter linearises the curve at one SoC. On a plateau, where the SoC is uncertain against voltage
by more than `LINEAR_PCT`, a bend of the curve costs the wide one evidence, although another SoC may
agree with all voltages: a start 20 % off was thus "proved" on LFP. There the odds do not fall below
the prior ones until the wide filter has found the SoC by the voltages (`FOUND_STD_PCT`). Evidence
against the narrow one counts as soon as it prevails.
"""

from __future__ import annotations

import math
from typing import Any, Final

from cangauge.estimation.counting import UNKNOWN_STD_PCT
from cangauge.estimation.ekf import LINEAR_PCT, SOC, SocFilter
from cangauge.estimation.state import Block
from cangauge.model.extended import OnlineModel

UNKNOWN_PCT: Final = 50.0
"""Mean of an unknown start [%]."""

WRONG_STD_PCT: Final = 25.0
"""Standard deviation of a given start that is wrong [%]: about that of any SoC."""

WRONG_PRIOR: Final = 0.3
"""Prior probability that the SoC is not the stated one, because a given start is wrong or the car
was charged or driven unobserved. From 0.2 to 0.5 the mean error of right starts grows by 0.1 %, and
that of starts 20 % too low falls by 0.3 % (development packs)."""

FOUND_STD_PCT: Final = 3.0
"""Standard deviation of the wide hypothesis up to which its evidence can prove the narrow one right
[%]: half a step between neighbouring bends of an LFP curve."""

DROPPED_LOG_ODDS: Final = 20.0
"""A hypothesis is dropped at these odds: one in 5·10⁸ moves no result by 1e-6 %."""

CLEAR_LOG_ODDS: Final = math.log(100.0)
"""Odds from which a hypothesis counts as decided, in messages."""


class Hypotheses:
    """One or two filters of the same model, and their odds.

    Parameters
    ----------
    model : OnlineModel
    soc_pct : float, optional
        Start [%]; None: unknown.
    soc_std_pct : float
        Standard deviation of a given start, if it is right [%].
    is_doubtful : bool
        Whether a given start may be wrong.

    Attributes
    ----------
    filters : list of SocFilter
        The narrow hypothesis first.
    decision : int
        −1: the narrow hypothesis is right, 1: the wide one, 0: not decided.
    """

    def __init__(
        self,
        model: OnlineModel,
        soc_pct: float | None = None,
        soc_std_pct: float = 1.0,
        *,
        is_doubtful: bool = True,
    ) -> None:
        self.model = model
        self.prior_log_odds = 0.0
        self.decision = 0
        if soc_pct is None:
            self.filters = [SocFilter(model, UNKNOWN_PCT, UNKNOWN_STD_PCT)]
            return
        self.filters = [SocFilter(model, soc_pct, soc_std_pct)]
        if is_doubtful and soc_std_pct < WRONG_STD_PCT:
            self.filters.append(SocFilter(model, soc_pct, WRONG_STD_PCT))
            self.prior_log_odds = _log_odds(WRONG_PRIOR)

    @property
    def log_odds(self) -> float:
        """Log-odds of the wide hypothesis; −∞ with one filter only."""
        if len(self.filters) == 1:
            return -math.inf
        narrow, wide = self.filters
        gained = wide.evidence - narrow.evidence
        is_plateau = self.model.noise.soc_std_pct > LINEAR_PCT
        if is_plateau and wide.P[SOC, SOC] > FOUND_STD_PCT**2:
            gained = max(gained, 0.0)
        return self.prior_log_odds + gained

    @property
    def wide_probability(self) -> float:
        """Probability of the wide hypothesis."""
        return 1.0 / (1.0 + math.exp(-self.log_odds))

    @property
    def is_rejected(self) -> bool:
        """Whether the narrow hypothesis is the less likely one."""
        return self.log_odds > 0.0 if len(self.filters) == 2 else self.decision > 0

    @property
    def likelier(self) -> SocFilter:
        """The filter of the likelier hypothesis."""
        return self.filters[-1 if self.log_odds > 0.0 else 0]

    def predict(self, seconds: float, discharged_pct: float, variance_pct2: float = 0.0) -> None:
        """Propagate all filters; see `SocFilter.predict`."""
        for each in self.filters:
            each.predict(seconds, discharged_pct, variance_pct2)

    def update(self, block: Block) -> None:
        """Update all filters with a block, and drop a hypothesis that no longer counts."""
        for each in self.filters:
            each.update(block)
        if len(self.filters) == 2 and abs(self.log_odds) > CLEAR_LOG_ODDS:
            self.decision = 1 if self.log_odds > 0.0 else -1
            if abs(self.log_odds) > DROPPED_LOG_ODDS:
                self.filters = [self.likelier]

    def correct(self, soc_pct: float, soc_std_pct: float) -> None:
        """Continue with the likelier filter alone, corrected by a SoC that is known [%]."""
        self.filters = [self.likelier]
        self.filters[0].correct(soc_pct, soc_std_pct)

    def doubt(self, std_pct: float, away_s: float = 0.0, parked_std_pct: float = 0.0) -> None:
        """Allow for the hypothesis that the SoC has become another one, of prior `WRONG_PRIOR`.

        An older question that the voltage has not decided stays open: its wide hypothesis takes
        the new one in.

        Parameters
        ----------
        std_pct : float
            Standard deviation of the SoC under it [%].
        away_s : float
            Time without samples [s].
        parked_std_pct : float
            Standard deviation of the SoC if it has not [%].
        """
        if len(self.filters) == 2 and abs(self.log_odds) < CLEAR_LOG_ODDS:
            neither = (1.0 - self.wide_probability) * (1.0 - WRONG_PRIOR)
            self.prior_log_odds = _log_odds(1.0 - neither)
            self.filters[1].evidence = self.filters[0].evidence  # it is in the prior now
        else:
            self.filters = [self.likelier, self.likelier.copy()]
            self.prior_log_odds = _log_odds(WRONG_PRIOR)
        self.decision = 0
        narrow, wide = self.filters
        narrow.predict(0.0, 0.0, parked_std_pct**2, away_s)
        wide.predict(0.0, 0.0, std_pct**2, away_s)

    def soc_after(
        self, seconds: float, discharged_pct: float, variance_pct2: float = 0.0
    ) -> tuple[float, float]:
        """Return the predicted SoC and its standard deviation [%], both hypotheses weighed."""
        moments = [
            each.soc_moments_after(seconds, discharged_pct, variance_pct2) for each in self.filters
        ]
        (soc_pct, variance), (wide_pct, wide_var) = moments[0], moments[-1]
        if len(moments) == 2:
            p = self.wide_probability
            mean_pct = (1.0 - p) * soc_pct + p * wide_pct
            variance = (1.0 - p) * (variance + (soc_pct - mean_pct) ** 2) + p * (
                wide_var + (wide_pct - mean_pct) ** 2
            )
            soc_pct = mean_pct
        return soc_pct, math.sqrt(max(variance, LEAST_VAR_PCT2))

    def is_valid(self) -> bool:
        """Return whether all filters hold usable numbers."""
        return all(each.is_valid() for each in self.filters)

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue."""
        filters = [each.state() for each in self.filters]
        odds = {"prior_log_odds": self.prior_log_odds, "decision": self.decision}
        return {"filters": filters, **odds}

    def resume(self, filters: list[dict[str, Any]], prior_log_odds: float, decision: int) -> None:
        """Continue from a `state` of the same model."""
        new = SocFilter(self.model, UNKNOWN_PCT, UNKNOWN_STD_PCT)
        self.filters = [new.copy().resume(each) for each in filters]
        self.prior_log_odds, self.decision = prior_log_odds, decision

    def take_over(self, before: Hypotheses) -> None:
        """Take over offset and capacity from the filter of another model, before any update."""
        for each in self.filters:
            each.take_over(before.likelier)


LEAST_VAR_PCT2: Final = 1e-6
"""Least variance of the SoC [%²]: the resolution of its frame is 0.001 %."""


def _log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))
