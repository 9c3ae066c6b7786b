"""Plan of the next test: the log that separates the likely causes best.

A test with the current profile of `profiles` adds the information ΔS to the curvature S of the log
likelihood of all amplitudes, with everything else marginalised. If a is the cause's amplitude, the
test adds the gradient Δg = ΔS·a plus noise of covariance ΔS to g: this is exact for a linear
Gaussian model, and needs the columns of the test alone. For each cause of the credible set,
amplitudes are drawn from its posterior and gradients from this; the probabilities then follow from
the nats that each effect explains, as in `posterior`. Its other two measures, of the error that
remains, are held at their present values. The test with the largest expected information about the
cause is proposed (Lindley, Annals of Mathematical Statistics 27 (1956) 986).

`unknown` predicts nothing and is left out.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from cangauge._typing import FloatArray
from cangauge.diagnosis.bayes_factors import PRIOR_WIDTHS, bounded_evidence
from cangauge.diagnosis.design_matrix import DesignMatrix, candidates_for, design_matrix
from cangauge.diagnosis.hypotheses import Hypotheses, Indices, prior_precision
from cangauge.diagnosis.linear_gaussian import Posterior, marginalize
from cangauge.diagnosis.posterior import (
    NONE,
    UNKNOWN,
    Evidence,
    evidence_of,
    posterior_of,
)
from cangauge.diagnosis.problem import DiagnosisProblem
from cangauge.diagnosis.profiles import Limits, Profile, library_of_tests
from cangauge.diagnosis.references import sampled_for_diagnosis
from cangauge.diagnosis.verdict import Verdict
from cangauge.logs.log import Log

_LOG = logging.getLogger(__name__)

DRAWS = 200
"""Simulated outcomes of a test for each cause; the standard error of an expected probability is at
most 4 %, and the tests share the random numbers."""

_IN_WORDS = {NONE: "no fault"}

NAMED = 4
"""Causes that sentence and table name; a plan is for all of the credible set."""


@dataclass(frozen=True, eq=False)
class PlannedTest:
    """A test, and what is expected of it."""

    profile: Profile
    information_nats: float
    """Expected information about the cause."""
    expected: dict[str, float]
    """Cause of the credible set → its expected probability after the test if it is true."""
    probability: float
    """Expected probability of the true cause, over the credible set."""

    def to_dict(self) -> dict[str, Any]:
        """Return the object of `gap --json`."""
        return {
            "test": self.profile.name,
            "start_soc_pct": self.profile.start_soc_pct,
            "start_temperature_c": self.profile.start_c,
            "minutes": self.profile.time_s[-1] / 60.0,
            "information_nats": self.information_nats,
            "probability_expected": self.probability,
            "expected": self.expected,
        }


@dataclass(frozen=True, eq=False)
class Plan:
    """Tests in the order of their expected information, one of each kind."""

    limits: Limits
    causes: tuple[str, ...]
    """Answers that the test is to separate: the credible set without `unknown`."""
    before: dict[str, float]
    """Probabilities of these answers now, given that none is `unknown`."""
    tests: tuple[PlannedTest, ...]

    @property
    def probability(self) -> float:
        """Expected probability of the true cause now."""
        weights = _weights(self.before, self.causes)
        return sum(weight * self.before[name] for name, weight in weights.items())

    @property
    def best(self) -> PlannedTest:
        """The proposed test."""
        return self.tests[0]

    @property
    def helps(self) -> bool:
        """Whether the proposed test is expected to add a percent or more of probability."""
        return self.best.probability >= self.probability + 0.01

    @property
    def sentence(self) -> str:
        """The proposal in an engineer's words."""
        best = self.best.profile
        if not self.helps:
            return (
                "No test within the limits is expected to make the cause more certain: the"
                f" probability of the right one is {self.probability:.0%} now, and expected to be"
                f" {self.best.probability:.0%} after the best, {best.name}."
            )
        names = [_IN_WORDS.get(name, name) for name in self.causes]
        if len(names) > NAMED:
            names[NAMED:] = [f"{len(names) - NAMED} more"]
        purpose = f"distinguish {names[0]} from {', '.join(names[1:])}" if names[1:] else (
            f"confirm {names[0]}"
        )  # fmt: skip
        return (
            f"To {purpose}, run next: {best.name}, {best.time_s[-1] / 60.0:.0f} min, starting at"
            f" {best.start_soc_pct:.0f} % SoC and {best.start_c:.0f} °C. The probability of the"
            f" right one is expected to rise from {100.0 * self.probability:.0f} to"
            f" {100.0 * self.best.probability:.0f} %."
        )

    def to_dict(self, file: str | None = None) -> dict[str, Any]:
        """Return the object of `gap --json`.

        Parameters
        ----------
        file : str, optional
            Path of the profile.
        """
        return {
            "sentence": self.sentence,
            "causes": list(self.causes),
            "probability_now": self.probability,
            **self.best.to_dict(),
            "tests": [test.to_dict() for test in self.tests],
            "limits": asdict(self.limits),
            "file": file,
        }


