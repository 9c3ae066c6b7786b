"""Identification: recorded logs → model with its figures."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from cangauge._display import figure
from cangauge._formatting import counted, duration
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.assemble import (
    coefficient_names,
    common_name,
    common_temperature_source,
    information_of_rows,
    log_sha256,
    made_of,
    model_file_of,
    noise_of,
)
from cangauge.identify.effect_search import FittedEffects, fit_effects, parse_effect_ids
from cangauge.identify.evaluate import (
    Energy,
    LogFit,
    energy_balance,
    evaluate,
    evaluate_extended,
)
from cangauge.identify.log_errors import (
    HeldOut,
    LogFigures,
    errors_of_fit,
    held_out_error,
    slope_resistances,
    summed,
)
from cangauge.identify.passes import RowsFit, RowsOfLogs, fit_logs, fit_voltage_model
from cangauge.identify.starts import Start, find_starts, given_starts
from cangauge.inference.least_squares import Solution
from cangauge.inference.rows import (
    DELAYS_S,
    FitOptions,
    FitRows,
    SampledLog,
    row_blocks,
    sample_log,
    usable_delays,
)
from cangauge.logs.gaps import bridge_s, uncounted_gaps, usual_step_s
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import (
    capacity_from_full_discharge,
    difference_from_reference,
)
from cangauge.model.effects.library import effect_entries
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import (
    Information,
    Made,
    Model,
    SourceLog,
)
from cangauge.model.voltage_model import VoltageModel

_LOG = logging.getLogger(__name__)

SHRINKAGE_REMARK = 0.8
"""Shrinkage of kt by its prior below which a remark is added."""


@dataclass(frozen=True, eq=False)
class Identification:
    """A fitted model with its figures."""

    model: Model
    voltage_model: VoltageModel
    logs: tuple[Log, ...]
    figures: tuple[LogFigures, ...]
    """Of each log."""
    rows: Sequence[FitRows] = field(repr=False)
    """Rows of each log, made at each access."""
    held_out: tuple[HeldOut, ...] = field(repr=False)
    """Models that hold rows of each log out; () with effects."""
    solution: Solution
    energy: Energy
    slope_ohm: float
    """Regression of U − pseudo-OCV on the current, as a positive resistance [Ω]."""
    slope_expected_ohm: float
    """−(R1 + Σ Rj·ρj), ρj the current's autocorrelation at the delays [Ω]."""
    voltage_mae_pct: float
    voltage_rmse_v: float
    soc_newton_mae_pct: float
    remarks: tuple[str, ...] = ()
    effects: FittedEffects | None = None
    """Fitted effects; None if none were requested."""
    starts: tuple[Start, ...] = ()
    """SoC at the start of each log, and how it is known."""
    extended_fits: tuple[LogFit, ...] = field(default=(), repr=False)
    """`fits` of a model with effects."""

    @cached_property
    def fits(self) -> tuple[LogFit, ...]:
        """Model and measurement of each log, on the rows of the fit."""
        return self.extended_fits or tuple(evaluate(self.voltage_model, each) for each in self.rows)

    @cached_property
    def held_out_error_v(self) -> tuple[FloatArray, ...]:
        """Measured minus predicted voltage of each log's rows, by fits without the row [V].

        NaN where no fold holds the row out.
        """
        if self.effects is not None and self.extended_fits:
            return self.effects.held_out_error_v
        return tuple(map(held_out_error, self.rows, self.held_out))

    def plot(self) -> Any:
        """Return pseudo-OCV and residuals, for `bokeh.plotting.show`."""
        return figure("fit_figure", self)

    def to_dict(self) -> dict[str, object]:
        """Return the object that `cangauge fit --json` prints."""
        noise = self.model.noise
        return {
            "voltage_mae_pct": self.voltage_mae_pct,
            "voltage_rmse_v": self.voltage_rmse_v,
            "soc_newton_mae_pct": self.soc_newton_mae_pct,
            "capacity_ah": self.model.capacity_ah,
            "slope_ohm": self.slope_ohm,
            "slope_expected_ohm": self.slope_expected_ohm,
            "condition_number": self.solution.condition_number,
            "constrained": self.solution.constrained,
            "coefficients": {
                name: item.model_dump() for name, item in self.model.coefficients.items()
            },
            "energy": vars(self.energy),
            "held_out": {
                "voltage_mae_pct": noise.voltage_mae_pct,
                "voltage_rmse_v": noise.voltage_rmse_v,
                "judged_on": noise.judged_on,
            },
            "delays_s": list(self.model.delays_s),
            "rows": sum(item.rows for item in self.figures),
            "logs": [
                {
                    "name": item.name,
                    "rows": item.rows,
                    "voltage_mae_pct": item.voltage_mae_pct,
                    "soc_newton_mae_pct": item.soc_newton_mae_pct,
                    "removed": item.removed,
                    "initial_soc_pct": start.soc_pct,
                    "initial_soc_std_pct": start.std_pct,
                    "initial_soc_from": start.origin,
                }
                for item, start in zip(self.figures, self.starts, strict=True)
            ],
            "remarks": list(self.remarks),
        } | ({} if self.effects is None else self.effects.to_dict())


