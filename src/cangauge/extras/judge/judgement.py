"""The judgement on a gauge: how far off now and before, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from scipy.special import ndtr
from threadpoolctl import threadpool_limits

from cangauge._text import number, rounded
from cangauge._typing import FloatArray
from cangauge.diagnosis.checks import check_given_once
from cangauge.errors import InputError
from cangauge.extras.judge.chain import Chain
from cangauge.extras.judge.explain import BEYOND, Fitted, explain
from cangauge.extras.judge.faults import FAULTS, Column, Priors
from cangauge.extras.judge.gauge import JUMP_PCT, is_limit, published_pct
from cangauge.extras.judge.result import FoundFault, Judgement, Moment, Piece, Verdict, is_dated
from cangauge.extras.judge.text import OFF_PCT, SURE
from cangauge.extras.judge.weak import CURVE_PCT, WeakestCell, weak_cell
from cangauge.logs.charge import implied_capacity
from cangauge.logs.log import Log, as_log
from cangauge.logs.read import CellColumns
from cangauge.model.model_file import PRIOR_MADE_BY, FunctionFields, Model, as_model
from cangauge.model.prior import ChemistryName
from cangauge.model.voltage_model import hermite_basis

OFF_FROM: Final = 0.95
"""A gauge is off where its error at the end is above `OFF_PCT` with this probability, …"""
AGREES_PCT: Final = 5.0
AGREES_FROM: Final = 0.9
"""… and agrees where it is below `AGREES_PCT` [%] with this one."""
NAMED: Final = 0.9
"""A fault is named from this probability, …"""
BESIDE_COUNT: Final = ("table", "voltage_sensor")
"""Places of faults that are named also where the gauge counts no charge, …"""
MATERIAL_PCT: Final = 2.0
"""… where it moves the published SoC by this somewhere: less is the gauge's resolution."""
FITTED: Final = Priors(1.5, 0.75, 0.25)
"""With a fitted model. The zero is half of the σ of a full charge, since both call much the same
full; the voltage is that of the sensor's class."""
TYPICAL: Final = Priors(3.0, 5.0, 5.0)
"""With a typical cell and a stated capacity. A car shows the usable part of its cells, which leaves
up to a tenth of the charge at either end; cells of one chemistry differ by 5 %."""
LFP_ZERO_PCT: Final = 0.5
"""Zero of a gauge of LFP cells, which is set to 100 % at the end of a charge [%]."""
COUNTED_STD_PCT: Final = 10.0
"""Standard deviation of a capacity that only the gauge's own count states [%]."""
CONTRADICTION: Final = 3.0
"""Where charge and published SoC differ by this factor, one of the two is no such signal."""
PROPORTIONAL: Final = 0.8
"""Square of the correlation from which they are in proportion."""
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
        are given, the voltage is not that of such cells, or charge and published SoC contradict
        each other by a factor of two.
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
        pack, priors = as_model(model), FITTED
        if capacity_ah is not None:
            pack = pack.model_copy(update={"capacity_ah": capacity_ah})
    elif chemistry is not None and cells is not None:
        priors = TYPICAL if chemistry == "oxide" else TYPICAL._replace(zero_pct=LFP_ZERO_PCT)
        if capacity_ah is None:
            priors = priors._replace(capacity_pct=COUNTED_STD_PCT)
            capacity_ah = implied_capacity(judged).capacity_ah
        pack = Model.prior(chemistry, cells, capacity_ah)
    else:
        raise InputError(
            "neither a model nor chemistry and cells",
            field="--model",
            cure="give -m MODEL, or --chemistry oxide|lfp and --cells N",
        )
    with threadpool_limits(1):  # small matrices
        chain = Chain(judged, pack)
        _check(chain)
        fits = explain(chain, priors)
    weakest = _weakest(judged, cell_voltages, chain, fits[0].pack_pct)
    return _judgement(judged, chain, fits, weakest)


