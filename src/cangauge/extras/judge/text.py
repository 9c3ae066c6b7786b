"""The answer of a judgement, in three lines."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from cangauge._text import duration, number
from cangauge.extras.judge.faults import FAULTS, OTHERWISE
from cangauge.extras.judge.gauge import LIMIT_PCT
from cangauge.model.model_file import PRIOR_MADE_BY

if TYPE_CHECKING:
    from cangauge.extras.judge.result import FoundFault, Judgement, Moment, Piece

EPOCH_S: Final = 1e8
"""Stamps from here on are absolute [s since 1970]; smaller ones count from the log's own start."""
OFF_PCT: Final = 3.0
"""Error from which a gauge is off [% SoC]."""
AGREES_PCT: Final = 5.0
"""Error below which a gauge agrees, and charge for which an earlier stand is reported [%]."""
NAMED: Final = 0.9
"""Probability from which a fault is named, or a gauge agrees."""
SURE: Final = 1.96
"""Half width of an interval of 95 % in standard deviations."""


def lines_of(judgement: Judgement) -> list[str]:
    """Return the error now, what happened before and why, and what to do next."""
    past = " ".join(_past(judgement))
    return [_now(judgement), *([past] if past else []), _next_step(judgement)]


def _now(judgement: Judgement) -> str:
    last = judgement.pieces[-1]
    error, std = last.error_pct, last.std_pct
    its_error = f"its error is {signed(error)} ± {number(std, 1)} % SoC now."
    if last.stands_at_pct is not None:
        return (
            f"The gauge stands still at {number(last.stands_at_pct, 1)} % since"
            f" {moment(judgement, last.begin)}, while {number(last.moved_pct, 0)} % of the charge"
            f" moved: {its_error}"
        )
    if judgement.verdict == "agrees":
        return f"The gauge is right: {its_error}"
    if judgement.verdict == "off":
        return f"The gauge reads {_wrong(last)} now."
    if abs(error) > SURE * std:
        return (
            f"The gauge probably reads {_wrong(last)} now; that it is off by more than"
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
    if most > 100.0 + LIMIT_PCT:
        yield f"It published up to {number(most, 1)} %."
    others = [k for k, piece in enumerate(judgement.pieces[:-1]) if _is_other(judgement, piece)]
    if others:
        last, after = judgement.pieces[others[-1]], judgement.pieces[others[-1] + 1]
        until = moment(judgement, last.end)
        if last.stands_at_pct is not None:
            yield (
                f"It stood at {number(last.stands_at_pct, 1)} % from"
                f" {moment(judgement, last.begin)} until {until}, while"
                f" {number(last.moved_pct, 0)} % of the charge moved."
            )
        else:
            # The SoC by a voltage under load jumps with the load.
            is_set = after.stands_at_pct is None and "voltage_table" not in names
            yield f"It was {_wrong(last)} until {until}{', when it set itself' if is_set else ''}."
    causes = [_cause(judgement, fault) for fault in judgement.faults if FAULTS[fault.name].words]
    if causes:
        yield f"Cause: {'; '.join(causes)}."
    elif judgement.verdict == "off" and not names:
        yield "The cause is not known."


def _is_other(judgement: Judgement, piece: Piece) -> bool:
    """Return whether a piece was wrong in another way than the gauge is now."""
    if piece.stands_at_pct is not None:
        return piece.moved_pct > AGREES_PCT
    is_wrong = abs(piece.error_pct) > OFF_PCT + piece.std_pct
    return is_wrong and abs(piece.error_pct - judgement.error_pct) > OFF_PCT


def _cause(judgement: Judgement, fault: FoundFault) -> str:
    kind = FAULTS[fault.name]
    size = f"{number(abs(fault.size), kind.digits)} ± {number(fault.std, kind.digits)}"
    cause = kind.words.format(
        size=size if kind.unit == "-" else f"{size} {kind.unit}",
        side=kind.sides[fault.size < 0.0],
        cell=fault.cell,
    )
    since = "" if fault.since is None else f" since {moment(judgement, fault.since)}"
    return f"{cause}{since} ({number(100.0 * fault.probability, 0)} %)"


def _next_step(judgement: Judgement) -> str:
    if judgement.pieces[-1].stands_at_pct is not None:
        return FAULTS["stands_still"].next_step
    if judgement.verdict == "cannot_tell":
        return _telling(judgement)
    names = [fault.name for fault in judgement.faults if fault.name != "stands_still"]
    if judgement.verdict == "agrees" and set(names) <= {"start_or_reset"}:
        return OTHERWISE["nothing"]
    if not names:
        return OTHERWISE["cause_unknown"]
    if names[0] == "start_or_reset" and judgement.was_full:
        return OTHERWISE["reset_at_full"]
    return FAULTS[names[0]].next_step


def _telling(judgement: Judgement) -> str:
    """Return the one log that would tell."""
    if judgement.model.chemistry != "lfp" and judgement.model.made.by == PRIOR_MADE_BY:
        return OTHERWISE["cannot_tell_typical"]
    step = OTHERWISE["cannot_tell_lfp" if judgement.model.chemistry == "lfp" else "cannot_tell"]
    offset = sum(
        fit.share
        for fit in judgement.fits
        if "current_offset" in [each.fault for each in fit.faults]
    )
    return step + OTHERWISE["shows_offset"] if offset > 1.0 - NAMED else step


def moment(judgement: Judgement, at: Moment) -> str:
    """Return a moment as a date, or as the time into its log."""
    number_of, time_s = at
    log = judgement.logs[number_of]
    if time_s >= EPOCH_S:
        return datetime.fromtimestamp(time_s, UTC).strftime("%a %d %b %H:%M UTC")
    after_s = time_s - float(log.time_s[0])
    return f"{duration(after_s)} into {log.name}" if after_s > 60.0 else f"the start of {log.name}"


def _wrong(piece: Piece) -> str:
    side = "too high" if piece.error_pct > 0.0 else "too low"
    return f"{number(abs(piece.error_pct), 1)} ± {number(piece.std_pct, 1)} % SoC {side}"


def signed(value: float) -> str:
    """Return a number with its sign, to a tenth."""
    text = number(value, 1)
    return text if value < 0.0 else f"+{text}"