def fit(
    logs: Sequence[Log],
    *,
    capacity_ah: float | None = None,
    initial_soc_pct: float | Sequence[float | None] | None = None,
    rate_hz: float = 1.0,
    delay_s: Sequence[float] = DELAYS_S,
    epsilon: float = 0.05,
    t_ref_c: float = 20.0,
    effects: str | Sequence[str] = (),
    name: str | None = None,
) -> Identification:
    """Identify the model of a pack from one or more logs.

    Progress is logged to `cangauge.identify`: decisions at INFO, steps at DEBUG.

    Parameters
    ----------
    logs : sequence of Log
    capacity_ah : float, optional
        Charge from 100 to 0 % [Ah]; by default from a log that runs from full to empty.
    initial_soc_pct : float, or sequence of float or None, optional
        SoC at the first row [%], of all logs or of each; by default the log's reference SoC. Where
        neither is known it is estimated together with the curve, if another log pins it.
    rate_hz : float
        Rate of the fit and of the model [Hz]; logs are decimated to it.
    delay_s : sequence of float
        Delays of the current [s], increasing.
    epsilon : float
        Margin ε of the scaled SoC, in (0, 0.5).
    t_ref_c : float
        Reference temperature T_r [°C].
    effects : str or sequence of str
        Effect ids, or "auto": those that reduce the held-out error significantly.
    name : str, optional
        Name of the model; by default the common part of the logs' names.

    Returns
    -------
    Identification
        Its `model` can be saved, and used by `estimate` and `diagnose`.

    Raises
    ------
    InputError
        If the logs cannot identify the model: unknown capacity, too little SoC, a pseudo-OCV
        that does not rise, temperatures of different sources.

    Examples
    --------
    >>> found = fit([read_log("trip.csv")], capacity_ah=60.0, effects="auto")  # doctest: +SKIP
    >>> found.model.save("pack.json")  # doctest: +SKIP
    """
    effect_ids = parse_effect_ids([effects] if isinstance(effects, str) else effects)
    _check_logs(logs)
    given = given_starts(initial_soc_pct, len(logs))
    if capacity_ah is None:
        capacity_ah = capacity_from_full_discharge(logs, given)
    if not capacity_ah > 0.0:
        raise InputError(
            "the capacity must be positive", field="capacity_ah", value=capacity_ah,
            cure="check the sign of current: positive must discharge",
        )  # fmt: skip
    usable = usable_delays(logs, delay_s)
    options = FitOptions(capacity_ah, None, rate_hz, usable, epsilon, t_ref_c)
    found_starts = find_starts(logs, given, options)
    logs = found_starts.logs
    rows = RowsOfLogs(logs, options)
    found = None
    if effect_ids:
        # With effects, cross-validation tests kt too, so its tight prior is not used.
        plain, _ = fit_voltage_model(rows, options, with_kt_prior=False)
        sampled = [sample_log(log, options) for log in logs]
        found = fit_effects(ExtendedModel(plain, capacity_ah), sampled, effect_ids)
    if found is not None and found.model.effects:
        fitted, extended_fits = _with_effects(found, sampled, options)
    else:
        fitted, extended_fits = fit_logs(rows, options), ()
        if found_starts.std_error is not None:
            wider = np.maximum(fitted.solution.std_error, found_starts.std_error)
            fitted = replace(fitted, solution=replace(fitted.solution, std_error=wider))
    voltage_model, solution, sums = fitted.model, fitted.solution, fitted.errors.sums
    slope, expected = slope_resistances(fitted.errors, voltage_model.resistance_ohm)
    model = model_file_of(
        voltage_model,
        solution,
        options,
        name=name or common_name([log.name for log in logs]),
        temperature_source=logs[0].temperature_source,
        noise=noise_of(
            fitted.errors,
            voltage_model,
            rate_hz=rate_hz,
            mean_c=fitted.mean_c,
            spans=fitted.spans,
        ),
        effects=[] if found is None else effect_entries(found.model.effects),
        information=_information(fitted, options, found),
        made=_made(logs, options, effect_ids, fitted.figures, initial_soc_pct),
    )
    return Identification(
        model=model,
        voltage_model=voltage_model,
        logs=tuple(logs),
        figures=fitted.figures,
        rows=rows,
        held_out=fitted.held_out,
        solution=solution,
        energy=energy_balance(logs, slope),
        slope_ohm=slope,
        slope_expected_ohm=expected,
        voltage_mae_pct=sums["voltage_pct"] / sums["rows"],
        voltage_rmse_v=float(np.sqrt(sums["square_v2"] / sums["rows"])),
        soc_newton_mae_pct=sums["newton_pct"] / sums["rows"],
        remarks=(
            *_remarks(voltage_model, solution, fitted.figures),
            *_remarks_on_time(logs, delay_s, usable),
            *found_starts.remarks(),
            *(
                text
                for log in found_starts.pieces
                if (text := difference_from_reference(log, capacity_ah)) is not None
            ),
            *(found.remarks() if found is not None else ()),
        ),
        effects=found,
        starts=found_starts.starts,
        extended_fits=extended_fits,
    )


