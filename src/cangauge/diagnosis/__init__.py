"""Diagnosis: size, place and cause of the gap between a model and logs.

    >>> from cangauge.diagnosis import diagnose
    >>> found = diagnose(logs, model, references)  # doctest: +SKIP
    >>> print(found.summary)  # doctest: +SKIP

Modules, from the bottom up:

=========  ====================================================================================
pack_fit   1 Hz signals; curve and structure of a pack by a ridge fit of the references
trials     every effect: undone at a size, and as a column
columns    columns of one log on the rows that count, and their products
evidence   what references show; evidence, size and remaining error of every effect
answer     one posterior of none, unknown and the library; groups, names, what to check
extended   the cause as parameters of the model's effects; the extended model, judged
where      shares of the error over SoC, current, temperature, time and time scale
checks     logs that cannot be diagnosed
sentences  what a user reads
diagnose   `diagnose` and its result, `Diagnosis`
simulator  the same for any simulator's voltage
=========  ====================================================================================

The method is described in docs/diagnosis.md.
"""

from cangauge.diagnosis.answer import ALARM, GROUP_OF, GROUPS, NONE, UNKNOWN, Posterior
from cangauge.diagnosis.diagnose import Diagnosis, diagnose, learn_references
from cangauge.diagnosis.evidence import Evidence, References
from cangauge.diagnosis.where import LogErrors

__all__ = [
    "ALARM",
    "GROUPS",
    "GROUP_OF",
    "NONE",
    "UNKNOWN",
    "Diagnosis",
    "Evidence",
    "LogErrors",
    "Posterior",
    "References",
    "diagnose",
    "learn_references",
]
