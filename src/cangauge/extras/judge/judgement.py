"""The judgement on a gauge: how far off now and before, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from operator import attrgetter
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
from cangauge.extras.judge.faults import FAULTS, Column
from cangauge.extras.judge.gauge import JUMP_PCT, STAND_PCT, is_limit, published_pct, stands
from cangauge.extras.judge.result import FoundFault, Judgement, Moment, Piece, Verdict, is_dated
from cangauge.extras.judge.text import AGREES_PCT, NAMED, OFF_PCT, SURE
from cangauge.extras.judge.weak import weakest_cell
from cangauge.logs.charge import implied_capacity
from cangauge.logs.log import Log, as_log
from cangauge.logs.read import CellColumns
from cangauge.model.model_file import PRIOR_MADE_BY, FunctionFields, Model, as_model
from cangauge.model.prior import ChemistryName

KNOWN: Final[Mapping[str, Mapping[str, float]]] = {
    "fitted": {"zero": 0.75, "voltage": 0.25, "capacity": 1.5},
    "oxide": {"zero": 5.0, "voltage": 5.0, "capacity": 3.0},
    "lfp": {"zero": 0.5, "voltage": 5.0, "capacity": 3.0},
}
"""Standard deviations of the zero of the gauge beside the model's, of the scale of the voltage, and
of the capacity [%], with a fitted model and with a typical cell. A fitted zero is half of the σ of
a full charge, since both call much the same full; the voltage is that of the sensor's class. A car
shows the usable part of its cells, which leaves up to a tenth of the charge at either end; a gauge
of LFP cells is set to 100 % at the end of a charge. Cells of one chemistry differ by 5 %."""
CONTRADICTION: Final = 3.0
"""Where charge and published SoC differ by this factor, one of the two is no such signal."""
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
        each other by a factor of three.
    """
    judged = tuple(as_log(log) for log in logs)
    if is_dated(judged):
        starts = [float(log.time_s[0]) for log in judged]
        judged = tuple(judged[k] for k in np.argsort(starts, kind="stable"))
    check_given_once(judged, cure="give each log once")
    if not any(np.isfinite(published_pct(log)).sum() > 1 for log in judged):
        raise InputError(
            "no log has the SoC that the gauge publishes",
            field="soc_pct",
            cure="name its column, such as --columns soc=HEADING",
        )
    if model is not None:
        pack, known = as_model(model), KNOWN["fitted"]
        if capacity_ah is not None:
            pack = pack.model_copy(update={"capacity_ah": capacity_ah})
    elif chemistry is not None and cells is not None:
        known = KNOWN[chemistry]
        if capacity_ah is None:  # as wrong as the scale of a gauge can be
            known = {**known, "capacity": FAULTS["count_scale"].stds[0]}
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
        _check_count(chain)
        _check_cells(chain)
        fits = explain(chain, known)
    weakest = weakest_cell(judged, cell_voltages, chain, fits[0].pack_pct)
    is_weak = weakest is not None and weakest.probability >= NAMED
    return _judgement(judged, chain, fits, weakest if is_weak else None)


def _check_count(chain: Chain) -> None:
    """Raise InputError for a current or SoC that is no such signal.

    A signal that is decoded wrongly is in proportion. A gauge that jumps, stands still or follows
    the voltage is not.
    """
    shown, drawn = chain.samples.shown_pct, chain.samples.drawn_pct
    known = np.isfinite(shown)
    both = np.array([shown, -drawn])[:, known]
    _, first, sizes = np.unique(chain.samples.stretch[known], return_index=True, return_counts=True)
    apart = both - np.repeat(np.add.reduceat(both, first, axis=1) / sizes, sizes, axis=1)
    (of_soc, of_both), (_, of_charge) = apart @ apart.T
    if of_both**2 <= 0.8 * of_soc * of_charge:
        return
    ratio = abs(of_both / of_soc)
    if not 1.0 / CONTRADICTION < ratio < CONTRADICTION:
        raise InputError(
            "charge and SoC contradict each other: one moves by"
            f" {rounded(max(ratio, 1.0 / ratio))} times the other",
            field="current_a",
            cure="check unit, scale, sign and width of the current and of the SoC",
        )


def _check_cells(chain: Chain) -> None:
    """Raise InputError for other cells than the typical ones that are given."""
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


