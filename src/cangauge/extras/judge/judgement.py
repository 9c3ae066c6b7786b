"""The judgement on a gauge: how far off now and before, why, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.special import expit, ndtr
from threadpoolctl import threadpool_limits

from cangauge._text import number
from cangauge._typing import FloatArray
from cangauge.diagnosis.checks import check_given_once
from cangauge.errors import InputError
from cangauge.extras.judge.chain import SHORTEST_S, Chain, Stretch
from cangauge.extras.judge.faults import BEYOND, P_FAULT, Fitted, Priors, Term, explain
from cangauge.extras.judge.gauge import JUMP_PCT, is_limit, published_pct
from cangauge.extras.judge.result import (
    OFF_PCT,
    SURE,
    FoundFault,
    Judgement,
    Moment,
    Piece,
    Verdict,
    is_dated,
)
from cangauge.extras.judge.weak import CURVE_PCT, WeakestCell, weak_cell
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log, as_log
from cangauge.logs.read import CellColumns
from cangauge.model.model_file import PRIOR_MADE_BY, FunctionFields, Model, as_model
from cangauge.model.prior import ChemistryName

OFF_FROM: Final = 0.95
"""A gauge is off where its error at the end is above `OFF_PCT` with this probability, …"""
AGREES_PCT: Final = 5.0
AGREES_FROM: Final = 0.9
"""… and agrees where it is below `AGREES_PCT` [%] with this one."""
NAMED: Final = 0.9
"""A fault is named from this probability, …"""
MATERIAL_PCT: Final = 2.0
"""… where it moves the published SoC by this somewhere: less is the gauge's resolution."""
CONTRADICTION: Final = 2.0
"""Where charge and published SoC differ by this factor, one of the two is no such signal."""
LEAST_MOVED_PCT: Final = 3.0
"""Least movement of both from which that can be seen [%]."""
FITTED: Final = (1.5, 0.75, 0.25)
"""Standard deviations of a fitted model's capacity [%], of the gauge's zero beside it [%], half of
that of a full charge, since both call much the same full, and of the voltage sensor, its class
[%]."""
TYPICAL: Final = (3.0, 5.0, 5.0)
"""The same of a typical cell with a stated capacity. A car shows the usable part of its cells,
which leaves up to a tenth of the charge at either end; cells of one chemistry differ by 5 %."""
LFP_ZERO_PCT: Final = 0.5
"""Zero of a gauge of LFP cells, which is set to 100 % at the end of a charge [%]."""
COUNTED_STD_PCT: Final = 10.0
"""Standard deviation of a capacity that only the gauge's own count states [%]."""
MISFIT_V: Final = 0.1
"""Without a model: mean error of the voltage at the best start that no cell of the chemistry has
[V per cell]."""


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
    if is_dated(judged):
        judged = tuple(sorted(judged, key=lambda log: float(log.time_s[0])))
    check_given_once(judged, cure="give each log once")
    if not any(np.isfinite(published_pct(log)).sum() > 1 for log in judged):
        raise InputError(
            "no log has the SoC that the gauge publishes",
            field="soc_pct",
            cure="name its column, such as --columns soc=HEADING",
        )
    if model is not None:
        pack, stds = as_model(model), FITTED
        if capacity_ah is not None:
            pack = pack.model_copy(update={"capacity_ah": capacity_ah})
    elif chemistry is not None and cells is not None:
        stds = TYPICAL if chemistry == "oxide" else (TYPICAL[0], LFP_ZERO_PCT, TYPICAL[2])
        stds = stds if capacity_ah is not None else (COUNTED_STD_PCT, *stds[1:])
        pack = Model.prior(chemistry, cells, capacity_ah or _capacity_ah(judged))
    else:
        raise InputError(
            "neither a model nor chemistry and cells",
            field="--model",
            cure="give -m MODEL, or --chemistry oxide|lfp and --cells N",
        )
    with threadpool_limits(1):  # small matrices
        chain = Chain.of(judged, pack)
        if not any(np.isfinite(part.published.shown_pct).any() for part in chain.stretches):
            raise InputError(
                "no stretch of samples is long enough",
                cure=f"give logs of at least {SHORTEST_S / 60.0:.0f} minutes, better half an hour"
                " with changing load",
            )
        if pack.made.by == PRIOR_MADE_BY:
            _check_cells(chain, pack)
        fits = explain(chain, Priors(pack.capacity_ah, *stds))
    weakest = _weakest(judged, cell_voltages, pack, chain, fits)
    return _judgement(judged, pack, chain, fits, weakest)


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
    fits: Sequence[Fitted],
) -> WeakestCell | None:
    """Return the weakest cell where it is one more probably than not."""
    volts, socs, amps, first, cells = [], [], [], 1, 1
    for part, soc_pct in zip(chain.stretches, fits[0].pack_pct, strict=True):
        beside = cell_voltages[part.log] if part.log < len(cell_voltages) else None
        if beside is None:
            continue
        rows = np.searchsorted(logs[part.log].time_s, part.time_s)
        first, cells = beside.first, beside.count
        volts.append(beside.voltage_v[rows])
        socs.append(soc_pct)
        amps.append(logs[part.log].current_a[rows])
    if not volts:
        return None
    curve_v = model.voltage_model().pseudo_ocv(CURVE_PCT) / cells
    weakest = weak_cell(volts, socs, amps, curve_v, first)
    return weakest if weakest is not None and _p_weak(weakest) >= NAMED else None