@dataclass(frozen=True, eq=False)
class AddedTest:
    """A diagnosis before and after a further test."""

    names: tuple[str, ...]
    """Of the test's logs."""
    before: Verdict
    after: Verdict

    @property
    def sentence(self) -> str:
        """Change of each probability."""
        answers = dict.fromkeys([*self.before.credible_set, *self.after.credible_set])
        changes = [
            f"{name} {100.0 * self.before.probabilities[name]:.0f} →"
            f" {100.0 * self.after.probabilities[name]:.0f} %"
            for name in answers
        ]
        return f"With {', '.join(self.names)}: {', '.join(changes)}."

    def to_dict(self) -> dict[str, Any]:
        """Return the object of `gap --json`."""
        return {
            "logs": list(self.names),
            **{
                when: {
                    "verdict": verdict.cause,
                    "probability": verdict.probability,
                    "credible_set": list(verdict.credible_set),
                    "probabilities": verdict.probabilities,
                }
                for when, verdict in (("before", self.before), ("after", self.after))
            },
        }


@dataclass(frozen=True, eq=False)
class NextSteps:
    """What goes beyond one diagnosis: a test that was added, one that is proposed."""

    added: AddedTest | None = None
    plan: Plan | None = None


def plan_test(problem: DiagnosisProblem, verdict: Verdict, limits: Limits | None = None) -> Plan:
    """Return the tests that would separate the causes of the credible set, best first.

    Parameters
    ----------
    problem : DiagnosisProblem
    verdict : Verdict
        On the same problem.
    limits : Limits, optional
        By default what the references usually show.

    Raises
    ------
    InputError
        If the limits allow no test.
    """
    limits = limits or Limits.of(problem)
    judged = evidence_of(problem)
    before = _without_unknown(posterior_of(judged))
    causes = tuple(name for name in verdict.credible_set if name != UNKNOWN)
    causes = causes or (max(before, key=before.__getitem__),)
    now = _tempered(problem.posterior)
    simulated = Outcomes.of(now, causes, np.random.default_rng(0))
    best: dict[str, PlannedTest] = {}
    for profile in _profiles(problem, limits):
        _LOG.debug("planning: %s from %.0f %%", profile.name, profile.start_soc_pct)
        added = _information(problem, profile)
        test = expected_of(profile, now, added, simulated, judged)
        known = best.get(profile.name)
        if known is None or test.information_nats > known.information_nats:
            best[profile.name] = test
    tests = sorted(best.values(), key=lambda test: -test.information_nats)
    return Plan(limits, causes, {name: before[name] for name in causes}, tuple(tests))


def design_of(problem: DiagnosisProblem, log: Log) -> DesignMatrix:
    """Return the design matrix of a further log of the same cause."""
    options = replace(problem.options, initial_soc_pct=None)
    sampled = sampled_for_diagnosis(log, options, soc_tolerance_pct=np.inf)
    of_log = candidates_for(problem.hypotheses.candidates, problem.model.pack, sampled)
    return design_matrix(sampled, problem.model, of_log, problem.structured)


def _profiles(problem: DiagnosisProblem, limits: Limits) -> list[Profile]:
    known = problem.references or [matrix.sampled for matrix in problem.diagnosed]
    usual_c = float(np.median(np.concatenate([each.rows.temperature_c for each in known])))
    lead_s = max(problem.options.delay_s)
    return library_of_tests(limits, problem.model.pack, usual_c=usual_c, lead_s=lead_s)


