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
from cangauge.diagnosis.faults import FAULT
from cangauge.errors import InputError
from cangauge.extras.validation.twin.drive import draw_drive
from cangauge.extras.validation.twin.faults import Fault, fault_kinds
from cangauge.extras.validation.twin.injection import fit_surrogate_pack, inject, scale_injection
from cangauge.extras.validation.twin.pack import TwinPack, draw_pack
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.identify.fit import fit
from cangauge.logs.log import Log

FLOORS: Final = (1.0, 2.0, 4.0)
"""Injected sizes [floors]."""
LEAST_LOGS: Final = 4
"""One is diagnosed, three are its references, as `gap` asks for."""
SCHEMA: Final = 3
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


def own_pack(logs: Sequence[Log], capacity_ah: float, cells: int) -> TwinPack:
    """Return one's own pack, whose physics is fitted to its healthy logs.

    Raises
    ------
    InputError
        If there are too few logs, or one has no SoC.
    """
    if len(logs) < LEAST_LOGS:
        problem = f"{len(logs)} healthy logs are too few"
        problem += ": one is diagnosed, the others are its references"
        raise InputError(problem, field="--logs", cure=f"give at least {LEAST_LOGS}")
    return fit_surrogate_pack(logs, capacity_ah=capacity_ah, cells=cells)


def simulated_logs() -> tuple[list[Log], TwinPack]:
    """Return a discharge and five drives of a simulated pack, and the pack."""
    pack, rng = draw_pack(np.random.default_rng([1, 1])), np.random.default_rng([1, 2])
    ambient_c = rng.uniform(8.0, 25.0)
    full = draw_drive(
        rng, pack, hours=2.0, ambient_c=ambient_c, start_soc=1.0, end_soc=0.05, discharge=True
    )
    drives = [
        draw_drive(rng, pack, hours=0.8, ambient_c=ambient_c + away)
        for away in np.linspace(-7.0, 7.0, 5)
    ]
    recorded = enumerate((full, *drives), 1)
    return [record_drive(pack, drive, name=f"drive_{k}").log for k, drive in recorded], pack


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
    """
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
    for kind in fault_kinds():
        shape = {"at_s": 0.4 * log.duration_s} if "at_s" in kind.shape else {}
        wanted = Fault(kind.id, -1.0 if kind.id == "initial_soc" else 1.0, shape)
        for floors in FLOORS:
            fault, reached_v = scale_injection(log, wanted, floors * floor_v, pack)
            if reached_v < _REACHED * floors * floor_v:
                break  # no larger size is possible
            yield inject(log, [fault], pack).log, fault, reached_v / floor_v


PER_LOG: Final = 1 + len(fault_kinds()) * len(FLOORS)
"""Diagnoses of each log left out, at most."""


def summarize(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the result as one JSON object."""
    healthy = [item for item in findings if item.effect is None]
    faults = []
    for fault in FAULTS:
        found = [item for item in findings if item.fault == fault]
        sizes = [_size(floors, found) for floors in FLOORS]
        faults.append({"fault": fault, "sizes": [size for size in sizes if size["of"]]})
    return {
        "schema": SCHEMA,
        "healthy": {
            "logs": len(healthy),
            "alarms": sum(item.detected for item in healthy),
            "probability_none": float(np.mean([item.probability for item in healthy])),
        },
        "faults": faults,
        "cases": [asdict(item) for item in findings],
    }


def _size(floors: float, findings: Sequence[Finding]) -> dict[str, Any]:
    """Return how often a fault was found at a size at which it was injected."""
    of = [item for item in findings if _REACHED * floors <= item.floors < floors / _REACHED]
    return {
        "floors": floors,
        "of": len(of),
        "first": sum(item.first for item in of),
        "stated": sum(item.stated for item in of),
        "stated_right": sum(item.stated and item.first for item in of),
        "detected": sum(item.detected for item in of),
        "probability": sum(item.probability for item in of) / max(len(of), 1),
    }


def table(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows: how often each fault comes first, and is stated alone."""
    rows = []
    for item in result["faults"]:
        cells = dict.fromkeys(FLOORS, NONE_KNOWN)
        for of in item["sizes"]:
            cells[of["floors"]] = "{first}/{of}, {stated_right}/{stated}".format_map(of)
        rows.append([FAULT[item["fault"]].title, *cells.values()])
    return ["fault", *(f"{floors:g} floor{'s' * (floors > 1)}" for floors in FLOORS)], rows


def summary(result: dict[str, Any]) -> str:
    """Return what this diagnosis would find, in a sentence or two."""
    sizes = [each for item in result["faults"] for each in item["sizes"]]
    of, first, stated, right = (
        sum(each[name] for each in sizes) for name in ("of", "first", "stated", "stated_right")
    )
    shares = [number(100.0 * part / max(of, 1), 0, "%") for part in (first, stated)]
    healthy = result["healthy"]
    return (
        f"The right fault came first in {shares[0]} of {of} injected effects;"
        f" one fault was stated in {shares[1]}, right in {right} of"
        f" {stated}. False alarms: {healthy['alarms']} of {healthy['logs']} healthy logs."
    )
