"""Identification: recorded logs → model with its figures."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from cangauge._files import text_sha256
from cangauge._typing import FloatArray
from cangauge._version import __version__
from cangauge.errors import InputError, require_choice, require_number
from cangauge.identify.effect_search import (
    AUTO,
    AUTO_LOGS,
    Search,
    Selected,
    linearize,
    parse_effect_ids,
)
from cangauge.identify.identification import (
    Identification,
    energy_balance,
    evaluate,
    remarks_on_effects,
    remarks_on_logs,
    slope_resistances,
)
from cangauge.identify.least_squares import (
    BASE,
    LOGS_AT_LEAST,
    LogSums,
    N,
    P,
    Solution,
    log_sums,
    row_features,
    solve_scaled,
)
from cangauge.identify.published import (
    PublishedFit,
    factor_of,
    pooled,
    published_columns,
    solve_published,
)
from cangauge.identify.rows import LEAST_ROWS, FitRows, fit_rows, usable_delays
from cangauge.identify.starts import find_starts, given_starts, with_start
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log, TemperatureSource, as_log
from cangauge.model.coulomb_counting import (
    capacity_from_full_discharge,
    capacity_from_reference,
)
from cangauge.model.effects.base import Effect, Values
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import (
    Information,
    Made,
    Model,
    Ranges,
    SourceLog,
    function_fields,
    knots_model,
    noise_of,
)
from cangauge.model.prior import (
    CHEMISTRIES,
    DELAYS_S,
    Chemistry,
    ChemistryName,
    usual_loads,
)
from cangauge.model.voltage_model import KNOTS_PCT, REFERENCE_C, PublishedCurve

_LOG = logging.getLogger(__name__)

Equation = Literal["knots", "published"]

EPSILON: Final = PublishedCurve.epsilon
"""Published margin of the scaled SoC [-]."""

FITTED_ROWS: Final = "the rows of the fit itself (too few logs to leave one out)"
WHOLE_LOGS: Final = "whole logs left out in turn"

FROM_SOC: Final = "from-soc"

LISTED_LOGS: Final = 4096
"""Source logs that a model file lists; of more, only its name holds the number."""


def fit(
    logs: Any,
    *,
    capacity_ah: float | Literal["from-soc"] | None = None,
    initial_soc_pct: float | Sequence[float | None] | None = None,
    equation: Equation = "knots",
    chemistry: ChemistryName | None = None,
    cells: int | None = None,
    rate_hz: float = 1.0,
    delay_s: Sequence[float] = DELAYS_S,
    epsilon: float = EPSILON,
    t_ref_c: float = REFERENCE_C,
    effects: str | Sequence[str] | None = None,
) -> Identification:
    """Identify the model of a pack from one or more logs.

    Progress is logged to `cangauge.identify`: decisions at INFO, steps at DEBUG.

    Parameters
    ----------
    logs : Log, path or DataFrame, or a sequence of them
    capacity_ah : float or "from-soc", optional
        Charge from 100 to 0 % [Ah]; "from-soc": the charge per 100 % of the logs' own SoC; by
        default from a log that runs from full to empty.
    initial_soc_pct : float, or sequence of float or None, optional
        SoC at the first row [%], of all logs or of each; by default the log's reference SoC. Where
        neither is known it is estimated together with the curve, if another log pins it.
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
        Effect ids; "auto": those that reduce the error of left-out logs significantly; "none". By
        default auto from five logs on. Only for knots.

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
    require_choice(equation, get_args(Equation), "equation")
    require_choice(chemistry, (*CHEMISTRIES, None), "chemistry")
    if capacity_ah not in (None, FROM_SOC):
        require_number(capacity_ah, "capacity_ah")
    recorded = [as_log(log) for log in (logs if isinstance(logs, list | tuple) else [logs])]
    _check_logs(recorded)
    given = given_starts(initial_soc_pct, len(recorded))
    if capacity_ah is None:
        capacity_ah = capacity_from_full_discharge(recorded, given)
    elif isinstance(capacity_ah, str):
        capacity_ah = capacity_from_reference(recorded)
    if not capacity_ah > 0.0:
        raise InputError(
            "the capacity must be positive", field="capacity_ah", value=capacity_ah,
            cure="check the sign of current: positive must discharge",
        )  # fmt: skip
    ids = _effect_ids(effects, equation, len(recorded))
    stated = [
        log if value is None else with_start(log, value)
        for log, value in zip(recorded, given, strict=True)
    ]
    known, said = resolve_chemistry(stated, chemistry, cells, capacity_ah)
    with threadpool_limits(limits=1):  # 40 columns: threads only wait for each other
        starts = find_starts(recorded, given, capacity_ah, known)
        knots = equation == "knots"
        delays = DELAYS_S if knots else usable_delays(starts.logs, delay_s)
        rows = [fit_rows(log, capacity_ah, rate_hz=rate_hz, delay_s=delays) for log in starts.logs]
        if (number := sum(map(len, rows))) < LEAST_ROWS:
            raise InputError(
                f"only {number} rows can be used, and a fit needs {LEAST_ROWS}",
                source=recorded[0].source or recorded[0].name,
                cure="give logs of drives over some hours and much of the SoC; `cangauge inspect`"
                " lists what a log can identify",
            )
        options = {
            "capacity_ah": capacity_ah,
            "rate_hz": rate_hz,
            "chemistry": known.name,
            "equation": equation,
            "initial_soc_pct": given[0] if len({*given}) == 1 else None,
            "effects": ", ".join(ids) or None,
        }
        fields: dict[str, Any] = {
            "name": common_name([log.name for log in recorded]),
            "chemistry": known.name,
            "cells": cells,
            "capacity_ah": capacity_ah,
            "rate_hz": rate_hz,
            "temperature_source": recorded[0].temperature_source,
            "range": ranges_of(rows),
            "made": made_of(starts.logs, rows, options),
        }
        if knots:
            found = _fit_knots(starts.logs, rows, known, ids, fields)
        else:
            equation_of = (epsilon, t_ref_c, tuple(delays))
            found = _fit_published(rows, known, equation_of, fields)
        model = found.model
        extended = model.extended_model()
        fits = tuple(
            evaluate(extended, log, of_log) for log, of_log in zip(starts.logs, rows, strict=True)
        )
    slope, expected = slope_resistances(fits, extended.model.resistance_ohm)
    return Identification(
        model=model,
        logs=starts.logs,
        fits=fits,
        held_out_error_v=found.held_out_error_v,
        published=found.published,
        energy=energy_balance(starts.logs, slope),
        slope_ohm=slope,
        slope_expected_ohm=expected,
        remarks=(
            *said,
            *remarks_on_logs(rows, starts, recorded, delay_s, capacity_ah),
            *remarks_on_effects(found.effects, model),
        ),
        effects=found.effects,
        starts=starts.starts,
    )