def _check(chain: Chain) -> None:
    """Raise InputError for a current or SoC that is no such signal, and for other cells."""
    ratio = _ratio(chain)
    if not 1.0 / CONTRADICTION < abs(ratio) < CONTRADICTION:
        raise InputError(
            "charge and SoC contradict each other: one moves by"
            f" {rounded(max(abs(ratio), 1.0 / max(abs(ratio), 1e-9)))} times the other",
            field="current_a",
            cure="check unit, scale, sign and width of the current and of the SoC",
        )
    if chain.model.made.by != PRIOR_MADE_BY:
        return
    cells = chain.model.cells or 1
    error_v = chain.blocks.voltage_v - chain.voltage_v(chain.fitting_pct)
    misfit_v = float(np.median([np.nanmean(error_v[each.blocks]) for each in chain.stretches]))
    if abs(misfit_v) > MISFIT_V * cells:
        raise InputError(
            f"at no SoC is the voltage that of {cells} {chain.model.chemistry} cells: the best"
            f" start leaves {number(misfit_v / cells, 2, 'V')} per cell",
            field="--chemistry/--cells",
            cure="check --chemistry and --cells, or fit a model of the pack",
        )


def _ratio(chain: Chain) -> float:
    """Return charge over what the published SoC moves by, if one follows the other; else 1.

    A signal that is decoded wrongly is in proportion. A gauge that jumps, stands still or follows
    the voltage is not.
    """
    sums = np.zeros((2, 2))
    for stretch in chain.stretches:
        shown = chain.published.shown_pct[stretch.samples]
        both = np.array([shown, -chain.samples.drawn_pct[stretch.samples]])[:, np.isfinite(shown)]
        if both.size:
            apart = both - both.mean(axis=1, keepdims=True)
            sums += apart @ apart.T
    in_proportion = sums[0, 1] ** 2 > PROPORTIONAL * sums[0, 0] * sums[1, 1]
    return float(sums[0, 1] / sums[0, 0]) if in_proportion else 1.0


def _weakest(
    logs: Sequence[Log],
    cell_voltages: Sequence[CellColumns | None],
    chain: Chain,
    soc_pct: FloatArray,
) -> WeakestCell | None:
    """Return the weakest cell where it is one more probably than not."""
    volts, socs, amps, first = [], [], [], 1
    for stretch in chain.stretches:
        beside = cell_voltages[stretch.log] if stretch.log < len(cell_voltages) else None
        if beside is None:
            continue
        log, first = logs[stretch.log], beside.first
        rows = np.searchsorted(log.time_s, chain.blocks.time_s[stretch.blocks])
        volts.append(beside.voltage_v[rows])
        socs.append(soc_pct[stretch.blocks])
        amps.append(log.current_a[rows])
    if not volts:
        return None
    curve_v = chain.model.voltage_model().pseudo_ocv(CURVE_PCT) / volts[0].shape[1]
    weakest = weak_cell(volts, socs, amps, curve_v, first)
    if weakest is None or weakest.probability < NAMED:
        return None
    # A capacity is as well known as the slope of the curve over the SoC that was visited.
    visited_pct = np.percentile(np.concatenate(socs), [0.0, 100.0])
    of_functions = hermite_basis(visited_pct, chain.functions.soc_pct) @ chain.functions.value
    over_v = np.diff(chain.model.voltage_model().pseudo_ocv(visited_pct))
    slope_std = float(np.linalg.norm(np.diff(of_functions, axis=0)) / over_v[0])
    std_pct = float(np.hypot(weakest.std_pct, slope_std * weakest.lack_pct))
    return weakest._replace(std_pct=std_pct)