def _with_effects(
    found: FittedEffects, logs: Sequence[SampledLog], options: FitOptions
) -> tuple[RowsFit, tuple[LogFit, ...]]:
    """Return figures of a model with effects, and its fit of each log."""
    model = found.model.model
    fits = tuple(evaluate_extended(found.model, item) for item in logs)
    mean_c = float(np.mean(np.concatenate([item.rows.temperature_c for item in fits])))
    errors = [
        errors_of_fit(
            item.rows,
            ((item.part(block), error_v[block]) for block in row_blocks(len(item.rows))),
            model.resistance_ohm,
            options.rate_hz,
            mean_c=mean_c,
        )
        for item, error_v in zip(fits, found.held_out_error_v, strict=True)
    ]
    spans = [(np.ptp(item.rows.time_s), np.ptp(item.rows.soc_pct)) for item in fits]
    figures = tuple(
        LogFigures(item.rows.name, item.rows.removed, each.sums)
        for item, each in zip(fits, errors, strict=True)
    )
    fitted = RowsFit(
        model, found.solution, None, mean_c, np.mean(spans, axis=0), (), summed(errors), figures
    )
    return fitted, fits


def _check_logs(logs: Sequence[Log]) -> None:
    if not logs:
        raise InputError("no log given", cure="give at least one recorded log")
    for log in logs:
        if len(log) < 2:
            raise InputError(
                "a single row cannot identify a model",
                source=log.source or log.name,
                cure="give a log of minutes or hours",
            )
    by_sums: dict[tuple[float, ...], list[Log]] = {}
    for log in logs:
        sums = (float(len(log)), float(log.current_a.sum()), float(log.voltage_v.sum()))
        for other in by_sums.setdefault(sums, []):
            if _has_rows_of(log, other):
                raise InputError(
                    f"same rows as {other.source or other.name}: they would count twice",
                    source=log.source or log.name,
                    cure="give each log once",
                )
        by_sums[sums].append(log)
    common_temperature_source(log.temperature_source for log in logs)


def _has_rows_of(log: Log, other: Log) -> bool:
    """Return whether two logs have the same current and voltage."""
    same = np.array_equal
    return same(log.current_a, other.current_a) and same(log.voltage_v, other.voltage_v)