def _information(problem: DiagnosisProblem, profile: Profile) -> FloatArray:
    """Return what a test adds to the curvature of the amplitudes."""
    design = design_of(problem, profile.log(problem.model.pack.voltage_v))
    test = replace(problem, diagnosed=(design,))
    logs = (*problem.weighted_equations, *test.weighted_equations)
    after = marginalize(problem.hypotheses, problem.reference_equations, logs, problem.error)
    return after.curvature - problem.posterior.curvature


def _tempered(posterior: Posterior) -> Posterior:
    """Return the posterior divided by the mean overdispersion, as the evidence is weighed."""
    overdispersion = posterior.error.usual_overdispersion
    return replace(
        posterior,
        gradient=posterior.gradient / overdispersion,
        curvature=posterior.curvature / overdispersion,
    )


def _without_unknown(probabilities: Mapping[str, float]) -> dict[str, float]:
    known = {name: p for name, p in probabilities.items() if name != UNKNOWN}
    total = sum(known.values())
    return {name: p / total for name, p in known.items()}


def _weights(before: Mapping[str, float], causes: Sequence[str]) -> dict[str, float]:
    total = sum(before[name] for name in causes)
    return {name: before[name] / total for name in causes}


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What the tests' outcomes are drawn from, the same for every test."""

    amplitudes: dict[str, FloatArray]
    """Cause → amplitudes of all candidates drawn from its posterior, shape (DRAWS, amplitudes)."""
    noise: FloatArray
    """Standard normal, shape (DRAWS, amplitudes)."""

    @classmethod
    def of(cls, now: Posterior, causes: Sequence[str], rng: np.random.Generator) -> Outcomes:
        """Draw amplitudes of each cause, its shapes and widths by their evidence."""
        size, drawn = now.gradient.size, {NONE: np.zeros((DRAWS, now.gradient.size))}
        of_all = evidence(now.hypotheses, now.gradient[None], now.curvature)
        for cause in causes:
            if cause == NONE:
                continue
            pieces = [
                (piece, width, place)
                for piece in of_all
                for place in piece.places(cause)
                for width in range(len(PRIOR_WIDTHS))
            ]
            logs = np.array([piece.log_bayes[width, place, 0] for piece, width, place in pieces])
            chosen = rng.choice(len(pieces), size=DRAWS, p=np.exp(logs - logsumexp(logs)))
            drawn[cause] = np.zeros((DRAWS, size))
            for row, k in enumerate(chosen):
                piece, width, place = pieces[k]
                drawn[cause][row, piece.at[place]] = piece.drawn(width, place, rng)
        return cls({cause: drawn[cause] for cause in causes}, rng.standard_normal((DRAWS, size)))


@dataclass(frozen=True, eq=False)
class CandidateEvidence:
    """Evidence for K candidates of k amplitudes each, for n gradients, at W widths of the prior."""

    effect_ids: tuple[str, ...]
    at: Indices
    """Their amplitudes, shape (K, k)."""
    bounds: FloatArray
    """Shape (K, k, 2)."""
    log_bayes: FloatArray
    """Against no effect, shape (W, K, n)."""
    mode: FloatArray
    """Shape (W, K, n, k)."""
    covariance: FloatArray
    """Shape (W, K, k, k)."""
    nats: FloatArray
    """Gain of log likelihood at the widest prior, amplitudes within bounds, shape (K, n)."""

    def places(self, effect_id: str) -> list[int]:
        """Return the candidates of an effect."""
        return [k for k, name in enumerate(self.effect_ids) if name == effect_id]

    def drawn(self, width: int, place: int, rng: np.random.Generator) -> FloatArray:
        """Draw amplitudes of a candidate from its posterior for the first gradient."""
        covariance = self.covariance[width, place]
        amplitude = rng.multivariate_normal(self.mode[width, place, 0], covariance)
        return np.asarray(np.clip(amplitude, *self.bounds[place].T))


