"""What the diagnosis would find on a pack: effects injected into its own healthy logs.

Each log is left out in turn and diagnosed with the others as references, as recorded and with every
effect of the twin at three sizes (`twin.injection`). Sizes are gaps in multiples of the floor, the
RMS error of the model on the references; physical limits may allow only a smaller one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge._formatting import NONE_KNOWN, number, significant
from cangauge.diagnosis import (
    NONE,
    DiagnosisProblem,
    Verdict,
    build_problem,
    decide,
    design_of,
)
from cangauge.errors import InputError
from cangauge.extras.validation.cases import FaultRequest
from cangauge.extras.validation.twin.faults import fault_kind, fault_kinds
from cangauge.extras.validation.twin.injection import (
    fit_surrogate_pack,
    inject,
    scale_injection,
    soc_of,
)
from cangauge.extras.validation.twin.pack import Pack
from cangauge.extras.validation.twin.recording import rms
from cangauge.identify.fit import fit
from cangauge.identify.starts import start_by_model, with_start
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

GAPS: Final = (1.0, 2.0, 4.0)
"""Injected gaps, in floors."""
LEAST_LOGS: Final = 3
SCHEMA: Final = 1


@dataclass(frozen=True)
class Finding:
    """The diagnosis of one injected effect."""

    log: str
    effect: str
    floors: float
    """Wanted gap, in floors."""
    size: float
    """In the unit of the effect (`FaultKind.unit`)."""
    gap_v: float
    """Gap reached [V]."""
    limited: bool
    """Whether the physical limits allow only a smaller gap."""
    probability: float
    """Of the true effect."""
    verdict: str

    @property
    def named(self) -> bool:
        """Whether the verdict is the true effect."""
        return self.verdict == self.effect


@dataclass(frozen=True)
class Healthy:
    """The diagnosis of a log as recorded."""

    log: str
    floor_v: float
    probability_none: float
    verdict: str


@dataclass(frozen=True, eq=False)
class OwnLogs:
    """Healthy logs of a pack, each with its start, and a model.

    Parameters
    ----------
    logs : tuple of Log
    references : tuple of Log
        Further healthy logs, never left out.
    model : Model, optional
        By default fitted to all logs but the one left out.
    capacity_ah : float, optional
        Charge from 100 to 0 % [Ah], for that fit.
    """

    logs: tuple[Log, ...]
    references: tuple[Log, ...] = ()
    model: Model | None = None
    capacity_ah: float | None = None

    def __post_init__(self) -> None:
        if len(self.logs) + len(self.references) < LEAST_LOGS:
            raise InputError(
                f"{len(self.logs) + len(self.references)} healthy logs are too few: one is"
                f" diagnosed, the others are its references",
                field="LOG",
                cure=f"give at least {LEAST_LOGS}",
            )

    def findings(self, at_most: int | None = None) -> Iterator[Healthy | Finding]:
        """Yield the diagnoses of each log left out: as recorded, then with every effect.

        Parameters
        ----------
        at_most : int, optional
            Leave out at most this many logs, evenly among them.

        Raises
        ------
        InputError
            As `diagnose` and `fit`.
        """
        for k in self.left_out(at_most):
            others = [*self.logs[:k], *self.logs[k + 1 :], *self.references]
            model = self.model or fit(others, capacity_ah=self.capacity_ah).model
            log = _started(self.logs[k], model)
            problem = build_problem([log], model, others)
            healthy = _healthy(problem, decide(problem))
            yield healthy
            pack = fit_surrogate_pack(
                [log, *(_started(each, model) for each in others)],
                capacity_ah=model.capacity_ah,
                cells=problem.given.pack.cells,
            )
            for kind in fault_kinds():
                for floors in GAPS:
                    found = _found(problem, log, pack, kind.id, (floors, healthy.floor_v))
                    yield found
                    if found.limited:
                        break  # no larger one is possible

    def left_out(self, at_most: int | None) -> list[int]:
        """Return the indices of the logs that are left out in turn."""
        number = len(self.logs) if at_most is None else min(at_most, len(self.logs))
        evenly = np.linspace(0.0, len(self.logs) - 1.0, number)
        return sorted({round(place) for place in evenly.tolist()})


PER_LOG: Final = 1 + len(fault_kinds()) * len(GAPS)
"""Diagnoses of each log left out, at most."""


def _started(log: Log, model: Model) -> Log:
    """Return the log with a start, found from the voltage where it states none."""
    if log.first_soc() is not None:
        return log
    return with_start(log, start_by_model(log, model).soc_pct)


def _healthy(problem: DiagnosisProblem, verdict: Verdict) -> Healthy:
    return Healthy(
        log=problem.diagnosed[0].sampled.log.name,
        floor_v=rms(np.concatenate(problem.reference_errors_v)),
        probability_none=verdict.probabilities[NONE],
        verdict=verdict.cause,
    )


def _found(
    problem: DiagnosisProblem, log: Log, pack: Pack, effect: str, gap: tuple[float, float]
) -> Finding:
    """Inject an effect of a gap (in floors; floor [V]) and diagnose it.

    References and error model stay those of the log as recorded: only the diagnosed log changes.
    """
    floors, floor_v = gap
    request = FaultRequest(fault_kind(effect), floors * floor_v, 1.0, seed=0)
    fullest = float(soc_of(log, pack.capacity_ah)[0])
    fault = request.fault(shortest_s=log.duration_s, fullest=fullest)
    scaled = scale_injection([log], fault, request.target_v, pack)
    injected = inject(log, [scaled.fault], pack)
    changed = replace(problem, diagnosed=(design_of(problem, injected.log),))
    verdict = decide(changed)
    return Finding(
        log=log.name,
        effect=effect,
        floors=floors,
        size=scaled.fault.size,
        gap_v=scaled.reached_v,
        limited=scaled.limited,
        probability=verdict.probabilities[effect],
        verdict=verdict.cause,
    )


def summarize(found: Sequence[Healthy | Finding]) -> dict[str, Any]:
    """Return the result as one JSON object.

    An effect counts as named at a size where it is in more than half of the logs left out.
    """
    healthy = [item for item in found if isinstance(item, Healthy)]
    findings = [item for item in found if isinstance(item, Finding)]
    return {
        "schema": SCHEMA,
        "floor_v": float(np.mean([item.floor_v for item in healthy])),
        "healthy": [asdict(item) for item in healthy],
        "effects": [
            _effect(kind.id, [item for item in findings if item.effect == kind.id])
            for kind in fault_kinds()
        ],
        "cases": [asdict(item) for item in findings],
    }


def _effect(effect: str, findings: Sequence[Finding]) -> dict[str, Any]:
    kind = fault_kind(effect)
    sizes: list[dict[str, Any]] = [
        {
            "gap_floors": floors,
            "size": float(np.mean([abs(item.size) for item in of_size])),
            "gap_v": float(np.mean([item.gap_v for item in of_size])),
            "limited": any(item.limited for item in of_size),
            "probability": float(np.mean([item.probability for item in of_size])),
            "named": sum(item.named for item in of_size),
            "of": len(of_size),
            "verdicts": sorted({item.verdict for item in of_size}),
        }
        for floors in GAPS
        if (of_size := [item for item in findings if item.floors == floors])
    ]
    named = [each["size"] for each in sizes if 2 * each["named"] > each["of"]]
    return {
        "effect": effect,
        "parameter": kind.parameter,
        "unit": kind.unit,
        "sizes": sizes,
        "smallest_named": named[0] if named else None,
    }


def table(result: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows: probability of each effect, and the smallest size named."""
    rows = []
    for item in result["effects"]:
        cells = [_cell(item, floors) for floors in GAPS]
        rows.append([item["effect"], *cells, _with_unit(item["smallest_named"], item["unit"])])
    headings = [f"gap of {floors:g} floor{'s' * (floors > 1.0)}" for floors in GAPS]
    return ["<effect", *headings, "smallest size named"], rows


