"""A diagnosis as the object that `cangauge gap --json` prints (schema 4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from cangauge._files import file_sha256, text_sha256
from cangauge.diagnosis.evidence import Evidence
from cangauge.diagnosis.posterior import Posterior
from cangauge.diagnosis.text import FAULT
from cangauge.diagnosis.where import closed_part
from cangauge.logs.log import Log

if TYPE_CHECKING:
    from cangauge.diagnosis.diagnose import Diagnosis


def as_json(found: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis as numbers, texts, lists and dicts."""
    closed, ci = found.closed
    before_pct, after_pct = found.soc_errors_pct or (None, None)
    answer, check = found.posterior, found.model_check
    return {
        "schema": 4,
        "model": {
            "describes_references": check and check.describes,
            "references_rmse_v": check and check.references_rmse_v,
            "among_themselves_rmse_v": check and check.among_themselves_rmse_v,
            "faults": [
                _effect(each.evidence, each.posterior)
                | {
                    "rmse_v": each.rmse_v,
                    "closed_fraction": None,
                    "visible_from": {"size": None, "unit": each.evidence.shape.unit},
                }
                for each in (check.missed if check else ())
            ],
        },
        "gap": {
            "baseline_rmse_v": found.baseline_rmse_v,
            "extended_rmse_v": found.extended_rmse_v,
            "healthy_rmse_v": found.healthy_rmse_v,
            "closed_fraction": closed,
            "closed_fraction_ci": ci and list(ci),
            "on": "left-out log" if len(found.logs) > 1 else "left-out rows",
            "baseline_soc_mae_pct": before_pct,
            "extended_soc_mae_pct": after_pct,
        },
        "where": found.where,
        "answer": {
            "level": answer.level,
            "probability_none": answer.none,
            "probability_unknown": answer.unknown,
            "stated": list(answer.stated),
            "text": found.summary,
            "check_first": found.check_first,
        },
        "faults": [_fault(found, fault) for fault in answer.faults],
        "next_step": _step(found),
        "correction": {
            "accepted": found.is_written,
            "why_not": found.why_not,
            "path": found.correction_path if found.is_written else None,
        },
        "caveats": found.caveats,
        "inputs": {
            "model": {"name": found.model.name, "sha256": text_sha256(found.model.to_json())},
            "logs": _files(found.logs),
            "references": _files(found.references),
        },
    }


def _fault(found: Diagnosis, fault: str) -> dict[str, Any]:
    best, correction = found.best_of(fault), found.corrections[fault]
    size, unit = found.visible_from(best.shape.effect.id)
    return _effect(best, found.posterior) | {
        "title": FAULT[fault]["title"],
        "rmse_v": correction.rmse_v,
        "closed_fraction": closed_part(correction.errors, found.healthy.healthy_v2)[0],
        "visible_from": {"size": size, "unit": unit},
    }


def _effect(evidence: Evidence, posterior: Posterior) -> dict[str, Any]:
    effect, fault = evidence.shape.effect.id, evidence.fault
    return {
        "fault": fault,
        "probability": posterior.faults[fault],
        "effect": effect,
        "effect_probability": posterior.probabilities[effect],
        "parameters": {name: dict(vars(item)) for name, item in evidence.parameters.items()},
    }


def _step(found: Diagnosis) -> dict[str, Any] | None:
    if found.next_step is None:
        return None
    fault, before, after = found.next_step
    return {
        "measurement": FAULT[fault]["measurement"],
        "between": [*found.posterior.stated, None][:2],
        "probability_now": before,
        "probability_after": after,
    }


def _files(logs: Sequence[Log]) -> list[dict[str, Any]]:
    return [{"name": log.name, "sha256": file_sha256(log.source)} for log in logs]