def _judgement(
    logs: tuple[Log, ...], chain: Chain, fits: list[Fitted], weakest: WeakestCell | None
) -> Judgement:
    """Return what all sets of faults say together, each by its probability.

    The SoC is that of the sets in which the gauge's present level is free: it does not confirm
    itself. A pack is as empty as its weakest cell.
    """
    free = [fit for fit in fits if fit.is_free] or fits
    share = np.array([fit.share for fit in free])
    share /= share.sum()
    soc, std = np.array([fit.soc_pct for fit in free]), np.array([fit.std_pct for fit in free])
    mean = share @ soc
    total = np.sqrt(share @ (std**2 + (soc - mean) ** 2))
    corrected = chain.at_samples(mean + chain.blocks.drawn_pct) - chain.samples.drawn_pct
    corrected_std = chain.at_samples(total)
    if weakest is not None:
        corrected_std = np.hypot(corrected_std, weakest.std_pct * (100.0 - corrected) / 100.0)
        corrected = corrected - weakest.behind_pct(corrected)
    pieces = _pieces(chain, fits[0], corrected, corrected_std)
    faults = _faults(chain, fits, pieces)
    if weakest is not None:
        size, half = weakest.lack_pct, SURE * weakest.std_pct
        interval = (size - half, size + half)
        faults.append(FoundFault("weak_cell", weakest.probability, size, interval, "%", None))
    row = int(np.flatnonzero(np.isfinite(chain.published.shown_pct))[-1])
    stretch = chain.stretches[chain.samples.stretch[row]]
    ends_h = chain.blocks.hours[stretch.blocks] <= chain.samples.hours[row]
    block = stretch.blocks.start + max(int(np.count_nonzero(ends_h)) - 1, 0)
    errors = pieces[-1].error_pct - (soc - mean)[:, block]

    def within(limit_pct: float) -> float:
        ends = ndtr((np.array([[limit_pct], [-limit_pct]]) - errors) / std[:, block])
        return float((ends[0] - ends[1]) @ share)

    verdict: Verdict = "cannot_tell"
    if pieces[-1].stands_at_pct is not None or 1.0 - within(OFF_PCT) >= OFF_FROM:
        verdict = "off"
    elif within(AGREES_PCT) >= AGREES_FROM and not _may_stand(chain):
        verdict = "agrees"
    return Judgement(
        logs=logs,
        model=chain.model,
        fits=fits,
        corrected_pct=_of_logs(chain, logs, corrected),
        corrected_std_pct=_of_logs(chain, logs, corrected_std),
        verdict=verdict,
        error_pct=pieces[-1].error_pct,
        error_std_pct=pieces[-1].std_pct,
        pieces=pieces,
        faults=sorted(faults, key=lambda fault: -fault.probability),
        was_full=bool(chain.is_full.any()),
        weakest=weakest,
    )


def _of_logs(chain: Chain, logs: Sequence[Log], values: FloatArray) -> list[FloatArray]:
    """Return values of the samples at each row of each log; NaN where it has none."""
    found = [np.full(len(log), np.nan) for log in logs]
    for stretch in chain.stretches:
        found[stretch.log][stretch.rows] = values[stretch.samples]
    return found


def _may_stand(chain: Chain) -> bool:
    """Return whether the gauge has not moved at the end where a dashboard would have shown it."""
    known = np.flatnonzero(np.isfinite(chain.published.shown_pct))
    shown = chain.published.shown_pct[known]
    same = known[np.max(np.flatnonzero(shown != shown[-1]), initial=-1) + 1 :]
    _, first = np.unique(chain.samples.stretch[same], return_index=True)
    held_pct = float(chain.published.held_pct[same[first]].sum())
    return held_pct >= JUMP_PCT + 2.0 * float(chain.published.step_pct[known[-1]])


def _moment(chain: Chain, row: int) -> Moment:
    log = chain.stretches[chain.samples.stretch[row]].log
    return Moment(log, float(chain.samples.time_s[row]))