def _information(fitted: RowsFit, options: FitOptions, found: FittedEffects | None) -> Information:
    """Return the square root of the information of the rows on the coefficients."""
    names, prior = coefficient_names(options), fitted.solution.kt_prior
    if fitted.information is not None:
        root = fitted.information.root
        columns, volts = root[:, :-1], root[:, -1]
        effect_columns = np.empty((volts.size, 0))
    elif found is not None:
        n = len(names)
        columns, effect_columns = found.linear.columns[:, :n], found.linear.columns[:, n:]
        volts = found.linear.residual_v + columns @ found.linear.model.model.coefficients
    kt_weight = 0.0
    if prior is not None:
        kt_weight = prior.row_weight
    elif found is not None:
        kt_weight = found.linear.kt_weight
    return information_of_rows(columns, effect_columns, volts, names, kt_weight)


def _made(
    logs: Sequence[Log],
    options: FitOptions,
    effect_ids: Sequence[str],
    figures: Sequence[LogFigures],
    initial_soc_pct: float | Sequence[float | None] | None,
) -> Made:
    hashes = [log_sha256(log) for log in logs]
    listed = [
        SourceLog(name=log.name, rows=item.rows, sha256=digest)
        for log, item, digest in zip(logs, figures, hashes, strict=True)
    ]
    given = initial_soc_pct if isinstance(initial_soc_pct, float) else None
    effects = {"effects": ", ".join(effect_ids)} if effect_ids else {}
    return made_of(options, listed, hashes, initial_soc_pct=given, **effects)


def _remarks_on_time(
    logs: Sequence[Log], delay_s: Sequence[float], usable: Sequence[float]
) -> list[str]:
    remarks = []
    if len(usable) < len(delay_s):
        left_out = ", ".join(f"{delay:g}" for delay in delay_s if delay not in usable)
        step_s = min(usual_step_s(log.time_s) for log in logs)
        remarks.append(
            f"rows every {step_s:.3g} s do not resolve a delay of {left_out} s: left out"
        )
    for log in logs:
        gaps = uncounted_gaps(log.time_s)
        if gaps.size:
            longest = float(np.max(np.diff(log.time_s)[gaps]))
            remarks.append(
                f"{log.name}: {counted(gaps.size, 'gap')} of more than"
                f" {bridge_s(log.time_s):.0f} s, the longest {duration(longest)}: no charge is"
                " counted over them (a rest); split the log there if the pack was used"
            )
    return remarks


def _remarks(model: VoltageModel, solution: Solution, figures: Sequence[LogFigures]) -> list[str]:
    remarks = []
    lo, hi = model.soc_range_pct
    if hi - lo < 50.0:
        remarks.append(
            f"the logs cover {lo:.0f}–{hi:.0f} % SoC; outside, the pseudo-OCV is extrapolated"
            " linearly"
        )
    t_lo, t_hi = model.temperature_range_c
    prior = solution.kt_prior
    if prior is not None and prior.shrinkage < SHRINKAGE_REMARK:
        remarks.append(
            f"the logs ({t_lo:.1f} … {t_hi:.1f} °C) determine kt to ±{prior.data_std_v_per_k:.2g}"
            f" V/K only: it is {model.kt_v_per_k:.3f} V/K, held by its prior of"
            f" ±{prior.prior_std_v_per_k:.2g}; add a log at another temperature"
        )
    elif t_hi - t_lo < 3.0:
        remarks.append(
            f"the temperature varies by only {t_hi - t_lo:.1f} K: kt = {model.kt_v_per_k:.3f} V/K"
            " is hardly identified"
        )
    if solution.constrained:
        remarks.append("the pseudo-OCV of the plain fit would fall somewhere: constrained to rise")
    removed = sum(item.removed["start_up_or_shut_down"] for item in figures)
    if removed:
        remarks.append(f"{removed} start-up or shut-down rows removed")
    if any(resistance > 0.0 for resistance in model.resistance_ohm[:1]):
        remarks.append(
            "R1 is positive: the voltage rises under load, so the sign of current is likely"
            " inverted"
        )
    return remarks