def _effect_ids(
    effects: str | Sequence[str] | None, equation: Equation, logs: int
) -> tuple[str, ...]:
    if effects is None:
        return (AUTO,) if equation == "knots" and logs >= AUTO_LOGS else ()
    ids = parse_effect_ids([effects] if isinstance(effects, str) else effects) if effects else ()
    if ids and equation == "published":
        raise InputError(
            "the published equation is fitted without effects",
            field="--effects",
            value=", ".join(ids),
            cure="leave out --equation published",
        )
    return ids


def resolve_chemistry(
    logs: Sequence[Log], chemistry: ChemistryName | None, cells: int | None, capacity_ah: float
) -> tuple[Chemistry, list[str]]:
    """Return the chemistry, and what is to be said about how it is known.

    Parameters
    ----------
    logs : sequence of Log
    chemistry : {"oxide", "lfp"}, optional
    cells : int, optional
        Cells in series.
    capacity_ah : float
        [Ah].
    """
    if chemistry is not None:
        return CHEMISTRIES[chemistry], []
    if cells is None:
        return CHEMISTRIES["oxide"], [
            "chemistry taken as oxide: say lfp for iron phosphate, or give the number of cells, and"
            " the volts per cell tell"
        ]
    volts = float(np.mean(np.concatenate([log.voltage_v for log in logs]))) / cells
    middles = []
    for log in logs:
        out_pct = 100.0 * discharged_ah(log.time_s, log.current_a) / capacity_ah
        row, start_pct = log.first_soc() or (0, 50.0 + float(out_pct.mean()))
        middles.append(np.clip(start_pct + out_pct[row] - out_pct, 0.0, 100.0))
    middle = float(np.mean(np.concatenate(middles)))

    def distance_v(name: ChemistryName) -> float:
        return abs(volts - float(np.interp(middle, KNOTS_PCT, CHEMISTRIES[name].curve_v)))

    name = min(CHEMISTRIES, key=distance_v)
    return CHEMISTRIES[name], [f"chemistry {name} by {volts:.2f} V per cell, of {cells} cells"]