def _p_weak(weakest: WeakestCell) -> float:
    return float(expit(weakest.log_factor + np.log(P_FAULT / (1.0 - P_FAULT))))


class _Residual(NamedTuple):
    """Published minus corrected SoC and its σ at the rows of a stretch [%]."""

    soc_pct: FloatArray
    std_pct: FloatArray


def _corrected(
    chain: Chain, fits: Sequence[Fitted], weakest: WeakestCell | None
) -> list[_Residual]:
    """Return the SoC that all sets of faults together imply, at the rows of each stretch.

    A pack is as empty as its weakest cell.
    """
    share = np.array([fit.share for fit in fits])
    found = []
    for k, part in enumerate(chain.stretches):
        soc = np.array([fit.soc_pct[k] for fit in fits])
        mean = share @ soc
        variance = share @ (np.array([fit.std_pct[k] for fit in fits]) ** 2 + (soc - mean) ** 2)
        std = np.interp(part.row_hours, part.hours, np.sqrt(variance))
        counted = np.interp(part.row_hours, part.hours, mean + part.drawn_pct)
        row = counted - part.row_drawn_pct
        if weakest is not None:
            std = np.hypot(std, weakest.std_pct * (100.0 - row) / 100.0)
            row = row - weakest.behind_pct(row)
        found.append(_Residual(row, std))
    return found


def _judgement(
    logs: tuple[Log, ...],
    model: Model,
    chain: Chain,
    fits: list[Fitted],
    weakest: WeakestCell | None,
) -> Judgement:
    """Return what all sets of faults say together, each by its probability.

    The SoC is that of the sets in which the gauge's present level is free: it does not confirm
    itself.
    """
    published = [published_pct(log) for log in logs]
    corrected = [np.full(len(log), np.nan) for log in logs]
    std = [np.full(len(log), np.nan) for log in logs]
    free = [fit for fit in fits if fit.is_free] or fits
    total = sum(fit.share for fit in free)
    free = [replace(fit, share=fit.share / total) for fit in free]
    of_stretches = _corrected(chain, free, weakest)
    for part, found in zip(chain.stretches, of_stretches, strict=True):
        corrected[part.log][part.rows] = found.soc_pct
        std[part.log][part.rows] = found.std_pct
    last = max(
        k for k, part in enumerate(chain.stretches) if np.isfinite(part.published.shown_pct).any()
    )
    shown = chain.stretches[last].published.shown_pct
    row = int(np.flatnonzero(np.isfinite(shown))[-1])
    error = float(shown[row] - of_stretches[last].soc_pct[row])
    error_std = float(of_stretches[last].std_pct[row])
    within_off, within_agrees = (
        _within(chain, free, (last, row), error, limit) for limit in (OFF_PCT, AGREES_PCT)
    )
    pieces = _pieces(chain, fits, of_stretches)
    faults = _faults(chain, fits, pieces)
    if weakest is not None:
        size, half = weakest.lack_pct, SURE * weakest.std_pct
        interval = (size - half, size + half)
        faults.append(FoundFault("weak_cell", _p_weak(weakest), size, interval, "%", None))
    ratio = _contradiction(chain)
    verdict: Verdict = "cannot_tell"
    if ratio is None:
        if (pieces and pieces[-1].stands_at_pct is not None) or 1.0 - within_off >= OFF_FROM:
            verdict = "off"
        elif within_agrees >= AGREES_FROM and not _may_stand(chain.stretches[: last + 1]):
            verdict = "agrees"
    else:
        faults = []
    return Judgement(
        logs,
        model,
        chain,
        fits,
        published,
        corrected,
        std,
        verdict,
        error,
        error_std,
        pieces,
        sorted(faults, key=lambda fault: -fault.probability),
        ratio,
        weakest,
    )


