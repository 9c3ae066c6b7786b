"""The judgement on a gauge: how far off, since when, why, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from scipy.special import ndtr
from threadpoolctl import threadpool_limits

from cangauge._text import number
from cangauge.diagnosis.checks import check_given_once
from cangauge.errors import InputError
from cangauge.extras.judge.causes import (
    NAMES,
    PRIOR_NONE,
    RIGHT,
    WINDOW_PCT,
    Explanation,
    Priors,
    explain,
    mixture,
)
from cangauge.extras.judge.chain import SHORTEST_S, Chain, published_pct
from cangauge.extras.judge.result import (
    EPOCH_S,
    UNITS,
    USEFUL_PCT,
    Cause,
    Judgement,
    Size,
    Verdict,
    standing,
)
from cangauge.extras.judge.weak import WeakestCell, weak_cell
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log, as_log
from cangauge.logs.read import CellColumns
from cangauge.model.model_file import PRIOR_MADE_BY, FunctionFields, Model, as_model
from cangauge.model.prior import ChemistryName

__all__ = ["Judgement", "judge", "narrowed"]

ALARM: Final = 0.05
"""The gauge is off where the probability that it is right (one of `RIGHT`), or that no log ends
with an error above `USEFUL_PCT`, is at most this, as in `gap`."""
NAMED: Final = 0.6
"""A cause is named from this probability among all answers but `none`, as in `gap`; that the gauge
is right and the model's capacity is not, from all but `ALARM` on."""
FITTED_STD_PCT: Final = 1.5
"""Standard deviation of the capacity of a model that was fitted [%], …"""
STATED_STD_PCT: Final = 3.0
"""… of one that is stated without a model [%], …"""
COUNTED_STD_PCT: Final = 10.0
"""… and of one that only the gauge's own count states [%]."""
LIKELY: Final = 0.5
"""A gauge agrees where the probability that no log ends with an error above `USEFUL_PCT` is at
least this."""
MISFIT_V: Final = 0.1
"""Without a model: mean error of the voltage at the best start that no cell of the chemistry has
[V per cell]."""
SURE: Final = 1.96
"""Half width of an interval of 95 % in standard deviations."""


def judge(
    logs: Sequence[Log | Any],
    model: Model | Any = None,
    *,
    chemistry: ChemistryName | None = None,
    cells: int | None = None,
    capacity_ah: float | None = None,
    cell_voltages: Sequence[CellColumns | None] = (),
) -> Judgement:
    """Judge the SoC that a gauge publishes, by logs that carry it.

    Parameters
    ----------
    logs : sequence of Log, path or DataFrame
        In order of time, with the published SoC as `soc_pct`.
    model : Model, path or result of `fit`, optional
        Of the pack.
    chemistry : {"oxide", "lfp"}, optional
    cells : int, optional
        Without a model: chemistry and number of cells in series.
    capacity_ah : float, optional
        Charge from 100 to 0 % that the gauge should count with [Ah]; by default the model's, else
        from the gauge's own count.
    cell_voltages : sequence of CellColumns, optional
        Beside each log; None where it has none.

    Returns
    -------
    Judgement

    Raises
    ------
    InputError
        If no log has a published SoC, a log is given twice, neither model nor chemistry and cells
        are given, or the voltage is not that of such cells.
    """
    judged = tuple(as_log(log) for log in logs)
    if all(log.time_s[0] >= EPOCH_S for log in judged):
        judged = tuple(sorted(judged, key=lambda log: float(log.time_s[0])))
    check_given_once(judged, cure="give each log once")
    if not any(np.isfinite(published_pct(log)).sum() > 1 for log in judged):
        raise InputError(
            "no log has the SoC that the gauge publishes",
            field="soc_pct",
            cure="name its column, such as --columns soc=HEADING",
        )
    if model is not None:
        pack, std_pct = as_model(model), FITTED_STD_PCT
        if capacity_ah is not None:
            pack = pack.model_copy(update={"capacity_ah": capacity_ah})
    elif chemistry is not None and cells is not None:
        std_pct = COUNTED_STD_PCT if capacity_ah is None else STATED_STD_PCT
        pack = Model.prior(chemistry, cells, capacity_ah or _capacity_ah(judged))
    else:
        raise InputError(
            "neither a model nor chemistry and cells",
            field="--model",
            cure="give -m MODEL, or --chemistry oxide|lfp and --cells N",
        )
    with threadpool_limits(1):  # small matrices
        chain = Chain.of(judged, pack)
        if not any(np.isfinite(part.published_pct).any() for part in chain.stretches):
            raise InputError(
                "no stretch of samples is long enough",
                cure=f"give logs of at least {SHORTEST_S / 60.0:.0f} minutes, better half an hour"
                " with changing load",
            )
        if pack.made.by == PRIOR_MADE_BY:
            _check_cells(chain, pack)
        typical = pack.made.by == PRIOR_MADE_BY and pack.chemistry == "oxide"
        zero_std_pct = WINDOW_PCT if typical else Priors.zero_std_pct
        answers = explain(chain, Priors(pack.capacity_ah, std_pct, zero_std_pct))
        weakest = _weakest(judged, cell_voltages, pack, chain, answers)
    if weakest is not None:
        answers.append(_of_weak_cell(answers[0], weakest))
    return _judgement(judged, pack, chain, answers, weakest, zero_std_pct=zero_std_pct)