def _judgement(
    logs: tuple[Log, ...], chain: Chain, fits: list[Fitted], weakest: FoundFault | None
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
        drawn = 100.0 - corrected  # of a pack that was full
        corrected_std = np.hypot(corrected_std, weakest.std * drawn / 100.0)
        corrected = corrected - weakest.size * drawn / (100.0 - weakest.size)
    pieces = _pieces(chain, fits[0], corrected, corrected_std)
    row = int(np.flatnonzero(np.isfinite(chain.samples.shown_pct))[-1])
    block = np.searchsorted(chain.blocks.clock_h, chain.samples.clock_h[row], side="right") - 1
    errors = pieces[-1].error_pct - (soc - mean)[:, block]

    def within(limit_pct: float) -> float:
        ends = ndtr((np.array([[limit_pct], [-limit_pct]]) - errors) / std[:, block])
        return float((ends[0] - ends[1]) @ share)

    verdict: Verdict = "cannot_tell"
    if pieces[-1].stands_at_pct is not None or within(OFF_PCT) <= 0.05:
        verdict = "off"
    elif within(AGREES_PCT) >= NAMED and not _may_stand(chain):
        verdict = "agrees"
    faults = [*_faults(chain, fits), *_stand(pieces), *([weakest] if weakest else [])]
    return Judgement(
        logs=logs,
        model=chain.model,
        fits=fits,
        corrected_pct=_of_logs(chain, logs, corrected),
        corrected_std_pct=_of_logs(chain, logs, corrected_std),
        verdict=verdict,
        pieces=pieces,
        faults=sorted(faults, key=attrgetter("probability"), reverse=True),
        was_full=bool(chain.is_full.any()),
    )


def _of_logs(chain: Chain, logs: Sequence[Log], values: FloatArray) -> list[FloatArray]:
    """Return values of the samples at each row of each log; NaN where it has none."""
    found = [np.full(len(log), np.nan) for log in logs]
    for stretch in chain.stretches:
        found[stretch.log][stretch.rows] = values[stretch.samples]
    return found


def _may_stand(chain: Chain) -> bool:
    """Return whether the gauge has not moved at the end where a dashboard would have shown it."""
    samples = chain.samples
    known = np.flatnonzero(np.isfinite(samples.shown_pct))
    shown = samples.shown_pct[known]
    same = known[np.max(np.flatnonzero(shown != shown[-1]), initial=-1) + 1 :]
    _, first = np.unique(samples.stretch[same], return_index=True)
    return bool(stands(samples.held_pct[same[first]].sum(), samples.step_pct[known[-1]], JUMP_PCT))


def _moment(chain: Chain, row: int) -> Moment:
    samples = chain.samples
    return chain.stretches[samples.stretch[row]].log, float(samples.time_s[row])


def _pieces(
    chain: Chain, best: Fitted, corrected_pct: FloatArray, std_pct: FloatArray
) -> list[Piece]:
    """Return what the gauge did between its jumps and resets, and where it stood still."""
    resets = np.zeros(len(chain.stretches), dtype=np.intp)  # in the pause before a stretch
    for fault in best.faults:
        if fault.piece >= 0:
            changed = np.unique(chain.blocks.stretch[np.asarray(fault.shown) != 0.0])
            goes_on = np.unique(chain.blocks.stretch[chain.piece == fault.piece])
            resets[np.intersect1d([changed[0], changed[-1] + 1], goes_on[1:])] = 1
    samples = chain.samples
    latest = np.maximum.accumulate(np.maximum(chain.row_piece, 0))
    numbers = latest * resets.size + np.cumsum(resets)[samples.stretch]
    is_standing = stands(samples.held_pct, samples.step_pct)
    rows = np.flatnonzero(np.isfinite(samples.shown_pct))
    label = np.where(is_standing, -1.0 - samples.shown_pct, numbers)[rows]
    edges = np.flatnonzero(np.diff(label, prepend=np.nan, append=np.nan) != 0.0)
    found = []
    for low, high in pairwise(edges):
        last, is_stand = rows[high - 1], bool(is_standing[rows[low]])
        shown_pct = float(samples.shown_pct[last])
        found.append(
            Piece(
                begin=_moment(chain, rows[low]),
                end=_moment(chain, last),
                error_pct=shown_pct - float(corrected_pct[last]),
                std_pct=float(std_pct[last]),
                stands_at_pct=shown_pct if is_stand else None,
                moved_pct=is_stand * float(samples.held_pct[rows[low:high]].max()),
            )
        )
    return found


def _stand(pieces: Sequence[Piece]) -> list[FoundFault]:
    """Return the longest stand; at a limit a gauge may count on unseen, unless it never leaves."""
    found = [piece for piece in pieces[:-1] if piece.stands_at_pct]
    found = [piece for piece in found if not is_limit(piece.stands_at_pct or 0.0)]
    found += [piece for piece in pieces[-1:] if piece.stands_at_pct is not None]
    if not found:
        return []
    longest = max(found, key=attrgetter("moved_pct"))
    return [FoundFault("stands_still", 1.0, longest.moved_pct, 0.0, longest.begin)]


def _faults(chain: Chain, fits: Sequence[Fitted]) -> list[FoundFault]:
    """Return the faults that are probable, of a known sign and a possible size, and matter."""
    shapes = dict[tuple[str, int, int], list[tuple[Column, float, float, float]]]()
    for fit in fits:
        number_of = len(fit.faults)
        sizes = fit.posterior.mean[:number_of]
        stds = np.linalg.norm(fit.posterior.root[:number_of], axis=1)
        for column, size, std in zip(fit.faults, sizes, stds, strict=True):
            is_possible = fit.is_counter or not FAULTS[column.fault].is_of_count
            share = fit.share if is_possible else 0.0
            shapes.setdefault(column.name, []).append((column, share, float(size), float(std)))
    found = []
    for of_name in shapes.values():
        share, sizes, stds = np.array([numbers for _, *numbers in of_name]).T
        column, probability = of_name[int(np.argmax(share))][0], float(share.sum())
        if probability < NAMED:
            continue
        within = share / probability
        size = float(within @ sizes)
        std = float(np.sqrt(within @ (stds**2 + (sizes - size) ** 2)))
        # None: of the log or the model, and not of the gauge.
        apart = np.broadcast_to(np.asarray(column.shown) - column.soc, chain.piece.shape)
        moves = float(np.abs(apart[chain.piece >= 0]).max(initial=0.0))
        matters = moves == 0.0 or abs(size) * moves >= STAND_PCT
        if not SURE * std < abs(size) <= BEYOND * column.std or not matters:
            continue
        is_inside = chain.samples.stretch >= column.since
        if column.piece >= 0:
            is_inside &= chain.row_piece == column.piece
        row = int(np.argmax(is_inside))
        since = _moment(chain, row) if np.max(chain.row_piece[:row], initial=-1) >= 0 else None
        found.append(FoundFault(column.fault, min(probability, 1.0), size, std, since))
    return found


def narrowed(judgement: Judgement) -> Model:
    """Return the model with its curve and loads learned from the logs, and their σ.

    InputError for a model of the published equation, which states no error of its curve.
    """
    model, fields, posterior = (
        judgement.model,
        judgement.model.functions,
        judgement.fits[0].posterior,
    )
    if not fields.curve_v:
        problem = "the model states no error of its curve that logs could narrow"
        raise InputError(problem, field="--output", cure="make the model by `cangauge fit`")
    curve, loads = np.array(fields.curve_v).T, np.array(fields.load).T
    first = len(judgement.fits[0].faults)
    of = slice(first, first + curve.shape[1])
    learned, covariance = posterior.mean[of], posterior.covariance[of, of]
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(learned.size))
    functions = FunctionFields(
        soc_pct=fields.soc_pct, curve_v=(curve @ root).T.tolist(), load=(loads @ root).T.tolist()
    )
    update: dict[str, Any] = {"functions": functions, "name": f"{model.name}, narrowed"}
    before = model.loads
    if model.curve is not None and before is not None and before.arrhenius is not None:
        at_pct = model.curve.soc_pct
        volts = np.array(model.curve.voltage_v)
        volts += np.interp(at_pct, fields.soc_pct, curve @ learned)
        rising = np.maximum.accumulate(volts).tolist()
        update["curve"] = model.curve.model_copy(update={"voltage_v": tuple(rising)})
        change = loads @ learned
        last = 1 + len(before.resistance_ohm)  # kt and the resistances, then b
        factor = before.arrhenius.factor + float(change[last])
        changed = {
            "kt_v_per_k": before.kt_v_per_k + float(change[0]),
            "resistance_ohm": tuple((np.array(before.resistance_ohm) + change[1:last]).tolist()),
            "arrhenius": before.arrhenius.model_copy(update={"factor": factor}),
        }
        update["loads"] = before.model_copy(update=changed)
    return model.model_copy(update=update)
