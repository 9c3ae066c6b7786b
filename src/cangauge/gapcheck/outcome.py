"""One label beside one answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from cangauge.gapcheck.parameters import expected_parameters
from cangauge.gapcheck.plan import is_outside
from cangauge.gapcheck.workers import Task
from cangauge.twin.faults import fault_kinds

NONE, UNKNOWN, CRASHED = "none", "unknown", "crashed"
FAMILY: Final = {kind.id: kind.family for kind in fault_kinds()}

LEAST_GAP: Final = 0.45
"""A gap below this many floors is out of the check's range: physics allowed no larger one."""

ROUNDING: Final = 1e-9
"""Part of a true value by which the twin's and the library's units may round it apart."""


@dataclass(frozen=True)
class Covered:
    """Whether an interval holds the true value of a parameter."""

    effect: str
    parameter: str
    true: float
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """Whether it does, but for rounding: the truth may be at a bound, where intervals end."""
        rounding = ROUNDING * abs(self.true)
        return self.low - rounding <= self.true <= self.high + rounding


@dataclass(frozen=True)
class Outcome:
    """What a diagnosis said of a case whose cause is known.

    Parameters
    ----------
    task, case, protocol : str
    truth : tuple of str
        Effects that are there; empty for a healthy pack.
    leave_out : tuple of str
        Effects that the library was without.
    gap_in_floors : float, optional
        RMS gap that the faults open, over what the model misses on clean days.
    verdict : str
        An effect, `none`, `unknown`, or `crashed`.
    probability : float
        Of the verdict being right; 0 of a crash.
    ambiguous_with, accepted, ranked : tuple of str
    closed : dict of str to float
        Closed part of the squared gap, by the floor it is counted to.
    covered : tuple of Covered
    seconds, peak_mib : float, optional
    error : str
        Why there is no verdict.
    """

    task: str
    case: str
    protocol: str
    truth: tuple[str, ...]
    leave_out: tuple[str, ...]
    gap_in_floors: float | None
    verdict: str
    probability: float
    ambiguous_with: tuple[str, ...] = ()
    accepted: tuple[str, ...] = ()
    ranked: tuple[str, ...] = ()
    closed: Mapping[str, float] | None = None
    covered: tuple[Covered, ...] = ()
    seconds: float | None = None
    peak_mib: float | None = None
    error: str = ""

    @property
    def right(self) -> str:
        """The verdict that is right of a case with one cause or none."""
        if not self.truth:
            return NONE
        if is_outside(self.truth) or set(self.truth) & set(self.leave_out):
            return UNKNOWN
        return self.truth[0]

    @property
    def is_decoy(self) -> bool:
        """Whether an effect was left out of the library that is not the cause."""
        return bool(self.leave_out) and not set(self.truth) & set(self.leave_out)

    @property
    def strict(self) -> bool:
        """Whether the verdict is right (of several causes: one of them)."""
        if len(self.truth) > 1 and not self.leave_out:
            return self.verdict in self.truth
        return self.verdict == self.right

    @property
    def within_pair(self) -> bool:
        """Whether the truth is the verdict or the one effect that it could not be told from."""
        return self.strict or (
            self.names_effect
            and len(self.ambiguous_with) == 1
            and self.right in self.ambiguous_with
        )

    @property
    def names_effect(self) -> bool:
        """Whether the verdict is an effect."""
        return self.verdict in FAMILY

    @property
    def within_two(self) -> bool:
        """Whether an effect is named and the truth is among the first two."""
        return self.names_effect and self.right in self.ranked[:2]

    @property
    def family(self) -> bool:
        """Whether the family is right."""
        return self.names_effect and FAMILY[self.verdict] == FAMILY.get(self.right)

    @property
    def in_range(self) -> bool:
        """Whether the gap is one of the check's sizes."""
        return self.gap_in_floors is None or self.gap_in_floors >= LEAST_GAP

    def to_dict(self) -> dict[str, Any]:
        """Return everything, for `--json`."""
        return {
            "task": self.task,
            "case": self.case,
            "protocol": self.protocol,
            "truth": list(self.truth),
            "leave_out": list(self.leave_out),
            "gap_in_floors": self.gap_in_floors,
            "verdict": self.verdict,
            "right": self.strict,
            "probability": self.probability,
            "ambiguous_with": list(self.ambiguous_with),
            "accepted": list(self.accepted),
            "ranked": list(self.ranked[:5]),
            "closed": None if self.closed is None else dict(self.closed),
            "parameters": [{**vars(item), "holds": item.holds} for item in self.covered],
            "seconds": self.seconds,
            "peak_mib": self.peak_mib,
            "error": self.error,
        }


