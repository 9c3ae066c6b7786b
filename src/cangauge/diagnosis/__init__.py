"""Diagnosis: size, place and cause of the gap between a model and logs.

    >>> from cangauge.diagnosis import diagnose
    >>> found = diagnose(logs, model, references)  # doctest: +SKIP
    >>> found.summary, found.extended_model  # doctest: +SKIP

Modules, in the order in which a diagnosis uses them:

==================  ==============================================================================
diagnose            `diagnose` and its result, `Diagnosis`
problem             checked logs, linearised: the basis of the verdict
references          what references show of healthy logs: error, structure, coverage
input_checks        errors for logs of another pack, dead channels, duplicates; removes outliers
hypotheses          candidate effects: cause, shared structure, per-log effects
design_matrix       sensitivity of a log's voltage residual to every amplitude
linear_gaussian     normal equations of logs; posterior of the amplitudes
error_model         error of healthy logs by time scale, prior scales, overdispersion
structure           structure that the references need, and the model with it
bayes_factors       Bayes factor of every effect against no effect
posterior           effect features → probabilities of `none`, every effect and `unknown`
verdict             probabilities → verdict, alarm, credible set, family; ceiling
cross_validation    errors on held-out rows, closed fraction, SoC error
extended_model      refined amplitudes, change points; the extended model file
error_breakdown     shares of the error, worst segments, maps
caveats             limits of what the logs can show
profiles            current profiles of tests within limits
next_test           which test would separate the likely causes best
==================  ==============================================================================

The method is described in docs/diagnosis.md.
"""

from cangauge.diagnosis.cross_validation import rms
from cangauge.diagnosis.diagnose import LIKELY, Diagnosis, diagnose
from cangauge.diagnosis.error_breakdown import (
    MIN_BIN_ROWS,
    SEGMENT_S,
    SEGMENTS,
    ErrorMap,
    ErrorShare,
    LogErrors,
    SegmentSignals,
    WorstSegment,
    error_map,
    segment_signals,
)
from cangauge.diagnosis.next_test import design_of
from cangauge.diagnosis.posterior import NONE, UNKNOWN
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.diagnosis.references import LearnedReferences, learn_references
from cangauge.diagnosis.verdict import ALARM_BELOW, Ceiling, Verdict, decide

__all__ = [
    "ALARM_BELOW",
    "LIKELY",
    "MIN_BIN_ROWS",
    "NONE",
    "SEGMENTS",
    "SEGMENT_S",
    "UNKNOWN",
    "Ceiling",
    "Diagnosis",
    "DiagnosisProblem",
    "ErrorMap",
    "ErrorShare",
    "LearnedReferences",
    "LogErrors",
    "SegmentSignals",
    "Verdict",
    "WorstSegment",
    "build_problem",
    "decide",
    "design_of",
    "diagnose",
    "error_map",
    "learn_references",
    "rms",
    "segment_signals",
]
