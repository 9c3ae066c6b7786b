"""Diagnosis: size, place and fault of the gap between a model and logs.

    >>> from cangauge.diagnosis import diagnose
    >>> found = diagnose(logs, model, references)  # doctest: +SKIP
    >>> print(found.summary)  # doctest: +SKIP

Modules, from the bottom up:

===========  ==================================================================================
rows         a log at 1 Hz, and what a model with an effect misses on it
shapes       every effect of the model library as columns
linear       columns and prior of the model's own coefficients
pack         the healthy pack: the model corrected by references, and how healthy logs differ
evidence     evidence, size and remaining error of every effect
sizes        the same by simulation, and sizes found without the rows that are judged
posterior    one calibrated posterior of none, unknown and nine faults
model_check  whether the model describes the healthy logs, and what it misses
correction   the model with an effect, judged on left-out rows
where        excess of the error over SoC, temperature, current, rest and time
next_step    the measurement that settles the answer
text         the answer in three lines; `words.toml` has the words of each fault
as_json      the whole answer as `gap --json` prints it
checks       logs that cannot be diagnosed
simulator    the same for any simulator's voltage
diagnose     `diagnose` and its result, `Diagnosis`
===========  ==================================================================================

The method is described in docs/diagnosis.md.
"""

from cangauge.diagnosis.diagnose import Diagnosis, diagnose, learn_references
from cangauge.diagnosis.pack import Healthy
from cangauge.diagnosis.posterior import ALARM, FAULTS, NONE, UNKNOWN, Posterior
from cangauge.diagnosis.where import Errors

__all__ = [
    "ALARM",
    "FAULTS",
    "NONE",
    "UNKNOWN",
    "Diagnosis",
    "Errors",
    "Healthy",
    "Posterior",
    "diagnose",
    "learn_references",
]
