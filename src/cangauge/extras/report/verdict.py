"""The result of a fit, an estimate and an inspection in one sentence; imports no bokeh."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from cangauge._text import NONE_KNOWN, number
from cangauge.estimation.offline import EstimateTable
from cangauge.identify.fit import Identification
from cangauge.inspect.log import TEMPERATURE_SPAN_K, LogInspection
from cangauge.service.offline import RecordedEstimate
from cangauge.types import REASON_WORDS, Reason, Status

SOC_STEP_PCT: Final = 10.0
"""Width of the ranges of SoC that a verdict names [%]."""


MIN_BIN_ROWS: Final = 10
"""Rows below which a range of SoC counts as sparse."""


class Period(NamedTuple):
    """A time without a valid estimate."""

    start_s: float
    end_s: float
    status: Status
    reason: Reason
    """The reason that applied to most of its samples."""

    def __str__(self) -> str:
        """Return the times since the start of the log, and the reason."""
        reason = f" because {REASON_WORDS[self.reason]}" if self.reason else ""
        return f"{self.status.name.lower()} {self.when('from {} to {}')}{reason}"

    def when(self, template: str = "{} … {}") -> str:
        """Return the times since the start of the log as h:mm:ss."""
        return template.format(_clock(self.start_s), _clock(self.end_s))


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def periods(table: EstimateTable) -> list[Period]:
    """Return the times that are degraded or invalid, in sequence, since the first sample."""
    status, time_s = np.asarray(table.status), table.time_s
    edges = np.flatnonzero(np.diff(status)) + 1
    found = []
    for begin, end in zip((0, *edges), (*edges, status.size), strict=True):
        if begin == end or status[begin] not in {Status.DEGRADED, Status.INVALID}:
            continue
        reasons = np.asarray(table.reasons[begin:end]).astype(np.int64)
        counts = {reason: int(np.count_nonzero(reasons & reason)) for reason in Reason}
        most = max(counts, key=counts.__getitem__)
        found.append(
            Period(
                float(time_s[begin] - time_s[0]),
                float(time_s[min(end, status.size - 1)] - time_s[0]),
                Status(int(status[begin])),
                most if counts[most] else Reason.NONE,
            )
        )
    return found


def estimate_verdict(estimate: RecordedEstimate, found: list[Period]) -> str:
    """Return how far the SoC is from the log's own, and when and why it is not valid.

    Parameters
    ----------
    estimate : RecordedEstimate
    found : list of Period
        Of its table.
    """
    table, scores = estimate.table, estimate.scores
    known = np.flatnonzero(np.isfinite(table.soc_pct))
    if not known.size:
        return "No sample gives a state of charge."
    reference = estimate.recorded.soc_pct
    if reference is not None and np.isfinite(reference).sum() > 1 and scores.soc_max_pct:
        text = f"SoC within {number(scores.soc_max_pct, 1, '%')} of the log's own"
        text += f" ({number(scores.soc_mae_pct, 1, '%')} on average)"
    else:
        first, last = table.soc_pct[known[0]], table.soc_pct[known[-1]]
        std = number(2.0 * table.soc_std_pct[known[-1]], 1, "%")
        text = f"SoC from {number(first, 1)} to {number(last, 1, '%')} (±{std} at the end, 2σ)"
    text += f"; {_valid_share(scores.valid_fraction)}"
    if found:
        longest = max(found, key=lambda period: period.end_s - period.start_s)
        text += f"; {longest}"
        if len(found) > 1:
            text += f", the longest of {len(found)} periods"
    return f"{text}."


def _valid_share(fraction: float) -> str:
    if fraction in {0.0, 1.0}:
        return "never valid" if fraction == 0.0 else "valid throughout"
    # A share that is not whole must not round to 0 or 100 %.
    return f"valid in {number(min(max(100.0 * fraction, 0.1), 99.9), 1, '%')} of the samples"


def fit_verdict(result: Identification) -> str:
    """Return the range of SoC that the fit's rows cover, its error there, and what they lack."""
    soc = np.concatenate([item.rows.soc_pct for item in result.fits])
    covered = _covered(soc)
    error = number(result.model.noise.voltage_mae_pct, 2, "%")
    if error == NONE_KNOWN:
        error = f"{number(result.voltage_mae_pct, 2, '%')} on its own rows"
    else:
        error += " on data held out"
    if covered is None:
        return f"Too few rows: no {SOC_STEP_PCT:.0f} % of SoC has {MIN_BIN_ROWS} rows."
    low, high = covered
    text = f"Covers {low:.0f} to {high:.0f} % SoC with a mean voltage error of {error}"
    sides = [f"below {low:.0f} %"] * (low >= SOC_STEP_PCT) + [f"above {high:.0f} %"] * (
        high <= 100.0 - SOC_STEP_PCT
    )
    if sides:
        text += f"; too few rows {' and '.join(sides)}"
    temperatures = np.concatenate([item.rows.temperature_c for item in result.fits])
    if (change_k := float(np.ptp(temperatures))) < TEMPERATURE_SPAN_K:
        text += f"; only {number(change_k, 1, 'K')} of temperature, so kt is not identified"
    return f"{text}."


def _covered(soc_pct: np.ndarray) -> tuple[float, float] | None:
    """Return the longest range of SoC without a sparse step [%]; None if every step is sparse."""
    edges = np.arange(0.0, 100.0 + SOC_STEP_PCT, SOC_STEP_PCT)
    is_dense = np.histogram(np.clip(soc_pct, 0.0, 100.0), edges)[0] >= MIN_BIN_ROWS
    change = np.flatnonzero(np.diff(np.r_[0, is_dense.astype(np.int8), 0]))
    runs = list(zip(change[::2], change[1::2], strict=True))
    if not runs:
        return None
    begin, end = max(runs, key=lambda run: run[1] - run[0])
    # A range is named no wider than its rows: 87 %, not 90 %.
    return max(float(edges[begin]), float(soc_pct.min())), min(
        float(edges[end]), float(soc_pct.max())
    )


def inspect_verdict(found: LogInspection) -> str:
    """Return what the log can identify and what it cannot, with the first reason."""
    names: dict[str, list[str]] = {"yes": [], "partly": [], "no": []}
    for ability in found.abilities:
        names[ability.verdict].append(ability.topic)
    parts = [
        words + ", ".join(names[verdict])
        for verdict, words in (("yes", ""), ("partly", "in part "), ("no", "not "))
        if names[verdict]
    ]
    lacking = next((each for each in found.abilities if each.verdict == "no"), None)
    text = "This log can identify " + "; ".join(parts)
    if names["no"] and not names["yes"] and not names["partly"]:
        text = f"This log cannot identify {', '.join(names['no'])}"
    if lacking is None:
        return f"{text}."
    return f"{text}. {lacking.topic.capitalize()}: {lacking.text.rstrip('.')}."
