"""State of charge from CAN frames by an identified voltage model, and the diagnosis of its gaps.

Data flows one way: logs → model; frames → samples → estimate → frames; model + logs → diagnosis.
Positive current discharges, everywhere.

========================================  ==========================================================
`read_log`, `Log`                         a log, capture or data frame as time series
`fit`, `Identification`                   logs → model, with its errors
`Model`                                   the identified voltage model and its file
`estimate`, `EstimateTable`               SoC at every sample of a log
`Estimator`, `Sample`, `Estimate`         the same, one sample at a time
`diagnose`, `Diagnosis`                   where an error lies, what causes it, how far it shrinks
`judge`, `Judgement`                      whether the SoC of another gauge is right, and why not
`Vehicle`, `Service`                      the signals of a car; the service on its bus
`simulate`, `Simulation`                  a simulated pack and drive, with or without faults
`CangaugeError`, `InputError`             failures; wrong input, with field, value and cure
========================================  ==========================================================

Names are loaded on first use: `import cangauge` alone imports nothing else.

Examples
--------
>>> import cangauge
>>> drives = [cangauge.simulate(seed=1, drive=number, hours=1.0).log for number in (1, 2, 3)]
>>> model = cangauge.fit(drives[:2], capacity_ah=60.0).model
>>> table = cangauge.estimate(drives[2], model)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from cangauge._version import __version__ as __version__

if TYPE_CHECKING:
    from cangauge.bus.recording import read_log as read_log
    from cangauge.bus.vehicle import Vehicle as Vehicle
    from cangauge.diagnosis import Diagnosis as Diagnosis
    from cangauge.diagnosis import diagnose as diagnose
    from cangauge.errors import CangaugeError as CangaugeError
    from cangauge.errors import InputError as InputError
    from cangauge.estimation.estimator import Estimator as Estimator
    from cangauge.estimation.offline import EstimateTable as EstimateTable
    from cangauge.estimation.offline import estimate as estimate
    from cangauge.extras.judge.judgement import judge as judge
    from cangauge.extras.judge.result import Judgement as Judgement
    from cangauge.extras.validation.twin.simulation import Simulation as Simulation
    from cangauge.extras.validation.twin.simulation import simulate as simulate
    from cangauge.identify.fit import fit as fit
    from cangauge.identify.identification import Identification as Identification
    from cangauge.logs.log import Log as Log
    from cangauge.model.model_file import Model as Model
    from cangauge.service.run import Service as Service
    from cangauge.types import Estimate as Estimate
    from cangauge.types import Sample as Sample

_PLACES: Final = {
    "CangaugeError": "errors",
    "Diagnosis": "diagnosis",
    "Estimate": "types",
    "EstimateTable": "estimation.offline",
    "Estimator": "estimation.estimator",
    "Identification": "identify.fit",
    "InputError": "errors",
    "Judgement": "extras.judge.result",
    "Log": "logs.log",
    "Model": "model.model_file",
    "Sample": "types",
    "Service": "service.run",
    "Simulation": "extras.validation.twin.simulation",
    "Vehicle": "bus.vehicle",
    "__version__": "_version",
    "diagnose": "diagnosis",
    "estimate": "estimation.offline",
    "fit": "identify.fit",
    "judge": "extras.judge.judgement",
    "read_log": "bus.recording",
    "simulate": "extras.validation.twin.simulation",
}
"""Module of each public name."""
__all__ = list(_PLACES)
_FUNCTIONS: Final = ("diagnose", "estimate", "fit", "read_log", "simulate")
"""Functions whose errors name arguments where those of a command name options."""


def __getattr__(name: str) -> Any:
    place = _PLACES.get(name)
    if place is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{place}"), name)
    if name in _FUNCTIONS:
        found = import_module(f"{__name__}.errors").naming_arguments(found)
    return globals().setdefault(name, found)


def __dir__() -> list[str]:
    return sorted(__all__)
