"""What a judgement holds, its three lines and its JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from cangauge._text import duration, number, rounded
from cangauge._typing import FloatArray
from cangauge.extras.judge.chain import Chain
from cangauge.extras.judge.faults import Fitted
from cangauge.extras.judge.weak import WeakestCell
from cangauge.logs.log import Log
from cangauge.model.model_file import PRIOR_MADE_BY, Model

Verdict = Literal["agrees", "off", "cannot_tell"]

OFF_PCT: Final = 3.0
"""Error from which a gauge is off [% SoC]."""
STOOD_PCT: Final = 5.0
"""Charge from which it is told that a gauge stood still before [%]."""
SURE: Final = 1.96
"""Half width of an interval of 95 % in standard deviations."""
EPOCH_S: Final = 1e8
"""Stamps from here on are absolute [s since 1970]; smaller ones count from the log's own start."""
DAY_S: Final = 86400.0

FAULTS: Final = {
    "start_or_reset": "wrong start or reset",
    "current_offset": "current offset",
    "count_scale": "the gauge counts with a wrong scale:",
    "pack_capacity": "the pack has another capacity than the gauge counts with:",
    "model_capacity": "the pack has another capacity than the model, and the gauge knows it:",
    "voltage_sensor": "the logged voltage reads wrong:",
    "voltage_table": "the gauge follows the voltage under load:",
    "late": "the gauge is late by",
    "weak_cell": "weak cell",
    "stands_still": "the gauge stands still",
}
NEXT: Final = {
    "start_or_reset": "Charge until full once, so that the gauge resets itself, and judge again.",
    "reset_at_full": "The pack was charged full in these logs: check at which voltage and current"
    " the gauge sets itself to 100 %.",
    "unknown": "Log one hour of rest and one full charge until its end: they settle whether the"
    " SoC, the current or the voltage is wrong.",
    "current_offset": "Read the current with everything off: what it shows is the offset."
    " Calibrate its zero, or let the gauge reach a full charge more often.",
    "count_scale": "Compare the capacity in the gauge's configuration with the pack's, and the"
    " current with a clamp meter under load.",
    "pack_capacity": "Log one full discharge or charge: it gives the capacity. Then state it in the"
    " gauge.",
    "model_capacity": "Fit a new model to logs of these days.",
    "voltage_sensor": "Put a meter on the pack's terminals at rest and compare with the log.",
    "voltage_table": "Read the gauge at rest only, or use one that counts charge.",
    "late": "Compare the time stamps of SoC and current: the gauge, or what carries it, buffers.",
    "weak_cell": "Log one full charge and discharge with cell voltages, and balance the pack.",
    "stands_still": "See whether the gauge itself stands still, or only what is logged of it, and"
    " judge again by a log in which its SoC moves.",
}


class Moment(NamedTuple):
    """A row of a log."""

    log: int
    time_s: float


class Piece(NamedTuple):
    """What the gauge did between two jumps, or while it stood still."""

    begin: Moment
    end: Moment
    error_pct: float
    """Published minus corrected SoC at its end [% SoC], and its σ."""
    std_pct: float
    stands_at_pct: float | None
    """SoC at which it stood still; None where it moved."""
    moved_pct: float
    """Charge that moved while it stood still [%]."""


