"""Validation: simulated truth (`twin`) and the withheld check of the diagnosis.

The check draws causes, withholds them, diagnoses in processes that get logs and model only, and
scores the answers::

    plan         protocols → planned cases, each with its seed
    cases        a planned case → logs with a fault, in memory
    recordings   recorded logs: healthy ones to inject faults into, laboratory ones with known cause
    generation   cases → files for the diagnosis, labels for the scorer
    worker       the diagnosing process; `worker_pool` runs several
    check        draw, withhold, diagnose, evaluate
    score        labels and answers → figures; `tables` prints them
    final_seeds  seeds of the published figures

The diagnosis on one's own healthy logs injects the same faults::

    own_logs     every effect injected into logs of one pack, each left out in turn

The estimator's bench on recorded packs is apart from it::

    packs             recorded packs: logs that train models, logs that judge them
    packs_run         models from few logs, and the other logs estimated by them in every case
    packs_quantities  capacity, offset, power, energy and weakest cell beside what the log shows
    packs_score       errors, σ and targets; the tables

The public names are those of the twin, loaded on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cangauge.extras.validation.twin import (
        Fault,
        FaultKind,
        Simulation,
        fault_kinds,
        read_speed,
        simulate,
    )

__all__ = ["Fault", "FaultKind", "Simulation", "fault_kinds", "read_speed", "simulate"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module("cangauge.extras.validation.twin"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