def evidence(
    hypotheses: Hypotheses, gradients: FloatArray, curvature: FloatArray
) -> list[CandidateEvidence]:
    """Return the evidence for all candidates that can be a cause, for many gradients at once.

    Parameters
    ----------
    hypotheses : Hypotheses
    gradients : array of shape (n, amplitudes)
    curvature : array of shape (amplitudes, amplitudes)
    """
    causes = [k for k, each in enumerate(hypotheses.candidates) if each.effect.is_cause]
    by_size: dict[int, list[int]] = {}
    for k in causes:
        by_size.setdefault(len(hypotheses.candidates[k].amplitudes), []).append(k)
    widths = np.array(PRIOR_WIDTHS)[:, None, None, None]
    found = []
    for chosen in by_size.values():
        at = np.stack([hypotheses.amplitudes_of([k]) for k in chosen])
        bounds = np.stack([hypotheses.candidates[k].bounds for k in chosen])
        prior = np.stack([prior_precision(each) for each in bounds]) / widths**2
        own = curvature[at[:, :, None], at[:, None, :]]
        gradient = gradients[:, at].transpose(1, 0, 2)
        log_bayes, mode, covariance = bounded_evidence(gradient, own, prior, bounds)
        within = np.clip(mode[0], bounds[:, None, :, 0], bounds[:, None, :, 1])
        nats = np.sum((gradient - 0.5 * within @ own) * within, axis=-1)
        ids = tuple(hypotheses.candidates[k].effect.id for k in chosen)
        found.append(CandidateEvidence(ids, at, bounds, log_bayes, mode, covariance, nats))
    return found


def expected_of(
    profile: Profile, now: Posterior, added: FloatArray, simulated: Outcomes, judged: Evidence
) -> PlannedTest:
    """Return what is expected of a test that adds information to the curvature.

    Parameters
    ----------
    profile : Profile
    now : Posterior
        Divided by the mean overdispersion.
    added : array of shape (amplitudes, amplitudes)
    simulated : Outcomes
    judged : Evidence
        On the present logs.
    """
    added = added / now.error.usual_overdispersion
    values, vectors = np.linalg.eigh(0.5 * (added + added.T))
    noise = (simulated.noise * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    gradients = np.concatenate(
        [now.gradient + a @ added + noise for a in simulated.amplitudes.values()]
    )
    present = nats_by_effect(now, now.gradient[None], now.curvature)
    nats = nats_by_effect(now, gradients, now.curvature + added)
    gained = {name: nats[name] - present[name] for name in nats}
    outcomes = [_after(judged, gained, number) for number in range(len(gradients))]
    before = _without_unknown(posterior_of(judged))
    weights = _weights(before, [*simulated.amplitudes])
    information, expected = 0.0, {}
    for number, (cause, weight) in enumerate(weights.items()):
        drawn = outcomes[number * DRAWS : (number + 1) * DRAWS]
        of_cause = np.array([outcome[cause] for outcome in drawn])
        expected[cause] = float(np.mean(of_cause))
        information += weight * float(np.mean(np.log(of_cause / before[cause])))
    probability = sum(weight * expected[cause] for cause, weight in weights.items())
    return PlannedTest(profile, information, expected, float(probability))


def nats_by_effect(
    now: Posterior, gradients: FloatArray, curvature: FloatArray
) -> dict[str, FloatArray]:
    """Return what each effect explains at its best shape, as `EffectEvidence.nats`, shape (n,)."""
    best: dict[str, tuple[FloatArray, FloatArray]] = {}
    for each in evidence(now.hypotheses, gradients, curvature):
        log_bayes = logsumexp(each.log_bayes, axis=0)
        for name, of_shape, nats in zip(each.effect_ids, log_bayes, each.nats, strict=True):
            known, known_nats = best.get(name, (of_shape, nats))
            best[name] = (np.maximum(known, of_shape), np.where(of_shape > known, nats, known_nats))
    error = now.error
    return {
        name: nats * error.usual_overdispersion / error.overdispersion_of(name)
        for name, (_, nats) in best.items()
    }


def _after(judged: Evidence, gained: Mapping[str, FloatArray], number: int) -> dict[str, float]:
    """Return the probabilities after one simulated outcome."""
    effects = tuple(
        replace(each, nats=each.nats + float(gained[each.score.effect_id][number]))
        for each in judged.effects
    )
    return _without_unknown(posterior_of(replace(judged, effects=effects)))