def _cell(item: Mapping[str, Any], floors: float) -> str:
    """Return size, probability and how often it is named; a dash where none is possible."""
    found = next((each for each in item["sizes"] if each["gap_floors"] == floors), None)
    if found is None:
        return NONE_KNOWN
    limit = " (its limit)" if found["limited"] else ""
    named = f"named {found['named']}/{found['of']}"
    size = _with_unit(found["size"], item["unit"])
    return f"{size}{limit}: {number(found['probability'], 2)}, {named}"


def _with_unit(size: float | None, unit: str) -> str:
    return significant(size, 2, "" if unit == "-" or size is None else unit)


def summary(result: Mapping[str, Any]) -> str:
    """Return what this diagnosis would find, in a sentence or two."""
    named = [item["effect"] for item in result["effects"] if item["smallest_named"] is not None]
    never = [item["effect"] for item in result["effects"] if item["smallest_named"] is None]
    healthy = result["healthy"]
    quiet = sum(item["verdict"] == NONE for item in healthy)
    text = f"Named at some size: {', '.join(named) or 'no effect'}."
    if never:
        text += f" Never: {', '.join(never)}."
    return (
        f"{text} {quiet} of {len(healthy)} logs as recorded are judged to be without a fault."
        f" A floor is {number(result['floor_v'], 2, 'V')}."
    )
