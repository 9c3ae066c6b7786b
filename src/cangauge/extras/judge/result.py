"""What a judgement holds, its sentences and its JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from cangauge._text import counted, duration, number, rounded
from cangauge._typing import FloatArray
from cangauge.extras.judge.causes import RIGHT, Explanation
from cangauge.extras.judge.causes import UNITS as PACK_UNITS
from cangauge.extras.judge.chain import HELD_PCT, Stretch, count_changes, published_pct
from cangauge.extras.judge.weak import WeakestCell
from cangauge.logs.log import Log
from cangauge.model.model_file import PRIOR_MADE_BY, Model

Verdict = Literal["agrees", "off", "cannot_tell"]

UNITS: Final = {**PACK_UNITS, "weak_cell": "%"}
"""Units of the sizes of all causes."""
USEFUL_PCT: Final = 5.0
"""A gauge agrees only where an error of this size would have been seen [% SoC]."""
JUMP_PCT: Final = 1.0
"""Least jump of the published SoC against the charge that is listed [%]: a dashboard shows it."""
SEVERAL: Final = 6.0
"""A jump is also this many times the usual change against the charge."""
DAY_S: Final = 86400.0
EPOCH_S: Final = 1e8
"""Stamps from here on are absolute [s since 1970]; smaller ones count from the log's own start."""

_WORDS: Final = {
    "none": "the gauge is right",
    "current_offset": "offset of the current",
    "count_scale": "the gauge counts with a wrong scale",
    "pack_capacity": "the pack has another capacity than the gauge counts with",
    "start_or_reset": "wrong start or reset",
    "voltage_sensor": "voltage sensor",
    "model_capacity": "the gauge is right, and the pack has another capacity than the model",
    "weak_cell": "weak cell",
    "unknown": "another cause, or several",
}
_NEXT: Final = {
    "none": "Nothing. Judge again after a full charge or a drive of 40 % or more.",
    "current_offset": "Read the current with contactors open or everything off: what it then shows"
    " is the offset. Log one hour of it: that settles it.",
    "count_scale": "Compare the capacity in the gauge's configuration with the pack's, and the"
    " current with a clamp meter under load. A log of one drive of 40 % settles it. A gauge that"
    " shows the usable part of the cells as 0 to 100 % also moves more than the cells do: then"
    " nothing is wrong.",
    "pack_capacity": "Log one full discharge or charge, or a drive of 40 % or more that ends with"
    " an hour of rest: charge over SoC then gives the capacity.",
    "start_or_reset": "Charge until full once, so that the gauge resets itself, and judge again:"
    " if the error is gone it was the start.",
    "voltage_sensor": "Put a meter on the pack's terminals at rest and compare with the logged"
    " voltage. Until then the published SoC may be the right one.",
    "weak_cell": "Log one full charge and discharge with cell voltages, and balance the pack.",
    "unknown": "Log one hour of rest and one full charge until its end: they settle whether the"
    " SoC, the current or the voltage is wrong.",
}


class Jump(NamedTuple):
    """A jump of the published SoC that the charge does not explain."""

    log: int
    time_s: float
    since_start_s: float
    size_pct: float


class Size(NamedTuple):
    """Size of a cause with its interval of 95 %."""

    value: float
    ci: tuple[float, float]
    unit: str


class Cause(NamedTuple):
    """The most probable reason of a gauge's error."""

    verdict: str
    """`current_offset`, `count_scale`, `pack_capacity`, `start_or_reset`, `voltage_sensor`,
    `model_capacity`, `weak_cell`, `none` or `unknown`."""
    probability: float
    size: Size | None = None
    onset: int = 0
    """Stretch with which it begins; the first one: before all."""
    earliest: int = 0
    latest: int = 0
    """First and last stretch with which it may have begun (90 %)."""
    inside: bool = False
    """Whether it begins at the step within that stretch, not before it."""