def _capacity_ah(logs: Sequence[Log]) -> float:
    """Return the charge per 100 % of the gauge's own count [Ah]."""
    covariance = variance = 0.0
    for log in logs:
        known = np.isfinite(published_pct(log))
        if known.any():
            drawn_ah = discharged_ah(log.time_s, log.current_a)[known]
            soc = published_pct(log)[known]
            covariance -= float(np.sum((soc - soc.mean()) * (drawn_ah - drawn_ah.mean())))
            variance += float(np.sum((soc - soc.mean()) ** 2))
    if covariance <= 0.0:
        raise InputError(
            "the capacity does not follow from the logs: the published SoC hardly changes",
            field="--capacity-ah",
            cure="give the pack's capacity",
        )
    return 100.0 * covariance / variance


def _check_cells(chain: Chain, typical: Model) -> None:
    """Raise InputError if the voltage is not that of typical cells at any SoC."""
    cells = typical.cells or 1
    misfit_v = float(np.median([part.misfit_v for part in chain.stretches])) / cells
    if abs(misfit_v) > MISFIT_V:
        raise InputError(
            f"at no SoC is the voltage that of {cells} {typical.chemistry} cells: the best start"
            f" leaves {number(misfit_v, 2, 'V')} per cell",
            field="--chemistry/--cells",
            cure="check --chemistry and --cells, or fit a model of the pack",
        )


def _weakest(
    logs: Sequence[Log],
    cell_voltages: Sequence[CellColumns | None],
    model: Model,
    chain: Chain,
    answers: Sequence[Explanation],
) -> WeakestCell | None:
    """Return the weakest cell by the SoC of the likeliest answer."""
    best = max(answers, key=lambda answer: answer.log_evidence)
    volts, socs, slopes, amps, first = [], [], [], [], 1
    for part, track in zip(chain.stretches, best.tracks, strict=True):
        cells = cell_voltages[part.log] if part.log < len(cell_voltages) else None
        if cells is None:
            continue
        rows = np.searchsorted(logs[part.log].time_s, part.time_s)
        first = cells.first
        volts.append(cells.voltage_v[rows])
        socs.append(track.soc_pct)
        slopes.append(model.voltage_model().pseudo_ocv_slope(track.soc_pct) / cells.count)
        amps.append(logs[part.log].current_a[rows])
    return weak_cell(volts, socs, slopes, amps, first) if volts else None


def _of_weak_cell(none: Explanation, weak: WeakestCell) -> Explanation:
    """Return the answer "weak cell": the pack's signals are as without a fault."""
    prior = np.log((1.0 - PRIOR_NONE) / (len(NAMES) - 1) / PRIOR_NONE)
    return replace(
        none,
        name="weak_cell",
        log_evidence=none.log_evidence + weak.log_factor + float(prior),
        size=np.array([weak.size_pct]),
        std=np.array([weak.std_pct]),
    )