def outcome_of(task: Task, label: Mapping[str, Any], answer: Mapping[str, Any]) -> Outcome:
    """Return what an answer is worth.

    Parameters
    ----------
    task : Task
    label : mapping
        From the sealed file.
    answer : mapping
        From the diagnosing process.
    """
    about: dict[str, Any] = {
        "task": task.id,
        "case": task.case,
        "protocol": task.protocol,
        "truth": tuple(label["effects"]),
        "leave_out": task.leave_out,
        "gap_in_floors": _gap_in_floors(label),
        "seconds": answer.get("seconds"),
        "peak_mib": answer.get("peak_mib"),
    }
    if "error" in answer:
        return Outcome(**about, verdict=CRASHED, probability=0.0, error=str(answer["error"]))
    cause, gap = answer["result"]["cause"], answer["result"]["gap"]
    verdict = str(cause["verdict"])
    ranked = [item["effect"] for item in cause["candidates"]]
    if verdict in ranked:
        ranked = [verdict, *(effect for effect in ranked if effect != verdict)]
    return Outcome(
        **about,
        verdict=verdict,
        probability=float(cause["probability"]),
        ambiguous_with=tuple(cause["ambiguous_with"]),
        accepted=tuple(item["effect"] for item in cause["accepted"]),
        ranked=tuple(ranked),
        closed=_closed(gap, label, verdict),
        covered=_covered(cause, label),
    )


def _gap_in_floors(label: Mapping[str, Any]) -> float | None:
    if not label["effects"] or "gap_v" not in label:
        return None
    return float(label["gap_v"]) / float(label["floor_v"])


def _closed(gap: Mapping[str, Any], label: Mapping[str, Any], verdict: str) -> dict[str, float]:
    """Return the closed part of the gap: as the diagnosis reckons it, and by the truth's floors.

    `clean`: what a model of training and references misses on the same days without the fault;
    `sensor`: what noise, steps and start of a perfect model leave. Without a cause nothing is
    closed.
    """
    result: dict[str, float] = {}
    has_cause = verdict not in {NONE, UNKNOWN}
    if not has_cause or gap.get("closed_fraction") is not None:
        result["reported"] = float(gap["closed_fraction"]) if has_cause else 0.0
    for name in ("clean", "sensor"):
        floor = label.get(f"floor_{name}_v")
        if floor is None:
            continue
        there = float(gap["baseline_rmse_v"]) ** 2 - float(floor) ** 2
        if there <= 0.0:
            continue  # the model as given has no gap above this floor
        shrunk = float(gap["baseline_rmse_v"]) ** 2 - float(gap["extended_rmse_v"]) ** 2
        result[name] = min(shrunk / there, 1.0) if has_cause else 0.0
    return result


def _covered(cause: Mapping[str, Any], label: Mapping[str, Any]) -> tuple[Covered, ...]:
    """Return the intervals of the true cause's parameters, where the verdict named it."""
    found = []
    for fault in label["faults"]:
        if fault["id"] != cause["verdict"]:
            continue
        candidate = next(
            (item for item in cause["candidates"] if item["effect"] == fault["id"]), None
        )
        stated = {} if candidate is None else candidate["parameters"]
        for name, true in expected_parameters(fault).items():
            item = stated.get(name)
            if item is None or item.get("ci") is None:
                continue
            low, high = item["ci"]
            found.append(
                Covered(fault["id"], name, true, float(item["value"]), float(low), float(high))
            )
    return tuple(found)