def standing(chain: Sequence[Stretch]) -> Stretch | None:
    """Return the stretch that ends with a published SoC that stands still while charge flows.

    Of several, that with the most charge; None without any.
    """
    stands = [part for part in chain if part.held_pct >= max(HELD_PCT, 2.0 * part.soc_step_pct)]
    return max(stands, key=lambda part: part.held_pct, default=None)


@dataclass(frozen=True, eq=False)
class Judgement:
    """A second opinion on a gauge.

    Attributes
    ----------
    logs : tuple of Log
        In order of time.
    model : Model
    error_pct, error_std_pct : float
        Published SoC minus the SoC that all logs imply, at the end, and its σ with that of the
        gauge's own zero [% SoC].
    worst_pct : float
        The largest such difference, relative to its σ [% SoC].
    verdict : {"agrees", "off", "cannot_tell"}
    cause : Cause
    probabilities : dict
        Of `none`, `unknown` and each cause.
    corrected_pct, corrected_std_pct : list of array
        Corrected SoC and its σ at each row of each log, with that of the gauge's own zero [%]; NaN
        where not known.
    chain : list of Stretch
    explanations : list of Explanation
        All answers, the most probable first.
    weakest : WeakestCell, optional
    """

    logs: tuple[Log, ...]
    model: Model
    error_pct: float
    error_std_pct: float
    worst_pct: float
    verdict: Verdict
    cause: Cause
    probabilities: dict[str, float]
    corrected_pct: list[FloatArray]
    corrected_std_pct: list[FloatArray]
    chain: list[Stretch]
    explanations: list[Explanation]
    weakest: WeakestCell | None = None

    @property
    def published_pct(self) -> list[FloatArray]:
        """Published SoC at each row of each log [%]; NaN where a log has none."""
        return [published_pct(log) for log in self.logs]

    @property
    def jumps(self) -> list[Jump]:
        """Jumps of the published SoC within stretches that the charge does not explain."""
        result = []
        for part in self.chain:
            at, change = count_changes(part.published_pct, part.drawn_pct)
            if not change.size:
                continue
            _, moved = count_changes(part.published_pct, np.zeros_like(part.drawn_pct))
            usual = 1.5 * float(np.median(np.abs(change)))
            least = max(JUMP_PCT, SEVERAL * usual, 2.0 * part.soc_step_pct)
            for k in np.flatnonzero(np.minimum(np.abs(change), np.abs(moved)) >= least):
                time_s = float(part.time_s[at[k]])
                since_s = self.elapsed_s(part.log, time_s)
                result.append(Jump(part.log, time_s, since_s, float(change[k])))
        return result

    @property
    def days(self) -> int:
        """Days with logs: by their stamps, or one for each log."""
        if any(log.time_s[0] < EPOCH_S for log in self.logs):
            return len(self.logs)
        stamps = np.concatenate([log.time_s for log in self.logs])
        return int(np.unique(np.floor(stamps / DAY_S)).size)

    @property
    def extent(self) -> str:
        """How much was judged."""
        hours = duration(sum(log.duration_s for log in self.logs))
        return f"{counted(len(self.logs), 'log')}, {counted(self.days, 'day')}, {hours}"

    def elapsed_s(self, log: int, time_s: float) -> float:
        """Return the time since the first row of the first log [s].

        Logs without absolute stamps follow one another without a pause.
        """
        if self.logs[0].time_s[0] >= EPOCH_S and self.logs[log].time_s[0] >= EPOCH_S:
            return float(time_s - self.logs[0].time_s[0])
        before = sum(earlier.duration_s for earlier in self.logs[:log])
        return float(before + time_s - self.logs[log].time_s[0])

    @property
    def onset(self) -> tuple[int, float] | None:
        """Log and stamp [s] with which the cause begins; None: before the first log, or unknown."""
        cause = self.cause
        if cause.onset == 0 and not cause.inside:
            return None
        part = self.chain[cause.onset]
        return part.log, float(part.time_s[part.step_at if cause.inside else 0])

    @property
    def since_s(self) -> float | None:
        """Moment from which on a cause holds, since the first row [s]; None without a cause."""
        if self.cause.size is None:
            return None
        return 0.0 if self.onset is None else self.elapsed_s(*self.onset)

    def to_dict(self, corrected: str | None = None) -> dict[str, Any]:
        """Return the object of `--json`, schema 1."""
        size = self.cause.size
        return {
            "schema": 1,
            "gauge": {
                "error_pct": self.error_pct,
                "error_std_pct": self.error_std_pct,
                "verdict": self.verdict,
                "since_s": self.since_s,
                "worst_pct": self.worst_pct,
                "jumps": [
                    {
                        "log": self.logs[jump.log].name,
                        "since_s": jump.since_start_s,
                        "size_pct": jump.size_pct,
                    }
                    for jump in self.jumps
                ],
            },
            "cause": {
                "verdict": self.cause.verdict,
                "probability": self.cause.probability,
                "size": None if size is None else size._asdict() | {"ci": list(size.ci)},
            },
            "next_step": self.next_step,
            "days": self.days,
            "corrected": corrected,
        }

    @property
    def headline(self) -> str:
        """The answer in a few sentences."""
        reason = "" if self.cause.verdict in RIGHT else self.reason
        return " ".join(filter(None, [self._found, self.aged, self.stands, reason]))

    @property
    def _found(self) -> str:
        """The verdict with the error, as a sentence."""
        std = number(self.error_std_pct, 1)
        error = f"{_signed(self.error_pct)} ± {std} % SoC"
        if self.verdict == "agrees":
            return f"The gauge agrees with voltage and charge: difference {error} (1σ)."
        if self.verdict == "cannot_tell":
            open_ = f"and the logs do not settle whether its error is below {USEFUL_PCT:g} %"
            if self.cause.verdict == "unknown":
                open_ = (
                    "and either it is wrong, or it is right and the pack has another capacity than"
                    " assumed"
                )
            return (
                f"Cannot tell: the gauge differs by {error} from the SoC that voltage and charge"
                f" imply, {open_}."
            )
        if self.cause.verdict == "voltage_sensor":
            return "The gauge and the logged voltage contradict each other."
        if self.cause.verdict == "weak_cell":
            return "The gauge holds for the mean cell, not for the weakest."
        if abs(self.error_pct) > 2.0 * self.error_std_pct:
            high = "too high" if self.error_pct > 0.0 else "too low"
            return f"The gauge reads {number(abs(self.error_pct), 1)} ± {std} % SoC {high}."
        return f"The gauge is not right, though its SoC at the end may be ({error})."

    @property
    def pack_ah(self) -> float | None:
        """Capacity that the pack has where it is not the model's [Ah]; None where it is."""
        if self.cause.verdict != "model_capacity" or self.cause.size is None:
            return None
        return self.model.capacity_ah / (1.0 - self.cause.size.value / 100.0)

    @property
    def aged(self) -> str:
        """That the pack has another capacity than the model, as a sentence; empty if not."""
        if self.pack_ah is None:
            return ""
        has, model = (rounded(ah) for ah in (self.pack_ah, self.model.capacity_ah))
        percent = number(100.0 * self.cause.probability, 0, "%")
        return f"The pack has {has} Ah, as the gauge counts; the model has {model} Ah ({percent})."

    @property
    def stands(self) -> str:
        """Where the published SoC stands or stood still, as a sentence; empty if it does not."""
        part = standing(self.chain)
        if part is None or part.end is None:
            stood = [(each, part.log) for part in self.chain for each in part.stood]
            if not stood:
                return ""
            longest, log = max(stood, key=lambda found: found[0].flowed_pct)
            return (
                f"The published SoC stood at {number(longest.shown_pct, 1, '%')} for"
                f" {duration(longest.until_s - longest.since_s)} from"
                f" {self._moment(log, longest.since_s)} on, while"
                f" {number(longest.flowed_pct, 1, '%')} of the charge flowed, and then jumped to"
                " what it had missed."
            )
        at = number(float(part.shown_pct[part.end]), 1, "%")
        return (
            f"The published SoC stands at {at} from {self._moment(part.log, part.held_since_s)} on,"
            f" while {number(part.held_pct, 1, '%')} of the charge flowed."
        )

    @property
    def reason(self) -> str:
        """Cause, size and moment as sentences."""
        cause = self.cause
        if cause.size is None:
            likely = ", ".join(
                f"{_WORDS[name]} {number(100.0 * share, 0, '%')}"
                for name, share in sorted(self.probabilities.items(), key=lambda item: -item[1])
                if name in UNITS and share >= 0.05
            )
            return f"The cause is not known{f' (possible: {likely})' if likely else ''}."
        value, (low, high), unit = cause.size
        digits = _digits(unit)
        words = _WORDS[cause.verdict]
        if cause.verdict == "weak_cell" and self.weakest is not None:
            words = f"weak cell, number {self.weakest.number}"
        percent = number(100.0 * cause.probability, 0, "%")
        text = f"Cause: {words} ({percent}), {_signed(value, digits)} {unit}"
        text += f" ({_signed(low, digits)} … {_signed(high, digits)} {unit}, 95 %)"
        return f"{text}, {self.since}."

    @property
    def since(self) -> str:
        """Since when, with its interval."""
        begin = "since before the first log"
        if self.onset is not None:
            log, time_s = self.onset
            begin = f"since {self._moment(log, time_s)}"
        if self.cause.earliest == self.cause.latest:
            return begin
        first = self.logs[self.chain[self.cause.earliest].log].name
        last = self.logs[self.chain[self.cause.latest].log].name
        return f"{begin} (it may have begun between {first} and {last})"

    def _moment(self, log: int, time_s: float) -> str:
        """Return a stamp [s] as the time into its log."""
        after_s = time_s - self.logs[log].time_s[0]
        where = f"{duration(after_s)} into" if after_s > 60.0 else "the start of"
        return f"{where} {self.logs[log].name}"

    @property
    def next_step(self) -> str:
        """What to do next, and what it settles."""
        is_open = self.cause.size is None and self.verdict != "cannot_tell"
        if standing(self.chain) is not None and is_open:
            return (
                "See whether the gauge itself stands still, or only what is logged of it, and judge"
                " again by a log in which its SoC moves."
            )
        if self.verdict == "cannot_tell" and self.cause.verdict == "unknown":
            return _NEXT["pack_capacity"]
        if self.pack_ah is not None:
            return (
                f"Judge again with the pack's capacity (--capacity-ah {rounded(self.pack_ah)};"
                " of a service: capacity_ah), and fit a new model to logs of these days."
            )
        if self.verdict != "cannot_tell":
            return _NEXT[self.cause.verdict]
        if self.model.chemistry == "lfp":
            return (
                "Add a log of one full charge until its end: between the knees the voltage of an"
                " LFP cell says nothing, at full it settles the SoC."
            )
        zero = ", but for the zero of the gauge: that needs a model (-m)"
        return (
            "Add a log with an hour of rest after a drive of 40 % or more, or of one full charge"
            " until its end: it settles the SoC to about 2 %"
            f"{zero if self.model.made.by == PRIOR_MADE_BY else ''}."
        )

    def answer_rows(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows of the table of all answers, the most probable first."""
        rows = []
        for answer in self.explanations:
            size, unit = "–", UNITS.get(answer.name)
            if unit is not None:
                value, std = float(answer.size[answer.best]), float(answer.std[answer.best])
                size = f"{_signed(value, _digits(unit))} ± {number(std, _digits(unit))} {unit}"
            share = number(100.0 * self.probabilities[answer.name], 1, "%")
            rows.append([_WORDS[answer.name], share, size])
        return ["answer", "probability", "size (±1σ)"], rows

    def jump_rows(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows of the table of jumps."""
        rows = [
            [self._moment(jump.log, jump.time_s), number(jump.size_pct, 1)] for jump in self.jumps
        ]
        return ["moment", "% SoC"], rows


def _digits(unit: str) -> int:
    return 2 if unit == "A" else 1


def _signed(value: float, digits: int = 1) -> str:
    text = number(value, digits)
    return text if value < 0.0 else f"+{text}"