def _pieces(
    chain: Chain, best: Fitted, corrected_pct: FloatArray, std_pct: FloatArray
) -> list[Piece]:
    """Return what the gauge did between its jumps and resets, and where it stood still."""
    resets = np.zeros(len(chain.stretches), dtype=np.intp)  # in the pause before a stretch
    for fault in best.faults:
        if fault.place[0] == "level":
            changed = np.unique(chain.blocks.stretch[np.asarray(fault.shown) != 0.0])
            goes_on = np.unique(chain.blocks.stretch[chain.piece == fault.place[1]])
            resets[np.intersect1d([changed[0], changed[-1] + 1], goes_on[1:])] = 1
    published = chain.published
    latest = np.maximum.accumulate(np.maximum(chain.row_piece, 0))
    numbers = latest * resets.size + np.cumsum(resets)[chain.samples.stretch]
    rows = np.flatnonzero(np.isfinite(published.shown_pct))
    label = np.where(published.stands, -1.0 - published.shown_pct, numbers)[rows]
    edges = np.flatnonzero(np.diff(label, prepend=np.nan, append=np.nan) != 0.0)
    found = []
    for low, high in pairwise(edges):
        last, stands = rows[high - 1], bool(published.stands[rows[low]])
        found.append(
            Piece(
                begin=_moment(chain, rows[low]),
                end=_moment(chain, last),
                error_pct=float(published.shown_pct[last] - corrected_pct[last]),
                std_pct=float(std_pct[last]),
                stands_at_pct=float(published.shown_pct[last]) if stands else None,
                moved_pct=stands * float(published.held_pct[rows[low:high]].max()),
            )
        )
    return found


def _faults(chain: Chain, fits: Sequence[Fitted], pieces: Sequence[Piece]) -> list[FoundFault]:
    """Return the faults that are probable, of a known sign and a possible size, and matter."""
    shapes = dict[tuple[str | int, ...], list[tuple[Column, float, float, float]]]()
    for fit in fits:
        for column, size, std in zip(fit.faults, fit.size, fit.std, strict=True):
            place = (column.name, *column.place[1:])
            share = fit.share if fit.is_counter or column.place[0] in BESIDE_COUNT else 0.0
            shapes.setdefault(place, []).append((column, share, float(size), float(std)))
    found = []
    for of_place in shapes.values():
        share, sizes, stds = np.array([numbers for _, *numbers in of_place]).T
        column, probability = of_place[int(np.argmax(share))][0], float(share.sum())
        if probability < NAMED:
            continue
        within = share / probability
        size = float(within @ sizes)
        std = float(np.sqrt(within @ (stds**2 + (sizes - size) ** 2)))
        is_possible = SURE * std < abs(size) <= BEYOND * column.std * column.per_unit
        if not is_possible or _moves_pct(chain, column, size) < MATERIAL_PCT:
            continue
        is_inside = chain.samples.stretch >= column.since
        if column.place[0] == "level":
            is_inside &= chain.row_piece == column.place[1]
        row = int(np.argmax(is_inside))
        since = _moment(chain, row) if np.max(chain.row_piece[:row], initial=-1) >= 0 else None
        interval = (size - SURE * std, size + SURE * std)
        kind = FAULTS[column.name]
        found.append(
            FoundFault(column.name, min(probability, 1.0), size, interval, kind.unit, since)
        )
    # At a limit a gauge may count on unseen, unless it never leaves it.
    stands = [
        piece for piece in pieces[:-1] if piece.stands_at_pct and not is_limit(piece.stands_at_pct)
    ]
    stands += [piece for piece in pieces[-1:] if piece.stands_at_pct is not None]
    if stands:
        longest = max(stands, key=lambda piece: piece.moved_pct)
        moved = longest.moved_pct
        found.append(FoundFault("stands_still", 1.0, moved, (moved, moved), "%", longest.begin))
    return found


def _moves_pct(chain: Chain, column: Column, size: float) -> float:
    """Return the most by which a fault moves published against true SoC [%]."""
    if column.name in {"voltage_sensor", "model_capacity"}:  # of the log and of the model
        return np.inf
    counted = chain.piece >= 0
    moves = np.broadcast_to(np.abs(np.asarray(column.shown) - column.soc), counted.size)
    return abs(size) / column.per_unit * float(moves[counted].max())


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
