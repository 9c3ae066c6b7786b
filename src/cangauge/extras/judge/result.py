"""What a judgement holds, and its JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from cangauge._typing import FloatArray
from cangauge.extras.judge.faults import FAULTS
from cangauge.extras.judge.gauge import published_pct
from cangauge.extras.judge.linearised import Fitted
from cangauge.extras.judge.text import EPOCH_S, SURE, lines_of
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

Verdict = Literal["agrees", "off", "cannot_tell"]
Moment = tuple[int, float]
"""Number of a log, and a stamp of its rows [s]."""


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
    """A key of `faults.FAULTS`, which has its unit."""
    probability: float
    size: float
    std: float
    since: Moment | None = None
    """None: since before the first log."""
    cell: int | None = None
    """Number of a weak cell."""

    @property
    def interval(self) -> tuple[float, float]:
        """Of 95 %."""
        return self.size - SURE * self.std, self.size + SURE * self.std


@dataclass(frozen=True, eq=False)
class Judgement:
    """A second opinion on a gauge; all that it says follows from one residual over all rows.

    Attributes
    ----------
    logs : list of Log
        In order of time.
    model : Model
    fits : list of Fitted
        Sets of faults that explain the logs, the most probable first.
    corrected_pct, corrected_std_pct : list of array
        SoC that all logs imply on the gauge's scale, and its σ, at each row of each log [%]; NaN
        where not known.
    verdict : {"agrees", "off", "cannot_tell"}
    pieces : list of Piece
    faults : list of FoundFault
        The most probable first.
    was_full : bool
        Whether a charge ended full in these logs.
    """

    logs: list[Log]
    model: Model
    fits: list[Fitted]
    corrected_pct: list[FloatArray]
    corrected_std_pct: list[FloatArray]
    verdict: Verdict
    pieces: list[Piece]
    faults: list[FoundFault]
    was_full: bool

    @property
    def error_pct(self) -> float:
        """Published minus corrected SoC at the last published row [% SoC]."""
        return self.pieces[-1].error_pct

    @property
    def error_std_pct(self) -> float:
        """Standard deviation of `error_pct` [% SoC]."""
        return self.pieces[-1].std_pct

    @property
    def published_pct(self) -> list[FloatArray]:
        """Published SoC at each row of each log [%]; NaN where there is none."""
        return [published_pct(log) for log in self.logs]

    @property
    def text(self) -> str:
        """The answer in up to three lines: the present error, history and causes, what to do."""
        return "\n".join(lines_of(self))

    @property
    def next_step(self) -> str:
        """What to do next."""
        return self.text.rsplit("\n", 1)[-1]

    def since_first_s(self, moment: Moment) -> float:
        """Return the time since the first row of the first log; without dates the logs follow."""
        log, time_s = moment
        if is_dated(self.logs):
            return time_s - float(self.logs[0].time_s[0])
        own_s = time_s - float(self.logs[log].time_s[0])
        return own_s + sum(log.duration_s for log in self.logs[:log])

    def to_dict(self) -> dict[str, Any]:
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
                    "from_log": self.logs[piece.begin[0]].name,
                    "until_log": self.logs[piece.end[0]].name,
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
                    "unit": FAULTS[fault.name].unit,
                    "since_s": None if fault.since is None else self.since_first_s(fault.since),
                }
                for fault in self.faults
            ],
            "next_step": self.next_step,
        }


def is_dated(logs: Sequence[Log]) -> bool:
    """Return whether all stamps are absolute."""
    return all(log.time_s[0] >= EPOCH_S for log in logs)
