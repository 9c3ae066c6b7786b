"""Identification: recorded logs → model with its figures."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, Literal, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from cangauge._files import text_sha256
from cangauge._version import __version__
from cangauge.errors import InputError, require_choice, require_number
from cangauge.identify.effect_search import parse_effect_ids
from cangauge.identify.identification import (
    Identification,
    evaluate,
    remarks_on_effects,
    remarks_on_logs,
    remarks_on_rows,
)
from cangauge.identify.knots import fit_knots
from cangauge.identify.published import PublishedEquation, fit_published
from cangauge.identify.rows import LEAST_ROWS, FitRows, fit_rows, usable_delays
from cangauge.identify.starts import find_starts, given_starts, with_start
from cangauge.logs.charge import refuse_contradictions
from cangauge.logs.log import Log, as_log
from cangauge.model.coulomb_counting import (
    capacity_from_full_discharge,
    capacity_from_reference,
    counted_soc_pct,
)
from cangauge.model.curve import KNOTS_PCT
from cangauge.model.model_file import Made, SourceLog
from cangauge.model.physics import FULL_TO_EMPTY
from cangauge.model.prior import CHEMISTRIES, ChemistryName, PackPrior
from cangauge.model.voltage_model import DELAYS_S, Ranges

Equation = Literal["knots", "published"]

CELLS_TOLERANCE: Final = 0.1
"""Voltage of a cell relative to the nearer typical one, from which the number of cells must be
wrong [-]: five standard deviations (`prior.FULL_STD`)."""


def fit(
    logs: Any,
    *,
    capacity_ah: float | Literal["from-soc"] | None = None,
    initial_soc_pct: float | str | Sequence[float | str | None] | None = None,
    equation: Equation = "knots",
    chemistry: ChemistryName | None = None,
    cells: int | None = None,
    rate_hz: float = 1.0,
    delay_s: Sequence[float] = DELAYS_S,
    epsilon: float = PublishedEquation.epsilon,
    t_ref_c: float = PublishedEquation.t_ref_c,
    effects: str | Sequence[str] | None = None,
) -> Identification:
    """Identify the model of a pack from one or more logs.

    Decisions are logged to `cangauge.identify` at INFO.

    Parameters
    ----------
    logs : Log, path or DataFrame, or a sequence of them
    capacity_ah : float or "from-soc", optional
        Charge from 100 to 0 % [Ah]; "from-soc": the charge per 100 % of the logs' own SoC; by
        default from a log that runs from full to empty.
    initial_soc_pct : float or "auto", or a sequence of these, optional
        SoC at the first row [%], of all logs or of each; by default, and for "auto", the log's
        reference SoC. Where neither is known it is estimated together with the curve, if another
        log pins it.
    equation : {"knots", "published"}
        A curve of knots with the chemistry's prior, or the published equation by plain least
        squares.
    chemistry : {"oxide", "lfp"}, optional
        By default from the volts per cell where `cells` is given, else oxide.
    cells : int, optional
        Cells in series.
    rate_hz : float
        Rate of the fit and of the model [Hz]; logs are decimated to it.
    delay_s, epsilon, t_ref_c
        Delays of the current [s], margin ε of the scaled SoC and reference temperature T_r [°C] of
        the published equation.
    effects : str or sequence of str, optional
        Effect ids, or "auto": those that reduce the error of left-out logs significantly. By
        default "none". Only for knots.

    Returns
    -------
    Identification
        Its `model` can be saved, and used by `estimate` and `diagnose`.

    Raises
    ------
    InputError
        If the logs cannot identify the model: unknown capacity or start, no usable row,
        temperatures of different sources.

    Examples
    --------
    >>> fitted = fit("trip.csv", capacity_ah=60.0, cells=96)  # doctest: +SKIP
    >>> fitted.model.save("pack.json")  # doctest: +SKIP
    """
    _check_given(equation, chemistry, capacity_ah, cells)
    published_equation = PublishedEquation(epsilon, t_ref_c, tuple(delay_s))
    recorded = [as_log(log) for log in (logs if isinstance(logs, list | tuple) else [logs])]
    _check_logs(recorded)
    stated_pct = given_starts(initial_soc_pct, len(recorded))
    capacity_ah = _capacity_of(recorded, stated_pct, capacity_ah)
    effect_ids = _effect_ids(effects, equation)
    chemistry, remark = _chemistry_of(recorded, stated_pct, chemistry, cells, capacity_ah)
    pack = PackPrior(CHEMISTRIES[chemistry], capacity_ah, cells)
    options = {
        "capacity_ah": capacity_ah,
        "rate_hz": rate_hz,
        "chemistry": chemistry,
        "equation": equation,
        "initial_soc_pct": stated_pct[0] if len({*stated_pct}) == 1 else None,
        "effects": ", ".join(effect_ids) or None,
    }
    with threadpool_limits(limits=1):  # 40 columns: threads only wait for each other
        starts = find_starts(recorded, stated_pct, pack)
        known = [start.log for start in starts]
        on_logs = remarks_on_logs(starts, recorded, delay_s, capacity_ah)  # before rows need memory
        delays = DELAYS_S if equation == "knots" else usable_delays(known, delay_s)
        rows = [fit_rows(log, capacity_ah, rate_hz=rate_hz, delay_s=delays) for log in known]
        _check_rows(rows)
        fields = _fields(recorded, rows, cells, options)
        selected = None
        if equation == "knots":
            model, published, errors_v, selected = fit_knots(rows, pack, effect_ids, fields)
        else:
            published_equation = replace(published_equation, delay_s=delays)
            model, published, errors_v = fit_published(rows, published_equation, fields)
        extended = model.extended_model()
        fits = tuple(evaluate(extended, item) for item in rows)
    return Identification(
        model=model,
        published=published,
        held_out_error_v=errors_v,
        effects=selected,
        starts=tuple(starts),
        fits=fits,
        remarks=(
            *([remark] if remark else []),
            *remarks_on_rows(rows),
            *on_logs,
            *remarks_on_effects(selected, model),
        ),
    )


def _check_given(
    equation: str, chemistry: str | None, capacity_ah: float | str | None, cells: int | None
) -> None:
    require_choice(equation, get_args(Equation), "equation")
    require_choice(chemistry, (*CHEMISTRIES, None), "chemistry")
    if capacity_ah not in (None, "from-soc"):
        require_number(capacity_ah, "capacity_ah")
    if cells is not None and not cells >= 1:
        raise InputError("a pack has at least one cell", field="cells", value=cells)


def _check_logs(logs: Sequence[Log]) -> None:
    if not logs:
        raise InputError("no log given", cure="give at least one recorded log")
    by_rows: dict[str, Log] = {}
    for log in logs:
        first = by_rows.setdefault(log_sha256(log, ROWS_CHANNELS), log)
        if first is not log:
            raise InputError(
                f"same rows as {first.source or first.name}: they would count twice",
                source=log.source or log.name,
                cure="give each log once",
            )
    if len(sources := sorted({log.temperature_source for log in logs})) > 1:
        raise InputError(
            "the temperatures of the logs have different sources",
            field="temperature_source",
            value=sources,
            cure="state it in a column temperature_source of the logs that do not, or fit logs of"
            " one source together",
        )


def _capacity_of(
    logs: Sequence[Log], starts_pct: Sequence[float | None], stated: float | str | None
) -> float:
    """Return the capacity [Ah]: as stated, from a full discharge, or from the logs' own SoC.

    Raises
    ------
    InputError
        If it is not positive, or the SoC of logs without a stated start contradicts it.
    """
    if stated is None:
        capacity_ah = capacity_from_full_discharge(logs, starts_pct)
    elif isinstance(stated, str):
        capacity_ah = capacity_from_reference(logs)
    else:
        capacity_ah = stated
    if not capacity_ah > 0.0:
        raise InputError(
            "the capacity must be positive",
            field="capacity_ah",
            value=capacity_ah,
            cure="check the sign of current: positive must discharge",
        )
    unstated = [log for log, start in zip(logs, starts_pct, strict=True) if start is None]
    refuse_contradictions(unstated, capacity_ah)  # a stated start needs no SoC of the log
    return capacity_ah


def _effect_ids(effects: str | Sequence[str] | None, equation: Equation) -> tuple[str, ...]:
    ids = parse_effect_ids([effects] if isinstance(effects, str) else effects) if effects else ()
    if ids and equation == "published":
        raise InputError(
            "the published equation is fitted without effects",
            field="--effects",
            value=", ".join(ids),
            cure="leave out --equation published",
        )
    return ids


def _check_rows(rows: Sequence[FitRows]) -> None:
    """Raise InputError if the logs have too few rows for a model, or are of different packs."""
    if (number := sum(map(len, rows))) < LEAST_ROWS:
        raise InputError(
            f"only {number} rows can be used, and a fit needs {LEAST_ROWS}",
            source=rows[0].log.source or rows[0].name,
            cure="give logs of drives over some hours and much of the SoC; `cangauge inspect`"
            " lists what a log can identify",
        )
    by_volts = {float(np.median(item.voltage_v)): item for item in rows}
    low_v, high_v = min(by_volts), max(by_volts)
    if high_v > FULL_TO_EMPTY * max(low_v, 0.0):
        raise InputError(
            f"not of one pack with {by_volts[low_v].name}, which has about {low_v:.4g} V",
            source=by_volts[high_v].log.source or by_volts[high_v].name,
            field="voltage_v",
            value=high_v,
            cure="fit the logs of one pack only, and check the unit of the voltage",
        )


def _fields(
    logs: Sequence[Log], rows: Sequence[FitRows], cells: int | None, options: dict[str, Any]
) -> dict[str, Any]:
    """Return the fields of a model file that are known before the fit."""
    used = [SourceLog(name=item.name, rows=len(item), sha256=log_sha256(item.log)) for item in rows]
    return {
        "name": common_name([log.name for log in logs]),
        "chemistry": options["chemistry"],
        "cells": cells,
        "capacity_ah": options["capacity_ah"],
        "rate_hz": options["rate_hz"],
        "temperature_source": logs[0].temperature_source,
        "range": ranges_of(rows),
        "made": Made(
            by=f"cangauge {__version__}",
            options=options,
            logs=used,
            fingerprint=text_sha256("".join(log.sha256 for log in used)),
        ),
    }


def _chemistry_of(
    logs: Sequence[Log],
    starts_pct: Sequence[float | None],
    stated: ChemistryName | None,
    cells: int | None,
    capacity_ah: float,
) -> tuple[ChemistryName, str | None]:
    """Return the chemistry, and what is to be said of it unless it was stated.

    It follows from the volts per cell where the number of cells is known, and is oxide otherwise.

    Raises
    ------
    InputError
        If no such cell has the volts per cell.
    """
    if cells is None:
        remark = (
            "Assuming an oxide chemistry. Pass --cells N: it detects the chemistry, and fixes the"
            " curve beyond the logs. Or pass --chemistry lfp."
        )
        return stated or "oxide", None if stated else remark
    volts, soc_pct = _mean_point(logs, starts_pct, capacity_ah)
    volts_per_cell = volts / cells
    unlikeness = {
        name: min(
            abs(volts_per_cell / float(np.interp(soc_pct, KNOTS_PCT, curve_v)) - 1.0)
            for curve_v in (typical.curve_v, typical.other_v)
        )
        for name, typical in CHEMISTRIES.items()
    }
    likeliest = min(unlikeness, key=unlikeness.__getitem__)
    name = likeliest if stated is None else stated
    if unlikeness[name] > CELLS_TOLERANCE:
        raise InputError(
            f"{cells} cells would have {volts_per_cell:.2f} V each at {soc_pct:.0f} % SoC, which no"
            f" {name} cell has",
            field="cells",
            value=cells,
            cure="check the number of cells in series, and the chemistry",
        )
    remark = f"chemistry {name} by {volts_per_cell:.2f} V per cell, of {cells} cells"
    return name, None if stated else remark


def _mean_point(
    logs: Sequence[Log], starts_pct: Sequence[float | None], capacity_ah: float
) -> tuple[float, float]:
    """Return mean voltage [V] and mean counted SoC [%] of some logs; about 50 % if unknown."""
    rows = sum(map(len, logs))
    total_v = sum(float(log.voltage_v.sum()) for log in logs)
    total_pct = 0.0
    for log, given_pct in zip(logs, starts_pct, strict=True):
        known = log if given_pct is None else with_start(log, given_pct)
        soc_pct = np.full(len(log), 50.0)
        if known.first_soc() is not None:
            soc_pct = np.clip(counted_soc_pct(known, capacity_ah), 0.0, 100.0)
        total_pct += float(soc_pct.sum())
    return total_v / rows, total_pct / rows


def ranges_of(rows: Sequence[FitRows]) -> Ranges:
    """Return the ranges of SoC, temperature, current and voltage of some logs' rows."""

    def span(name: str) -> tuple[float, float]:
        ends = [(values.min(), values.max()) for values in (getattr(each, name) for each in rows)]
        return float(min(low for low, _ in ends)), float(max(high for _, high in ends))

    return Ranges(**{name: span(name) for name in Ranges.model_fields})


ROWS_CHANNELS: Final = ("current_a", "voltage_v")
"""Channels that identify the rows of a log, whatever else a copy of it states."""


def log_sha256(
    log: Log, channels: Sequence[str] = ("time_s", "current_a", "voltage_v", "temperature_c")
) -> str:
    """Return the SHA-256 of a log's channels in hexadecimal."""
    digest = hashlib.sha256()
    for name in channels:
        digest.update(np.ascontiguousarray(getattr(log, name)).data)
    return digest.hexdigest()


def common_name(names: list[str]) -> str:
    """Return a name for several logs: what their names begin with, and their number.

    Examples
    --------
    >>> common_name(["TripA01", "TripA03", "TripA05"])
    'TripA (3 logs)'
    """
    if len(names) == 1:
        return names[0]
    # Less the digits of a number that differs.
    common = os.path.commonprefix(names).rstrip("0123456789").rstrip(" _-.,(")  # noqa: RUF071
    return f"{common} ({len(names)} logs)" if common else f"{names[0]} and {len(names) - 1} more"