@dataclass(frozen=True, eq=False)
class _Fitted:
    model: Model
    published: PublishedFit
    held_out_error_v: tuple[FloatArray, ...]
    effects: Selected | None


@dataclass(frozen=True, eq=False)
class _Joint:
    """Curve of knots, and effects if any, of some logs together and with each left out."""

    rows: Sequence[FitRows]
    columns: Sequence[FloatArray]
    """Of the moments, on the rows of each log."""
    solution: Solution
    without: Sequence[Solution]
    effects: tuple[tuple[Effect, Values], ...] = ()

    def held_out_error_v(self) -> tuple[FloatArray, ...]:
        """Return the errors of each log by the others [V]; () for too few logs."""
        return tuple(
            _where_covered(
                number,
                self.rows,
                other.residual_v_of(self.columns[number], self.rows[number].voltage_v),
            )
            for number, other in enumerate(self.without)
        )


def _fit_knots(
    logs: Sequence[Log],
    rows: Sequence[FitRows],
    chemistry: Chemistry,
    effect_ids: Sequence[str],
    fields: dict[str, Any],
) -> _Fitted:
    factors = [factor_of(item, len(DELAYS_S), EPSILON, REFERENCE_C) for item in rows]
    published = solve_published(pooled(factors), EPSILON)
    if usable_delays(logs, DELAYS_S) == DELAYS_S and published.identified:
        fields = fields | {"published": published.fields(EPSILON, REFERENCE_C, DELAYS_S)}
    sums = [log_sums(item, chemistry) for item in rows]
    solved = solve_scaled(sums, fields["capacity_ah"], chemistry)
    joint = _Joint(rows, [row_features(item) for item in rows], *solved)
    selected: Selected | None = None
    if effect_ids:
        plain = knots_file(joint.solution, chemistry, fields).extended_model()
        search = Search(plain, logs, rows, chemistry, effect_ids)
        while (selected := search.select()).chosen:
            with_effects = _with_effects(joint, selected, logs, chemistry, fields)
            at_bound = selected.at_bound(with_effects.solution)
            if not at_bound:
                joint = with_effects
                break
            search.refused += at_bound
    fields = fields | {"effects": effect_entries(joint.effects)}
    errors = joint.held_out_error_v()
    model = knots_file(joint.solution, chemistry, fields, errors, joint.rows)
    return _Fitted(model, published, errors, selected)


RELINEARIZED: Final = 4
"""Linearizations about the fitted effects: products of effects and resistances have converged."""


def _with_effects(
    plain: _Joint,
    selected: Selected,
    logs: Sequence[Log],
    chemistry: Chemistry,
    fields: dict[str, Any],
) -> _Joint:
    """Return the fit with the selected effects: Gauss–Newton from `plain`, without effects."""
    capacity_ah = fields["capacity_ah"]
    solution, std = plain.solution, selected.amplitude_std
    extended = knots_file(solution, chemistry, fields).extended_model()
    amplitudes: FloatArray | None = None
    for _ in range(RELINEARIZED):
        coefficients = solution.select[:P, :BASE].T @ solution.coefficients[:P]
        about = [
            linearize(extended, log, item, selected.chosen, amplitudes).with_voltage(
                coefficients, np.zeros(std.size) if amplitudes is None else amplitudes
            )
            for log, item in zip(logs, plain.rows, strict=True)
        ]
        sums = [log_sums(item.rows, chemistry, item.columns, item.features) for item in about]
        solution, without = solve_scaled(sums, capacity_ah, chemistry, std)
        solution = selected.clipped(solution)
        amplitudes = solution.coefficients[P:]
        effects = selected.effects(solution)
        voltage = knots_file(solution, chemistry, fields).voltage_model()
        extended = ExtendedModel(voltage, capacity_ah, effects)
    columns = [np.column_stack([item.features, item.columns]) for item in about]
    return _Joint([item.rows for item in about], columns, solution, without, effects)