class FoundFault(NamedTuple):
    """Something that is wrong."""

    name: str
    """`start_or_reset`, `current_offset`, `count_scale`, `pack_capacity`, `model_capacity`,
    `voltage_sensor`, `voltage_table`, `late`, `weak_cell` or `stands_still`."""
    probability: float
    size: float
    interval: tuple[float, float]
    """Of 95 %."""
    unit: str
    since: Moment | None
    """None: since before the first log."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """A second opinion on a gauge; all that it says follows from one residual over all rows.

    Attributes
    ----------
    logs : tuple of Log
        In order of time.
    model : Model
    chain : Chain
    fits : list of Fitted
        Sets of faults that explain the logs, the most probable first.
    published_pct, corrected_pct, corrected_std_pct : list of array
        Published SoC, the one that all logs imply on the gauge's scale, and its σ, at each row of
        each log [%]; NaN where not known.
    verdict : {"agrees", "off", "cannot_tell"}
    error_pct, error_std_pct : float
        Published minus corrected SoC at the last published row, and its σ [% SoC].
    pieces : list of Piece
    faults : list of FoundFault
        The most probable first.
    ratio : float, optional
        Charge over what the published SoC moves by, where that is no gauge's error.
    weakest : WeakestCell, optional
    """

    logs: tuple[Log, ...]
    model: Model
    chain: Chain
    fits: list[Fitted]
    published_pct: list[FloatArray]
    corrected_pct: list[FloatArray]
    corrected_std_pct: list[FloatArray]
    verdict: Verdict
    error_pct: float
    error_std_pct: float
    pieces: list[Piece]
    faults: list[FoundFault]
    ratio: float | None = None
    weakest: WeakestCell | None = None

    @property
    def text(self) -> str:
        """The answer in up to three lines: the present error, history and causes, what to do."""
        past = " ".join(filter(None, [_above(self), _history(self), _causes(self)]))
        return "\n".join(filter(None, [_now(self), past, self.next_step]))

    @property
    def headline(self) -> str:
        """The first line."""
        return _now(self)

    @property
    def next_step(self) -> str:
        """What to do next."""
        return _next_step(self)

    def piece_rows(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows of the table of pieces."""
        rows = [
            [
                moment(self, piece.begin),
                moment(self, piece.end),
                _signed(piece.error_pct),
                number(piece.std_pct, 1),
                "" if piece.stands_at_pct is None else f"at {number(piece.stands_at_pct, 1)} %",
            ]
            for piece in self.pieces
        ]
        return ["from", "until", "error at its end [% SoC]", "σ", "stands still"], rows

    def fault_rows(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows of the table of faults, the most probable first."""
        rows = [
            [
                FAULTS[fault.name].rstrip(":"),
                number(100.0 * fault.probability, 0),
                f"{_signed(fault.size, 2)} {fault.unit}",
                f"{_signed(fault.interval[0], 2)} … {_signed(fault.interval[1], 2)}",
                "before the first log" if fault.since is None else moment(self, fault.since),
            ]
            for fault in self.faults
        ]
        return ["fault", "probability [%]", "size", "95 %", "since"], rows

    @property
    def days(self) -> int:
        """Days with logs: by their stamps, or one for each log."""
        if not is_dated(self.logs):
            return len(self.logs)
        stamps = np.concatenate([log.time_s for log in self.logs])
        return int(np.unique(np.floor(stamps / DAY_S)).size)

    @cached_property
    def _begins_s(self) -> list[float]:
        """Time since the first row at which each log begins; without dates they follow."""
        if is_dated(self.logs):
            return [float(log.time_s[0] - self.logs[0].time_s[0]) for log in self.logs]
        return [sum(log.duration_s for log in self.logs[:k]) for k in range(len(self.logs))]

    def since_first_s(self, moment: Moment) -> float:
        """Return the time since the first row of the first log [s]."""
        own_s = moment.time_s - float(self.logs[moment.log].time_s[0])
        return self._begins_s[moment.log] + own_s

    def to_dict(self, corrected: str | None = None) -> dict[str, Any]:
        """Return the object of `--json`, schema 2."""
        return {
            "schema": 2,
            "text": self.text,
            "now": {
                "error_pct": self.error_pct,
                "sigma_pct": self.error_std_pct,
                "verdict": self.verdict,
            },
            "pieces": [
                {
                    "from_s": self.since_first_s(piece.begin),
                    "until_s": self.since_first_s(piece.end),
                    "from_log": self.logs[piece.begin.log].name,
                    "until_log": self.logs[piece.end.log].name,
                    "error_pct": piece.error_pct,
                    "sigma_pct": piece.std_pct,
                    "stands_at_pct": piece.stands_at_pct,
                }
                for piece in self.pieces
            ],
            "faults": [
                {
                    "fault": fault.name,
                    "probability": fault.probability,
                    "size": fault.size,
                    "interval": list(fault.interval),
                    "unit": fault.unit,
                    "since_s": None if fault.since is None else self.since_first_s(fault.since),
                }
                for fault in self.faults
            ],
            "next_step": self.next_step,
            "corrected": corrected,
        }


def is_dated(logs: Sequence[Log]) -> bool:
    """Return whether all stamps are absolute."""
    return all(log.time_s[0] >= EPOCH_S for log in logs)


def _next_step(judgement: Judgement) -> str:
    """Return what to do next."""
    if judgement.ratio is not None:
        return (
            "Check unit, sign and width of the current and of the SoC: one of the two is decoded"
            " wrongly."
        )
    if judgement.pieces[-1].stands_at_pct is not None:
        return NEXT["stands_still"]
    if judgement.verdict == "cannot_tell":
        return _telling(judgement)
    names = [fault.name for fault in judgement.faults if fault.name != "stands_still"]
    if judgement.verdict == "agrees" and set(names) <= {"start_or_reset"}:
        return "Nothing to do."
    first = names[0] if names else "unknown"
    if first == "start_or_reset" and any(
        part.full_hours.size for part in judgement.chain.stretches
    ):
        first = "reset_at_full"
    return NEXT[first]


def _telling(judgement: Judgement) -> str:
    """Return the one log that would tell."""
    offset = sum(
        fit.share
        for fit in judgement.fits
        if any(fault.name == "current_offset" for fault in fit.faults)
    )
    doubt = " It also shows whether the current sensor is off." if offset > 0.1 else ""
    if judgement.model.chemistry == "lfp":
        return (
            "Add a log of one full charge until its end: it settles the SoC, which the flat"
            f" voltage of LFP cells does not.{doubt}"
        )
    if judgement.model.made.by == PRIOR_MADE_BY:
        return (
            "Fit a model of the pack (`cangauge fit`) to drives whose SoC is known, and judge with"
            f" -m: a typical cell leaves the SoC open by several percent.{doubt}"
        )
    return (
        "Add a log with an hour of rest after a drive of 40 % or more, or of one full charge until"
        f" its end: it settles the SoC.{doubt}"
    )


def _now(judgement: Judgement) -> str:
    error, std = judgement.error_pct, number(judgement.error_std_pct, 1)
    if judgement.ratio is not None:
        times = rounded(max(abs(judgement.ratio), 1.0 / max(abs(judgement.ratio), 1e-9)))
        larger = "charge is" if abs(judgement.ratio) > 1.0 else "published SoC moves by"
        return (
            f"Cannot tell: the {larger} {times} times what the other shows, so that one of the two"
            " signals is not what it is taken for."
        )
    last = judgement.pieces[-1] if judgement.pieces else None
    if last is not None and last.stands_at_pct is not None:
        return (
            f"The gauge stands still at {number(last.stands_at_pct, 1)} % since"
            f" {moment(judgement, last.begin)}, while {number(last.moved_pct, 0)} % of the charge"
            f" moved: its error is {_signed(error)} ± {std} % SoC now."
        )
    if judgement.verdict == "agrees":
        return f"The gauge is right now: {_signed(error)} ± {std} % SoC."
    if judgement.verdict == "off":
        return f"The gauge reads {_wrong(error, judgement.error_std_pct)} now."
    return (
        f"Cannot tell whether the gauge is right now: it differs by {_signed(error)} ± {std} % SoC"
        " from what voltage and charge imply."
    )


def _wrong(error_pct: float, std_pct: float) -> str:
    side = "too high" if error_pct > 0.0 else "too low"
    return f"{number(abs(error_pct), 1)} ± {number(std_pct, 1)} % SoC {side}"


def _above(judgement: Judgement) -> str:
    most = max(float(np.nanmax(np.r_[-1.0, each])) for each in judgement.published_pct)
    return "" if most <= 100.05 else f"It published up to {number(most, 1)} %."


def _history(judgement: Judgement) -> str:
    """Return what the gauge did before, where it was not as it is now."""
    wrong = [piece for piece in judgement.pieces[:-1] if _was_other(judgement, piece)]
    if not wrong:
        return ""
    last = wrong[-1]
    begin, until = moment(judgement, last.begin), moment(judgement, last.end)
    if last.stands_at_pct is not None:
        return (
            f"It stood at {number(last.stands_at_pct, 1)} % from {begin} until {until}, while"
            f" {number(last.moved_pct, 0)} % of the charge moved."
        )
    after = judgement.pieces[judgement.pieces.index(last) + 1]
    jump = "" if after.stands_at_pct is not None else ", when it set itself"
    return f"It was {_wrong(last.error_pct, last.std_pct)} until {until}{jump}."


def _was_other(judgement: Judgement, piece: Piece) -> bool:
    """Return whether a piece was wrong in another way than the gauge is now."""
    if piece.stands_at_pct is not None:
        return piece.moved_pct > STOOD_PCT
    is_wrong = abs(piece.error_pct) > OFF_PCT + piece.std_pct
    return is_wrong and abs(piece.error_pct - judgement.error_pct) > OFF_PCT


def _causes(judgement: Judgement) -> str:
    texts = [_cause(judgement, fault) for fault in judgement.faults if fault.name != "stands_still"]
    if texts:
        return f"Cause: {'; '.join(texts)}."
    return "The cause is not known." if judgement.verdict == "off" and not judgement.faults else ""


def _cause(judgement: Judgement, fault: FoundFault) -> str:
    words = FAULTS[fault.name]
    if fault.name == "weak_cell" and judgement.weakest is not None:
        words = f"weak cell, number {judgement.weakest.number}, which lacks capacity:"
    digits = {"A": 2, "s": 0}.get(fault.unit, 1)
    std = number((fault.interval[1] - fault.interval[0]) / (2.0 * SURE), digits)
    size = (
        number(fault.size, digits)
        if fault.name in {"late", "weak_cell"}
        else _signed(fault.size, digits)
    )
    percent = number(100.0 * fault.probability, 0)
    since = "" if fault.since is None else f" since {moment(judgement, fault.since)}"
    return f"{words} {size} ± {std} {fault.unit}{since} ({percent} %)"


def moment(judgement: Judgement, at: Moment) -> str:
    """Return a moment as a date, or as the time into its log."""
    log = judgement.logs[at.log]
    if at.time_s >= EPOCH_S:
        return datetime.fromtimestamp(at.time_s, UTC).strftime("%a %d %b %H:%M UTC")
    after_s = at.time_s - float(log.time_s[0])
    return f"{duration(after_s)} into {log.name}" if after_s > 60.0 else f"the start of {log.name}"


def _signed(value: float, digits: int = 1) -> str:
    """Return a number with its sign."""
    text = number(value, digits)
    return text if value < 0.0 else f"+{text}"
