"""The answer of a judgement, in three lines."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from cangauge._text import duration, number
from cangauge.extras.judge.faults import FAULTS
from cangauge.model.model_file import PRIOR_MADE_BY

if TYPE_CHECKING:
    from cangauge.extras.judge.result import FoundFault, Judgement, Moment, Piece

EPOCH_S: Final = 1e8
"""Stamps from here on are absolute [s since 1970]; smaller ones count from the log's own start."""
OFF_PCT: Final = 3.0
"""Error from which a gauge is off [% SoC]."""
STOOD_PCT: Final = 5.0
"""Least charge for which an earlier standstill is reported [%]."""
SURE: Final = 1.96
"""Half width of an interval of 95 % in standard deviations."""
DOUBT: Final = 0.1
"""Least probability of an alternative that is reported."""
ABOVE_PCT: Final = 100.05
"""Published SoC beyond what rounds to 100 % [%]."""

NOTHING: Final = "Nothing to do."
UNKNOWN: Final = (
    "Log one hour of rest and one full charge until its end: they settle whether the SoC, the"
    " current or the voltage is wrong."
)
RESET_AT_FULL: Final = (
    "The pack was charged full in these logs: check at which voltage and current the gauge sets"
    " itself to 100 %."
)
BY_CHARGE: Final = (
    "Add a log of one full charge until its end: it settles the SoC, which the flat voltage of LFP"
    " cells does not."
)
BY_MODEL: Final = (
    "Fit a model of the pack (`cangauge fit`) to drives whose SoC is known, and judge with -m: a"
    " typical cell leaves the SoC open by several percent."
)
BY_REST: Final = (
    "Add a log with an hour of rest after a drive of 40 % or more, or of one full charge until its"
    " end: it settles the SoC."
)
ITS_SENSOR: Final = " Such a log also shows whether the current sensor is off."


def lines_of(judgement: Judgement) -> list[str]:
    """Return the error now, what happened before and why, and what to do next."""
    past = " ".join(_past(judgement))
    return [_now(judgement), *([past] if past else []), _next_step(judgement)]


def _now(judgement: Judgement) -> str:
    error, std = judgement.error_pct, judgement.error_std_pct
    its_error = f"{signed(error)} ± {number(std, 1)} % SoC"
    last = judgement.pieces[-1]
    if last.stands_at_pct is not None:
        return (
            f"The gauge stands still at {number(last.stands_at_pct, 1)} % since"
            f" {moment(judgement, last.begin)}, while {number(last.moved_pct, 0)} % of the charge"
            f" moved: its error is {its_error} now."
        )
    if judgement.verdict == "agrees":
        return f"The gauge is right: its error is {its_error} now."
    if judgement.verdict == "off":
        return f"The gauge reads {_wrong(error, std)} now."
    if abs(error) > SURE * std:
        return (
            f"The gauge probably reads {_wrong(error, std)} now; that it is off by more than"
            f" {number(OFF_PCT, 0)} % is not certain."
        )
    return (
        "These logs do not show whether the gauge is right: its error lies between"
        f" {signed(error - SURE * std)} and {signed(error + SURE * std)} % SoC now."
    )


def _past(judgement: Judgement) -> Iterator[str]:
    """Yield what the gauge did before where it was not as it is now, and the causes."""
    names = [fault.name for fault in judgement.faults]
    most = max(float(np.nanmax(np.r_[-1.0, each])) for each in judgement.published_pct)
    if most > ABOVE_PCT:
        yield f"It published up to {number(most, 1)} %."
    others = [k for k, piece in enumerate(judgement.pieces[:-1]) if _is_other(judgement, piece)]
    if others:
        last, after = judgement.pieces[others[-1]], judgement.pieces[others[-1] + 1]
        begin, until = moment(judgement, last.begin), moment(judgement, last.end)
        if last.stands_at_pct is not None:
            yield (
                f"It stood at {number(last.stands_at_pct, 1)} % from {begin} until {until}, while"
                f" {number(last.moved_pct, 0)} % of the charge moved."
            )
        else:
            # The SoC by a voltage under load jumps with the load.
            is_set = after.stands_at_pct is None and "voltage_table" not in names
            jump = ", when it set itself" if is_set else ""
            yield f"It was {_wrong(last.error_pct, last.std_pct)} until {until}{jump}."
    causes = [_cause(judgement, fault) for fault in judgement.faults if FAULTS[fault.name].words]
    if causes:
        yield f"Cause: {'; '.join(causes)}."
    elif judgement.verdict == "off" and not judgement.faults:
        yield "The cause is not known."


def _is_other(judgement: Judgement, piece: Piece) -> bool:
    """Return whether a piece was wrong in another way than the gauge is now."""
    if piece.stands_at_pct is not None:
        return piece.moved_pct > STOOD_PCT
    is_wrong = abs(piece.error_pct) > OFF_PCT + piece.std_pct
    return is_wrong and abs(piece.error_pct - judgement.error_pct) > OFF_PCT


def _cause(judgement: Judgement, fault: FoundFault) -> str:
    kind, (low, high) = FAULTS[fault.name], fault.interval
    sizes = number(abs(fault.size), kind.digits), number((high - low) / (2.0 * SURE), kind.digits)
    cause = kind.words.format(
        size=" ± ".join(sizes) + ("" if fault.unit == "-" else f" {fault.unit}"),
        side=kind.sides[fault.size < 0.0],
        cell=None if judgement.weakest is None else judgement.weakest.number,
    )
    since = "" if fault.since is None else f" since {moment(judgement, fault.since)}"
    return f"{cause}{since} ({number(100.0 * fault.probability, 0)} %)"


def _next_step(judgement: Judgement) -> str:
    names = [fault.name for fault in judgement.faults if fault.name != "stands_still"]
    if judgement.pieces[-1].stands_at_pct is not None:
        names = ["stands_still"]
    elif judgement.verdict == "cannot_tell":
        return _telling(judgement)
    elif judgement.verdict == "agrees" and set(names) <= {"start_or_reset"}:
        return NOTHING
    if not names:
        return UNKNOWN
    if names[0] == "start_or_reset" and judgement.was_full:
        return RESET_AT_FULL
    return FAULTS[names[0]].next_step


def _telling(judgement: Judgement) -> str:
    """Return the one log that would tell."""
    offset = sum(
        fit.share
        for fit in judgement.fits
        if "current_offset" in [each.name for each in fit.faults]
    )
    if judgement.model.chemistry != "lfp" and judgement.model.made.by == PRIOR_MADE_BY:
        return BY_MODEL
    step = BY_CHARGE if judgement.model.chemistry == "lfp" else BY_REST
    return step + (ITS_SENSOR if offset > DOUBT else "")


def moment(judgement: Judgement, at: Moment) -> str:
    """Return a moment as a date, or as the time into its log."""
    log = judgement.logs[at.log]
    if at.time_s >= EPOCH_S:
        return datetime.fromtimestamp(at.time_s, UTC).strftime("%a %d %b %H:%M UTC")
    after_s = at.time_s - float(log.time_s[0])
    return f"{duration(after_s)} into {log.name}" if after_s > 60.0 else f"the start of {log.name}"


def _wrong(error_pct: float, std_pct: float) -> str:
    side = "too high" if error_pct > 0.0 else "too low"
    return f"{number(abs(error_pct), 1)} ± {number(std_pct, 1)} % SoC {side}"


def signed(value: float, digits: int = 1) -> str:
    """Return a number with its sign."""
    text = number(value, digits)
    return text if value < 0.0 else f"+{text}"