def _where_covered(number: int, rows: Sequence[FitRows], error_v: FloatArray) -> FloatArray:
    """Return the errors of a log, NaN where the other logs have no SoC."""
    others = [item.soc_pct for k, item in enumerate(rows) if k != number]
    low = min(float(soc.min()) for soc in others)
    high = max(float(soc.max()) for soc in others)
    soc = rows[number].soc_pct
    return np.where((soc >= low) & (soc <= high), error_v, np.nan)


def knots_file(
    solution: Solution,
    chemistry: Chemistry,
    fields: dict[str, Any],
    held_out_error_v: Sequence[FloatArray] = (),
    rows: Sequence[FitRows] = (),
) -> Model:
    """Return the model file of a solution.

    Parameters
    ----------
    solution : Solution
        Its covariance and scale are final.
    chemistry : Chemistry
    fields : dict
        The other fields of `Model`.
    held_out_error_v : sequence of array
        Errors of left-out logs [V].
    rows : sequence of FitRows
        Of the same logs.
    """
    noise = noise_of(
        chemistry,
        solution.mean_v,
        solution.residual_v,
        scale=solution.scale,
        **_judged(held_out_error_v, rows, solution.residual_v, solution.mean_v),
    )
    return knots_model(
        solution.coefficients[:P],
        solution.covariance[:P, :P],
        arrhenius_ohm=solution.arrhenius_ohm,
        mean_c=solution.mean_c,
        noise=noise,
        information=_information(solution),
        **fields,
    )


def model_rmse(solutions: Sequence[Solution], sums: Sequence[LogSums]) -> float:
    """Return the rms error of logs [V], each by a solution, weighted by their time."""
    weight = sum(item.weight for item in sums)
    pairs = zip(solutions, sums, strict=True)
    square = sum(a.square_error(item) * item.weight for a, item in pairs)
    return float((square / weight) ** 0.5)


def _judged(
    held_out_error_v: Sequence[FloatArray],
    rows: Sequence[FitRows],
    residual_v: float,
    mean_v: float,
) -> dict[str, Any]:
    error_v = np.concatenate([*held_out_error_v, np.empty(0)])
    if not np.isfinite(error_v).any():
        return {
            "voltage_mae_pct": 100.0 * (2.0 / np.pi) ** 0.5 * residual_v / mean_v,
            "voltage_rmse_v": residual_v,
            "judged_on": FITTED_ROWS,
        }
    volts = np.concatenate([item.voltage_v for item in rows])
    return {
        "voltage_mae_pct": 100.0 * float(np.nanmean(np.abs(error_v) / volts)),
        "voltage_rmse_v": float(np.sqrt(np.nanmean(error_v**2))),
        "judged_on": WHOLE_LOGS,
    }


def _information(solution: Solution) -> Information:
    """Return the posterior of all coefficients as square root of its precision."""
    root = np.linalg.cholesky(np.linalg.inv(solution.covariance)).T
    names = [f"knot_{soc:g}" for soc in KNOTS_PCT.tolist()]
    names += ["kt", *(f"R{k}" for k in range(1, P - N - 1)), "b"]
    names += [f"amplitude_{k}" for k in range(1, solution.coefficients.size - P + 1)]
    return Information(
        columns=names,
        root=np.triu(root).tolist(),
        projected=(root @ solution.coefficients).tolist(),
    )


def _fit_published(
    rows: Sequence[FitRows],
    chemistry: Chemistry,
    equation: tuple[float, float, tuple[float, ...]],
    fields: dict[str, Any],
) -> _Fitted:
    epsilon, t_ref_c, delays = equation
    factors = [factor_of(item, len(delays), epsilon, t_ref_c) for item in rows]
    published = solve_published(pooled(factors), epsilon)
    if not published.identified:
        raise InputError(
            "the logs do not identify the published equation: too little SoC, too few rows, or a"
            " pseudo-OCV that falls with SoC",
            field="equation",
            value="published",
            cure="leave out --equation published, or give logs over more SoC",
        )
    volts = np.concatenate([item.voltage_v for item in rows])
    mean_v = float(volts.mean())
    errors: tuple[FloatArray, ...] = ()
    if len(rows) >= LOGS_AT_LEAST:
        errors = tuple(
            _where_covered(number, rows, item.voltage_v - columns @ other.coefficients)
            for number, item in enumerate(rows)
            for columns in (published_columns(item, len(delays), epsilon, t_ref_c),)
            for other in (
                solve_published(pooled(factors[:number] + factors[number + 1 :]), epsilon),
            )
        )
    jacobian = published.jacobian(epsilon)
    model = Model(
        equation="published",
        published=published.fields(epsilon, t_ref_c, delays),
        functions=function_fields(
            jacobian @ published.covariance @ jacobian.T,
            usual_loads(fields["capacity_ah"], len(delays)),
        ),
        noise=noise_of(
            chemistry, mean_v, published.residual_v,
            **_judged(errors, rows, published.residual_v, mean_v),
        ),
        **fields,
    )  # fmt: skip
    return _Fitted(model, published, errors, None)