def _may_stand(parts: Sequence[Stretch]) -> bool:
    """Return whether the gauge has not moved at the end where a dashboard would have shown it."""
    held_pct, end_pct = 0.0, np.nan
    for part in reversed(parts):
        shown = part.published.shown_pct[np.isfinite(part.published.shown_pct)]
        if not shown.size or (held_pct and shown[-1] != end_pct):
            break
        held_pct, end_pct = held_pct + part.published.held_pct, shown[-1]
        if np.ptp(shown) > 0.0:
            break
    return held_pct >= JUMP_PCT + 2.0 * parts[-1].published.step_pct


def _within(
    chain: Chain, fits: Sequence[Fitted], at: tuple[int, int], error_pct: float, limit_pct: float
) -> float:
    """Return the probability that the error at a row of a stretch is within a limit.

    `error_pct` is the mean over all sets of faults.
    """
    k, row = at
    part = chain.stretches[k]
    hours, share = part.row_hours[row], np.array([fit.share for fit in fits])
    counted = [np.interp(hours, part.hours, fit.soc_pct[k] + part.drawn_pct) for fit in fits]
    stds = [np.interp(hours, part.hours, fit.std_pct[k]) for fit in fits]
    errors = error_pct - (np.array(counted) - share @ counted)
    ends = np.array([[-limit_pct], [limit_pct]])
    return float(share @ np.diff(ndtr((ends - errors) / stds), axis=0)[0])


def _pieces(chain: Chain, fits: Sequence[Fitted], corrected: Sequence[_Residual]) -> list[Piece]:
    """Return what the gauge did between its jumps, and where it stood still."""
    levels = [fault for fault in fits[0].faults if fault.name == "start_or_reset"]
    resets = {
        k
        for fault in levels
        for k in (fault.since, max(fault.blocks) + 1)
        if 0 < k < len(chain.stretches)
        and all(fault.piece in chain.stretches[j].piece for j in (k - 1, k))
    }  # in a pause
    runs: list[tuple[object, int, int, int, int, float]] = []
    for k, part in enumerate(chain.stretches):
        shown = part.published.shown_pct
        label = part.published.piece.astype(np.float64)
        known = np.flatnonzero(label >= 0)
        held = np.zeros(len(label))
        if known.size:
            label = label[
                known[np.maximum(np.searchsorted(known, np.arange(len(label)), "right") - 1, 0)]
            ]
        for number_of, stand in enumerate(part.published.stands):
            label[stand.first : stand.last + 1] = -2.0 - number_of
            held[stand.first : stand.last + 1] = stand.moved_pct
        rows = np.flatnonzero(np.isfinite(shown))
        if not rows.size:
            continue
        edges = np.flatnonzero(np.diff(label[rows], prepend=np.nan) != 0.0)
        for first, last in zip(edges, [*edges[1:], rows.size], strict=True):
            low, high = int(rows[first]), int(rows[last - 1])
            moved = float(held[low])
            key: object = ("stands", float(shown[low])) if moved else float(label[low])
            is_new = k in resets and first == 0 and not moved
            if runs and runs[-1][0] == key and not is_new:
                of, k0, low0, _, _, before = runs[-1]
                runs[-1] = (of, k0, low0, k, high, max(before, moved))
            else:
                runs.append((key, k, low, k, high, moved))
    found = []
    for key, k0, low, k1, high, moved in runs:
        part0, part1 = chain.stretches[k0], chain.stretches[k1]
        error = float(part1.published.shown_pct[high] - corrected[k1].soc_pct[high])
        found.append(
            Piece(
                Moment(part0.log, float(part0.row_time_s[low])),
                Moment(part1.log, float(part1.row_time_s[high])),
                error,
                float(corrected[k1].std_pct[high]),
                key[1] if isinstance(key, tuple) else None,
                moved,
            )
        )
    return found