def _judgement(
    logs: tuple[Log, ...],
    model: Model,
    chain: Chain,
    answers: Sequence[Explanation],
    weakest: WeakestCell | None,
    *,
    zero_std_pct: float,
) -> Judgement:
    """Return what all answers together say, each by its probability.

    `zero_std_pct` is that of the gauge's own zero, which a right gauge may have [% SoC]. The stated
    σ contain it: they are of the SoC on the gauge's scale.
    """
    stretches = chain.stretches
    scores = np.array([answer.log_evidence for answer in answers])
    share = np.exp(scores - scores.max())
    share /= share.sum()
    probabilities = {answer.name: float(p) for answer, p in zip(answers, share, strict=True)}
    corrected = [np.full(len(log), np.nan) for log in logs]
    std = [np.full(len(log), np.nan) for log in logs]
    errors, known_stds, stds, useful = [], [], [], 1.0
    for k, part in enumerate(stretches):
        track = mixture([answer.tracks[k] for answer in answers], share)
        in_its_scale = np.hypot(track.std_pct, zero_std_pct)
        time_s = logs[part.log].time_s
        first, last = np.searchsorted(time_s, part.time_s[[0, -1]] + np.array([-60.0, 60.0]))
        at = time_s[first:last]
        soc_pct = np.interp(at, part.time_s, track.soc_pct)
        corrected[part.log][first:last] = np.clip(soc_pct, 0.0, 100.0)
        std[part.log][first:last] = np.interp(at, part.time_s, in_its_scale)
        error = part.shown_pct - np.clip(track.soc_pct, 0.0, 100.0)
        if part.end is not None:
            deviation = float(in_its_scale[part.end])
            useful = min(useful, _within_useful(float(error[part.end]), deviation))
        errors.append(error)
        known_stds.append(track.std_pct)
        stds.append(in_its_scale)
    error, known_std, std_at = map(np.concatenate, (errors, known_stds, stds))
    end = int(np.flatnonzero(np.isfinite(error))[-1])
    worst = int(np.nanargmax(np.abs(error) / std_at))
    right = sum(probabilities[name] for name in RIGHT)
    if useful <= ALARM < right:  # no answer explains the error
        probabilities["unknown"] += right - useful
        probabilities |= {name: probabilities[name] * useful / right for name in RIGHT}
        right = useful
    is_known = 2.0 * known_std[end] <= USEFUL_PCT and useful >= LIKELY
    verdict: Verdict = "agrees" if is_known else "cannot_tell"
    cause = Cause("none", probabilities["none"])
    if probabilities["none"] <= ALARM:
        cause = Cause("unknown", probabilities["unknown"])
        if standing(stretches) is None:  # no cause is a gauge that stands still
            cause = _cause(answers, probabilities)
        if right <= ALARM:
            verdict = "off"
        elif cause.verdict not in RIGHT:
            verdict = "cannot_tell"
            if cause.verdict == "count_scale":  # the gauge is wrong, or the model
                cause = Cause("unknown", probabilities["unknown"])
    return Judgement(
        logs,
        model,
        float(error[end]),
        float(std_at[end]),
        float(error[worst]),
        verdict,
        cause,
        probabilities,
        corrected,
        std,
        stretches,
        sorted(answers, key=lambda answer: -probabilities[answer.name]),
        weakest,
    )


def _within_useful(error_pct: float, std_pct: float) -> float:
    """Return the probability that an error is at most `USEFUL_PCT`, by its estimate and σ [%]."""
    return float(np.diff(ndtr((np.array([-USEFUL_PCT, USEFUL_PCT]) - error_pct) / std_pct))[0])


def _cause(answers: Sequence[Explanation], probabilities: dict[str, float]) -> Cause:
    """Return the most probable cause, or that it is unknown, if none stands out."""
    best = max(
        (answer for answer in answers if answer.name in UNITS),
        key=lambda answer: probabilities[answer.name],
    )
    probability = probabilities[best.name]
    named = 1.0 - ALARM if best.name in RIGHT else NAMED
    if probability < named * (1.0 - probabilities["none"]):
        return Cause("unknown", probabilities["unknown"])
    size = float(best.share @ best.size)
    spread = float(best.share @ (best.std**2 + (best.size - size) ** 2)) ** 0.5
    onset = np.zeros(1 + max(signature.onset for signature in best.signatures))
    for signature, share in zip(best.signatures, best.share, strict=True):
        onset[signature.onset] += share
    earliest, latest = np.searchsorted(np.cumsum(onset), [0.05, 0.95])
    likeliest = best.signatures[best.best]
    return Cause(
        best.name,
        probability,
        Size(size, (size - SURE * spread, size + SURE * spread), UNITS[best.name]),
        likeliest.onset,
        int(earliest),
        int(latest),
        likeliest.inside,
    )


def narrowed(judgement: Judgement) -> Model:
    """Return the model with its curve and loads learned from the logs, and their σ."""
    best, model, fields = judgement.explanations[0], judgement.model, judgement.model.functions
    curve, loads = np.array(fields.curve_v).T, np.array(fields.load).T
    root = np.linalg.cholesky(best.covariance + 1e-12 * np.eye(len(best.functions)))
    functions = FunctionFields(
        soc_pct=fields.soc_pct, curve_v=(curve @ root).T.tolist(), load=(loads @ root).T.tolist()
    )
    update: dict[str, Any] = {"functions": functions, "name": f"{model.name}, narrowed"}
    if model.curve is not None and model.loads is not None:
        at_pct, before = model.curve.soc_pct, model.loads
        volts = np.array(model.curve.voltage_v)
        volts += np.interp(at_pct, fields.soc_pct, curve @ best.functions)
        rising = np.maximum.accumulate(volts).tolist()
        update["curve"] = model.curve.model_copy(update={"voltage_v": rising})
        change = loads @ best.functions
        last = 1 + len(before.resistance_ohm)  # kt and the resistances, then b
        factor = before.arrhenius.factor + float(change[last])
        changed = {
            "kt_v_per_k": before.kt_v_per_k + float(change[0]),
            "resistance_ohm": (np.array(before.resistance_ohm) + change[1:last]).tolist(),
            "arrhenius": replace(before.arrhenius, factor=factor),
        }
        update["loads"] = before.model_copy(update=changed)
    return model.model_copy(update=update)