def _check_logs(logs: Sequence[Log]) -> None:
    if not logs:
        raise InputError("no log given", cure="give at least one recorded log")
    first: dict[str, Log] = {}
    for log in logs:
        if len(log) < 2:
            raise InputError(
                "a single row cannot identify a model",
                source=log.source or log.name,
                cure="give a log of minutes or hours",
            )
        other = first.setdefault(signals_sha256(log), log)
        if other is not log:
            raise InputError(
                f"same rows as {other.source or other.name}: they would count twice",
                source=log.source or log.name,
                cure="give each log once",
            )
    common_temperature_source(log.temperature_source for log in logs)


def common_temperature_source(sources: Iterable[TemperatureSource]) -> TemperatureSource:
    """Return the source of all logs' temperatures; raise InputError if they differ."""
    found = sorted(set(sources))
    if len(found) > 1:
        raise InputError(
            "the temperatures of the logs have different sources",
            field="temperature_source",
            value=found,
            cure="state it in a column temperature_source of the logs that do not, or fit logs of"
            " one source together",
        )
    return found[0]


def ranges_of(rows: Sequence[FitRows]) -> Ranges:
    """Return the ranges of SoC, temperature and current of some logs' rows."""

    def span(values: Iterable[FloatArray]) -> tuple[float, float]:
        ends = [(float(item.min()), float(item.max())) for item in values]
        return min(low for low, _ in ends), max(high for _, high in ends)

    return Ranges(
        soc_pct=span(item.soc_pct for item in rows),
        temperature_c=span(item.temperature_c for item in rows),
        current_a=span(item.currents_a[:, 0] for item in rows),
        voltage_v=span(item.voltage_v for item in rows),
    )


def made_of(logs: Sequence[Log], rows: Sequence[FitRows], options: dict[str, Any]) -> Made:
    """Return how a model file was made."""
    hashes = [log_sha256(log) for log in logs]
    listed = [
        SourceLog(name=log.name, rows=len(item), sha256=digest)
        for log, item, digest in zip(logs, rows, hashes, strict=True)
    ]
    return Made(
        by=f"cangauge {__version__}",
        options=options,
        logs=listed[:LISTED_LOGS],
        fingerprint=text_sha256("".join(hashes)),
    )


def signals_sha256(log: Log) -> str:
    """Return what identifies the rows of a log: the SHA-256 of its current and voltage."""
    return _sha256(log.current_a, log.voltage_v)


def log_sha256(log: Log) -> str:
    """Return the SHA-256 of a log's channels in hexadecimal."""
    return _sha256(log.time_s, log.current_a, log.voltage_v, log.temperature_c)


def _sha256(*channels: FloatArray) -> str:
    digest = hashlib.sha256()
    for channel in channels:
        digest.update(np.ascontiguousarray(channel).data)
    return digest.hexdigest()


def common_name(names: Sequence[str]) -> str:
    """Return a name for several logs: their common prefix and their number.

    Examples
    --------
    >>> common_name(["TripA01", "TripA03", "TripA05"])
    'TripA (3 logs)'
    """
    if len(names) == 1:
        return names[0]
    prefix = os.path.commonprefix(list(names))  # noqa: RUF071 - of strings, not of paths
    if any(name[len(prefix) : len(prefix) + 1].isdigit() for name in names):
        prefix = prefix.rstrip("0123456789")  # of a number that differs
    prefix = prefix.rstrip(" _-.,(")
    if not prefix:
        return f"{names[0]} and {len(names) - 1} more"
    return f"{prefix} ({len(names)} logs)"