def _faults(chain: Chain, fits: Sequence[Fitted], pieces: Sequence[Piece]) -> list[FoundFault]:
    """Return the faults that are probable, of a possible size, and matter."""
    by_place = dict[tuple[str, int, int], list[tuple[float, Term, float, float]]]()
    for fit in fits:
        for term, size, std in zip(fit.faults, fit.size, fit.std, strict=True):
            place = (term.name, *term.place[1:])
            by_place.setdefault(place, []).append((fit.share, term, float(size), float(std)))
    found = []
    for (name, *_), shapes in by_place.items():
        share = np.array([shape[0] for shape in shapes])
        sizes, stds = (np.array([shape[j] for shape in shapes]) for j in (2, 3))
        probability = float(share.sum())
        within = share / probability
        size = float(within @ sizes)
        std = float(np.sqrt(within @ (stds**2 + (sizes - size) ** 2)))
        term = shapes[int(np.argmax(share))][1]
        is_possible = abs(size) <= BEYOND * term.std * term.per_unit
        if probability < NAMED or not is_possible or _moves_pct(term, size) < MATERIAL_PCT:
            continue
        since = None
        if term.piece > 0 or term.since > 0:
            part = chain.stretches[term.since]
            at = np.flatnonzero(part.published.piece == term.piece)
            since = Moment(part.log, float(part.row_time_s[int(at[0]) if at.size else 0]))
        interval = (size - SURE * std, size + SURE * std)
        found.append(FoundFault(name, min(probability, 1.0), size, interval, term.unit, since))
    # At a limit a gauge may count on unseen, unless it never leaves it.
    stands = [
        piece
        for piece in pieces
        if piece.stands_at_pct is not None
        and (piece is pieces[-1] or not is_limit(np.array(piece.stands_at_pct)))
    ]
    if stands:
        longest = max(stands, key=lambda piece: piece.moved_pct)
        moved = longest.moved_pct
        found.append(FoundFault("stands_still", 1.0, moved, (moved, moved), "%", longest.begin))
    return found


def _moves_pct(term: Term, size: float) -> float:
    """Return the most by which a fault moves published against true SoC [%]."""
    if term.name in {"voltage_sensor", "model_capacity"}:  # of the log and of the model
        return np.inf
    most = max(
        float(np.max(np.abs(np.asarray(block.shown) - np.asarray(block.soc))))
        for block in term.blocks.values()
    )
    return abs(size) / term.per_unit * most


def _contradiction(chain: Chain) -> float | None:
    """Return charge over what the published SoC moves by, where no gauge is so wrong; else None.

    The charge is too large for the SoC by the median over all movements of it, so that a gauge that
    stands still is none, and too small by the regression, so that one that jumps is none.
    """
    ratios, products, squares, moved = list[float](), 0.0, 0.0, 0.0
    for part in chain.stretches:
        known = np.isfinite(part.published.shown_pct)
        shown, charge = part.published.shown_pct[known], -part.row_drawn_pct[known]
        if not known.any():
            continue
        step = np.floor((shown - shown[0]) / LEAST_MOVED_PCT)
        ends = np.flatnonzero(np.diff(step, append=np.nan) != 0.0)
        moves = np.diff(shown[ends])
        is_far = np.abs(moves) >= 0.5 * LEAST_MOVED_PCT
        ratios += (np.diff(charge[ends])[is_far] / moves[is_far]).tolist()
        products += float(np.sum((shown - shown.mean()) * (charge - charge.mean())))
        squares += float(np.sum((charge - charge.mean()) ** 2))
        moved = max(moved, float(np.ptp(charge)))
    if len(ratios) >= 3 and abs(np.median(ratios)) > CONTRADICTION:
        return float(np.median(ratios))
    if moved >= LEAST_MOVED_PCT and products > CONTRADICTION * squares:
        return squares / products
    return None


def narrowed(judgement: Judgement) -> Model:
    """Return the model with its curve and loads learned from the logs, and their σ."""
    best, model, fields = judgement.fits[0], judgement.model, judgement.model.functions
    curve, loads = np.array(fields.curve_v).T, np.array(fields.load).T
    root = np.linalg.cholesky(best.covariance + 1e-12 * np.eye(len(best.functions)))
    functions = FunctionFields(
        soc_pct=fields.soc_pct, curve_v=(curve @ root).T.tolist(), load=(loads @ root).T.tolist()
    )
    update: dict[str, Any] = {"functions": functions, "name": f"{model.name}, narrowed"}
    before = model.loads
    if model.curve is not None and before is not None and before.arrhenius is not None:
        at_pct = model.curve.soc_pct
        volts = np.array(model.curve.voltage_v)
        volts += np.interp(at_pct, fields.soc_pct, curve @ best.functions)
        rising = np.maximum.accumulate(volts).tolist()
        update["curve"] = model.curve.model_copy(update={"voltage_v": tuple(rising)})
        change = loads @ best.functions
        last = 1 + len(before.resistance_ohm)  # kt and the resistances, then b
        factor = before.arrhenius.factor + float(change[last])
        changed = {
            "kt_v_per_k": before.kt_v_per_k + float(change[0]),
            "resistance_ohm": tuple((np.array(before.resistance_ohm) + change[1:last]).tolist()),
            "arrhenius": replace(before.arrhenius, factor=factor),
        }
        update["loads"] = before.model_copy(update=changed)
    return model.model_copy(update=update)
