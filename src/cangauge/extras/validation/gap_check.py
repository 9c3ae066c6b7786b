"""What the diagnosis would find on a pack: every effect injected into healthy logs of it.

Each log is left out in turn and diagnosed with the others as references, by a model fitted to
them: as recorded, and with every effect of the twin at three sizes. A size is the RMS change of
voltage that it makes, in floors: a floor is the RMS error of left-out references. The logs are
one's own, or those of a simulated pack.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from cangauge._text import NONE_KNOWN, number
from cangauge.diagnosis import FAULTS, NONE, diagnose, learn_references
from cangauge.diagnosis.text import FAULT
from cangauge.errors import InputError
from cangauge.extras.validation.twin.faults import FAULT_KINDS, Fault
from cangauge.extras.validation.twin.injection import drive_of, inject
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin.recording import scale_to_gap
from cangauge.extras.validation.twin.simulation import simulate
from cangauge.identify.fit import fit
from cangauge.logs.log import Log

FLOORS: Final = (1.0, 2.0, 4.0)
"""Injected sizes [floors]."""
_REACHED: Final = 0.8
"""Part of the wanted size below which the physical limits of an effect count as reached."""


@dataclass(frozen=True)
class Finding:
    """The diagnosis of one log."""

    log: str
    effect: str | None
    """Injected effect; None: the log as recorded."""
    floors: float
    """Size reached [floors]."""
    size: float
    unit: str
    fault: str
    """Injected fault, or `none`."""
    first: bool
    """Whether the likeliest fault is the injected one."""
    stated: bool
    """Whether one fault was stated."""
    detected: bool
    probability: float
    """Of the truth."""


def simulated_logs() -> tuple[list[Log], TwinPack]:
    """Return a discharge and five drives of a simulated pack from 9 to 23 °C, and the pack."""
    runs = [simulate(seed=1, hours=2.0, ambient_c=16.0, discharge=True, name="drive_1")]
    runs += [
        simulate(seed=1, drive=k, hours=0.8, ambient_c=2.0 + 3.5 * k, name=f"drive_{k}")
        for k in range(2, 7)
    ]
    return [run.recording.log for run in runs], runs[0].pack


def find(logs: Sequence[Log], pack: TwinPack, at_most: int | None = None) -> Iterator[Finding]:
    """Yield the diagnoses of each log left out: as it is, then with every effect.

    Parameters
    ----------
    logs : sequence of Log
        Healthy logs of one pack, at least four, each with its start in `soc_pct`.
    pack : TwinPack
        Its physics, for the injected effects.
    at_most : int, optional
        Leave out at most this many logs, evenly among them.

    Raises
    ------
    InputError
        If there are too few logs.
    """
    if len(logs) < 4:  # `gap` asks for three references
        problem = f"{len(logs)} healthy logs are too few"
        problem += ": one is diagnosed, the others are its references"
        raise InputError(problem, field="--logs", cure="give at least 4")
    count = min(at_most or len(logs), len(logs))
    for k in np.linspace(0.0, len(logs) - 1.0, count).round().astype(int).tolist():
        others = [*logs[:k], *logs[k + 1 :]]
        model = fit(others, capacity_ah=pack.capacity_ah).model
        known = learn_references(others, model)
        for log, fault, floors in _cases(logs[k], pack, known.rmse_v):
            found = diagnose(log, model, known).posterior
            truth = NONE
            if fault is not None:
                truth = next(k for k in found.faults if fault.id in found.effects(k))
            yield Finding(
                log=log.name,
                effect=fault.id if fault else None,
                floors=floors,
                size=fault.size if fault else 0.0,
                unit=fault.kind.unit if fault else "",
                fault=truth,
                first=next(iter(found.faults)) == truth,
                stated=len(found.stated) == 1,
                detected=found.level == "gap",
                probability=found.faults.get(truth, found.none),
            )


def _cases(log: Log, pack: TwinPack, floor_v: float) -> Iterator[tuple[Log, Fault | None, float]]:
    """Yield a log as it is, then with every effect at each possible size [floors]."""
    yield log, None, 0.0
    drive = drive_of(log, pack.capacity_ah)
    for kind in FAULT_KINDS.values():
        shape = {"at_s": 0.4 * log.duration_s} if "at_s" in kind.shape else {}
        wanted = Fault(kind.id, -1.0 if kind.id == "initial_soc" else 1.0, shape)
        for floors in FLOORS:
            fault, reached_v = scale_to_gap(pack, drive, wanted, floors * floor_v)
            if reached_v < _REACHED * floors * floor_v:
                break  # no larger size is possible
            yield inject(log, [fault], pack)[0], fault, reached_v / floor_v


def summarize(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the result as one JSON object."""
    healthy = [item for item in findings if item.effect is None]
    faulty = [item for item in findings if item.effect is not None]
    faults = []
    for fault in FAULTS:
        sizes = []
        for floors in FLOORS:
            lowest, highest = _REACHED * floors, floors / _REACHED
            of = [x for x in faulty if x.fault == fault and lowest <= x.floors < highest]
            if of:
                sizes.append({"floors": floors, **_counts(of)})
        faults.append({"fault": fault, "sizes": sizes})
    return {
        "schema": 3,
        "healthy": {
            "logs": len(healthy),
            "alarms": sum(item.detected for item in healthy),
            "probability_none": float(np.mean([item.probability for item in healthy])),
        },
        "injected": _counts(faulty),
        "faults": faults,
        "cases": [asdict(item) for item in findings],
    }


def _counts(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return how often an injected fault was found."""
    return {
        "of": len(findings),
        "first": sum(item.first for item in findings),
        "stated": sum(item.stated for item in findings),
        "stated_right": sum(item.stated and item.first for item in findings),
        "detected": sum(item.detected for item in findings),
        "probability": float(np.mean([item.probability for item in findings])),
    }


def table(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows: how often each fault comes first, and is stated alone."""
    rows = []
    for item in result["faults"]:
        cells = dict.fromkeys(FLOORS, NONE_KNOWN)
        for of in item["sizes"]:
            cells[of["floors"]] = "{first}/{of}, {stated_right}/{stated}".format_map(of)
        rows.append([FAULT[item["fault"]]["title"], *cells.values()])
    return ["fault", *(f"{floors:g} floor{'s' * (floors > 1)}" for floors in FLOORS)], rows


def summary(result: dict[str, Any]) -> str:
    """Return what this diagnosis would find, in a sentence or two."""
    found, healthy = result["injected"], result["healthy"]
    first, stated = (number(100.0 * found[x] / found["of"], 0, "%") for x in ("first", "stated"))
    return (
        f"The right fault came first in {first} of {found['of']} injected effects;"
        f" one fault was stated in {stated}, right in {found['stated_right']} of"
        f" {found['stated']}. False alarms: {healthy['alarms']} of {healthy['logs']} healthy logs."
    )
