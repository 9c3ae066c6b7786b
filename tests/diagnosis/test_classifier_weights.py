"""The weights of the classifier make known causes probable (`benchmarks/classifier_weights.py`)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import classifier_weights as training
from cangauge.diagnosis import classifier
from cangauge.diagnosis.bayes_factors import Score
from cangauge.diagnosis.classifier import Comparison, EffectFeatures

TRUE = np.array([0.2, 1.0, 2.0, 0.5, 0.5, 0.4])
EFFECTS = 6


def case(rng: np.random.Generator, number: int) -> training.Case:
    """A random comparison whose cause is drawn with the true weights."""
    effects = tuple(
        EffectFeatures(
            Score(f"effect_{k}", evidence, (0,), np.zeros(1), np.eye(1), 0.0),
            evidence,
            3.0 * evidence,
            float(rng.uniform(0.2, 1.5)),
            float(rng.uniform(10.0, 1000.0)),
        )
        for k, evidence in enumerate(rng.uniform(-1.0, 60.0, EFFECTS).tolist())
    )
    comparison = Comparison(effects, 1.5, 0.5, 1000.0, 0.6)
    utility = classifier.effect_features(comparison) @ TRUE
    chances = np.exp(utility) / np.exp(utility).sum()
    truth = f"effect_{rng.choice(EFFECTS, p=chances)}"
    return training.Case("simulated", f"pack {number}", truth, comparison, has_overdispersion=True)


def test_training_recovers_the_true_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "RIDGE", 1e-6)  # many cases need no regularisation
    rng = np.random.default_rng(3)
    cases = [case(rng, number) for number in range(3000)]
    found = training.fit_effect_weights(cases)
    assert found[2] == pytest.approx(TRUE[2], abs=0.3)
    assert found[3] == pytest.approx(TRUE[3], abs=0.2)
    # All effects have the same overdispersion here, so both leads are equal.
    assert found[4:].sum() == pytest.approx(TRUE[4:].sum(), abs=0.2)
    # Evidence and its lead without overdispersion are nearly redundant.
    assert found[:2].sum() == pytest.approx(TRUE[:2].sum(), abs=0.4)


def test_a_case_without_its_cause_has_another() -> None:
    rng = np.random.default_rng(4)
    known = case(rng, 0)
    unknown = known.without_cause()
    assert known.has_cause
    assert not unknown.has_cause
    names, _, _ = training.ranked(unknown, TRUE)
    assert training.class_of(unknown, names) == training.ANOTHER


def test_final_seeds_are_not_used_for_training(tmp_path: Path) -> None:
    (tmp_path / "tasks.json").write_text(json.dumps({"final": True}), encoding="utf-8")
    with pytest.raises(SystemExit, match="final seeds"):
        training.read_cases(tmp_path)
