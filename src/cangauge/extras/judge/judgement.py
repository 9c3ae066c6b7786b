"""The judgement on a gauge: how far off now and before, and why."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any, Final

import numpy as np
from scipy import ndimage
from scipy.special import ndtr
from threadpoolctl import threadpool_limits

from cangauge._text import number, rounded
from cangauge._typing import FloatArray
from cangauge.diagnosis.checks import check_given_once
from cangauge.errors import InputError
from cangauge.extras.judge.chain import Chain
from cangauge.extras.judge.explain import explain
from cangauge.extras.judge.faults import FAULTS, Column
from cangauge.extras.judge.gauge import JUMP_PCT, STAND_PCT, is_limit, published_pct, stands
from cangauge.extras.judge.linearised import BEYOND, Fitted
from cangauge.extras.judge.result import FoundFault, Judgement, Moment, Piece, Verdict, is_dated
from cangauge.extras.judge.text import AGREES_PCT, NAMED, OFF_PCT, SURE
from cangauge.extras.judge.weak import weakest_cell
from cangauge.logs.charge import implied_capacity
from cangauge.logs.log import Log, as_log
from cangauge.logs.read import CellColumns
from cangauge.model.model_file import PRIOR_MADE_BY, Model, as_model
from cangauge.model.prior import ChemistryName
from cangauge.model.voltage_model import Functions

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
    judged, beside = [as_log(log) for log in logs], [*cell_voltages]
    if is_dated(judged):
        order = np.argsort([log.time_s[0] for log in judged], kind="stable").tolist()
        judged = [judged[k] for k in order]
        beside = [beside[k] for k in order if k < len(beside)]
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
            if capacity_ah <= 0.0:
                raise InputError(
                    "charge and SoC contradict each other: the SoC rises as charge is drawn",
                    field="current_a",
                    cure="check the sign of the current (positive must discharge) and the SoC",
                )
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
    weakest = weakest_cell(judged, beside, chain, fits[0].pack_pct)
    found = _faults(chain, fits)
    if weakest is not None and weakest.probability >= NAMED:
        found.append(weakest)
    else:
        weakest = None
    corrected, std = _corrected(chain, fits, weakest)
    pieces = _pieces(chain, fits[0], corrected, std)
    found += _stand(pieces)
    return Judgement(
        logs=judged,
        model=pack,
        fits=fits,
        corrected_pct=_of_logs(chain, judged, corrected),
        corrected_std_pct=_of_logs(chain, judged, std),
        verdict=_verdict(chain, pieces[-1]),
        pieces=pieces,
        faults=sorted(found, key=attrgetter("probability"), reverse=True),
        was_full=bool(chain.is_full.any()),
    )


def _check_count(chain: Chain) -> None:
    """Raise InputError for a current or SoC that is no such signal.

    A signal that is decoded wrongly is in proportion. A gauge that jumps, stands still or follows
    the voltage is not.
    """
    samples, known = chain.samples, np.isfinite(chain.samples.shown_pct)
    of = samples.stretch[known]
    soc, charge = (
        each[known] - ndimage.mean(each[known], of, of)
        for each in (samples.shown_pct, samples.drawn_pct)
    )
    if (soc @ charge) ** 2 <= 0.8 * (soc @ soc) * (charge @ charge):
        return
    ratio = abs(soc @ charge) / (soc @ soc)
    times = float(max(ratio, 1.0 / ratio))
    if times >= 3.0:  # no gauge is as wrong
        raise InputError(
            f"charge and SoC contradict each other: one moves by {rounded(times)} times the other",
            field="current_a",
            cure="check unit, scale, sign and width of the current and of the SoC",
        )


def _check_cells(chain: Chain) -> None:
    """Raise InputError for other cells than the typical ones that are given."""
    cells = chain.model.cells or 1
    error_v = (chain.blocks.voltage_v - chain.voltage_v(chain.fitting_pct)) / cells
    misfit_v = float(np.median([np.nanmean(error_v[each.blocks]) for each in chain.stretches]))
    # No cell is as far from the typical one of its chemistry at its best start.
    if chain.model.made.by == PRIOR_MADE_BY and abs(misfit_v) > 0.1:
        raise InputError(
            f"at no SoC is the voltage that of {cells} {chain.model.chemistry} cells: the best"
            f" start leaves {number(misfit_v, 2, 'V')} per cell",
            field="--chemistry/--cells",
            cure="check --chemistry and --cells, or fit a model of the pack",
        )


def _corrected(
    chain: Chain, fits: Sequence[Fitted], weakest: FoundFault | None
) -> tuple[FloatArray, FloatArray]:
    """Return the SoC of each sample by all sets of faults, each by its probability, and its σ [%].

    The sets are those in which the gauge's present level is free: it does not confirm itself. A
    pack is as empty as its weakest cell.
    """
    free = [fit for fit in fits if fit.is_free] or fits
    share = np.array([fit.share for fit in free])
    share /= share.sum()
    soc, stds = np.array([fit.soc_pct for fit in free]), np.array([fit.std_pct for fit in free])
    mean = share @ soc
    std = chain.at_samples(np.sqrt(share @ (stds**2 + (soc - mean) ** 2)))
    corrected = chain.at_samples(mean + chain.blocks.drawn_pct) - chain.samples.drawn_pct
    if weakest is not None:
        drawn = 100.0 - corrected  # of a pack that was full
        std = np.hypot(std, weakest.std * drawn / 100.0)
        corrected = corrected - weakest.size * drawn / (100.0 - weakest.size)
    return corrected, std


def _verdict(chain: Chain, last: Piece) -> Verdict:
    """Return what the error at the end, and its σ, say of the gauge."""

    def within(limit_pct: float) -> float:
        high, low = ndtr((np.array([limit_pct, -limit_pct]) - last.error_pct) / last.std_pct)
        return float(high - low)

    if last.stands_at_pct is not None or within(OFF_PCT) <= 0.05:
        return "off"
    # It may stand still where it has not moved, and a dashboard would have shown that it does.
    row = int(np.flatnonzero(np.isfinite(chain.samples.shown_pct))[-1])
    may_stand = stands(chain.samples.held_pct[row], chain.samples.step_pct[row], JUMP_PCT)
    return "agrees" if within(AGREES_PCT) >= NAMED and not may_stand else "cannot_tell"


def _of_logs(chain: Chain, logs: Sequence[Log], values: FloatArray) -> list[FloatArray]:
    """Return values of the samples at each row of each log; NaN where it has none."""
    found = [np.full(len(log), np.nan) for log in logs]
    for stretch in chain.stretches:
        found[stretch.log][stretch.rows] = values[stretch.samples]
    return found


def _moment(chain: Chain, row: int) -> Moment:
    return chain.stretches[chain.samples.stretch[row]].log, float(chain.samples.time_s[row])


def _pieces(
    chain: Chain, best: Fitted, corrected_pct: FloatArray, std_pct: FloatArray
) -> list[Piece]:
    """Return what the gauge did between its jumps and resets, and where it stood still."""
    samples, resets = chain.samples, np.zeros(len(chain.stretches), dtype=np.intp)
    for fault in best.faults:
        at = np.flatnonzero((chain.piece == fault.piece) & (chain.piece >= 0))
        is_reset = np.diff(np.broadcast_to(fault.shown, chain.piece.shape)[at]) != 0.0
        resets[chain.blocks.stretch[at[1:]][is_reset]] = 1  # in the pause before it
    latest = np.maximum.accumulate(np.maximum(chain.row_piece, 0))
    numbers = latest * resets.size + np.cumsum(resets)[samples.stretch]
    is_standing = stands(samples.held_pct, samples.step_pct)
    rows = np.flatnonzero(np.isfinite(samples.shown_pct))
    label = np.where(is_standing, -1.0 - samples.shown_pct, numbers)[rows]
    edges = np.flatnonzero(np.diff(label, prepend=np.nan, append=np.nan) != 0.0)
    found = []
    for first, end in zip(rows[edges[:-1]], rows[edges[1:] - 1], strict=True):
        shown_pct, is_stand = float(samples.shown_pct[end]), bool(is_standing[first])
        found.append(
            Piece(
                begin=_moment(chain, first),
                end=_moment(chain, end),
                error_pct=shown_pct - float(corrected_pct[end]),
                std_pct=float(std_pct[end]),
                stands_at_pct=shown_pct if is_stand else None,
                moved_pct=is_stand * float(samples.held_pct[first : end + 1].max()),
            )
        )
    return found


def _stand(pieces: Sequence[Piece]) -> list[FoundFault]:
    """Return the longest stand; at a limit a gauge may count on unseen, unless it never leaves."""
    stood = [piece for piece in pieces if piece.stands_at_pct is not None]
    stood = [
        piece for piece in stood if piece is pieces[-1] or not is_limit(piece.stands_at_pct or 0.0)
    ]
    if not stood:
        return []
    longest = max(stood, key=attrgetter("moved_pct"))
    return [FoundFault("stands_still", 1.0, longest.moved_pct, 0.0, longest.begin)]


def _faults(chain: Chain, fits: Sequence[Fitted]) -> list[FoundFault]:
    """Return the faults that are probable, of a known sign and a possible size, and matter."""
    shapes = defaultdict[tuple[str, int, int], list[tuple[float, float, float, Column]]](list)
    now = np.flatnonzero(chain.piece >= 0)[-1:]
    for fit in fits:
        # Levels that hold now are one, whatever was before.
        together = defaultdict[tuple[str, int, int], list[int]](list)
        for k, column in enumerate(fit.faults):
            if fit.is_counter or not FAULTS[column.fault].is_of_count:
                is_now = column.piece >= 0 and np.any(np.asarray(column.shown)[now])
                together[(column.fault, -1, 0) if is_now else column.name].append(k)
        for name, ks in together.items():
            size = float(fit.posterior.mean[ks].sum())
            std = float(np.linalg.norm(fit.posterior.root[ks].sum(axis=0)))
            shapes[name].append((fit.share, size, std, fit.faults[ks[0]]))
    found = []
    for of_name in shapes.values():
        share, sizes, stds = np.array([numbers for *numbers, _ in of_name]).T
        probability, column = float(share.sum()), of_name[int(np.argmax(share))][-1]
        if probability < NAMED:
            continue
        size = float(share @ sizes) / probability
        std = float(np.sqrt(share @ (stds**2 + (sizes - size) ** 2) / probability))
        # Without a trace in what is published: of the log or the model, and not of the gauge.
        apart = np.broadcast_to(np.asarray(column.shown) - column.soc, chain.piece.shape)
        moves = float(np.abs(apart[chain.piece >= 0]).max(initial=0.0))
        matters = moves == 0.0 or abs(size) * moves >= STAND_PCT
        is_sure = SURE * std < abs(size) <= BEYOND * column.std
        if not is_sure or not matters:
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

    Raises
    ------
    InputError
        For a model of the published equation, which states no error of its curve.
    """
    model, before, given = judgement.model, judgement.model.curve, judgement.model.loads
    if before is None or given is None or given.arrhenius is None:
        problem = "the model states no error of its curve that logs could narrow"
        raise InputError(problem, field="--output", cure="make the model by `cangauge fit`")
    functions, best = model.functions, judgement.fits[0]
    of = slice(len(best.faults), len(best.faults) + functions.number)
    mean, covariance = best.posterior.mean[of], best.posterior.covariance[of, of]
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(functions.number))
    curve_v = before.voltage_v + np.interp(
        before.soc_pct, functions.soc_pct, functions.value @ mean
    )
    coefficients = model.voltage_model().load_coefficients
    of_load = functions.load_parts(coefficients.size)
    kt, *ohm, factor = coefficients + of_load @ mean
    loads = {
        "kt_v_per_k": kt,
        "resistance_ohm": tuple(ohm),
        "arrhenius": given.arrhenius.model_copy(update={"factor": factor}),
    }
    return model.model_copy(
        update={
            "name": f"{model.name}, narrowed",
            "curve": before.model_copy(
                update={"voltage_v": tuple(np.maximum.accumulate(curve_v).tolist())}
            ),
            "loads": given.model_copy(update=loads),
            "functions": Functions(
                soc_pct=functions.soc_pct,
                curve_v=(functions.value @ root).T.tolist(),
                load=(of_load @ root).T.tolist(),
            ),
        }
    )
