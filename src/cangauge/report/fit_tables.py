"""The tables of an identification's report."""

from __future__ import annotations

import math

import numpy as np

from cangauge.identify.fit import Identification
from cangauge.model.effects.library import LIBRARY
from cangauge.report.effect_rows import effect_rows, step_rows
from cangauge.report.page import Block, Table
from cangauge.report.words import duration, number, significant, span

UNITS = {"V": "V", "V/K": "V/K", "ohm": "Ω"}

RULES = {
    "decimation": "not on the model's rate (decimation)",
    "start_up_or_shut_down": "low voltage at start-up or shut-down, and 2 s around it",
    "delay_line_filling": "delay line not yet full, at the start or after a gap",
}


def coefficient_table(result: Identification) -> Table:
    """Return the coefficients with standard errors and units."""
    rows = []
    for name, item in result.model.coefficients.items():
        error = item.std_error
        ratio = abs(item.value) / error if error else math.nan
        rows.append(
            [
                name,
                significant(item.value, 5),
                significant(error, 2),
                number(ratio, 1),
                UNITS[item.unit],
                _meaning(name, result),
            ]
        )
    held = (
        " The bounds that keep the pseudo-OCV rising were active; standard errors are those of the"
        " plain fit's directions."
        if result.solution.constrained
        else ""
    )
    return Table(
        ["coefficient", "value", "std. error", "|value| / error", "unit", "what it multiplies"],
        rows,
        "U = k0 + k1/s + k2/s² + k3/s³ + k4/s⁴ + k5·s + k6·ln s + k7·ln(1 − s) + kt·(T − Tr)"
        " + Σ Rj·I(t − dj),  s = S/100·(1 − 2ε) + ε. Standard errors allow for residuals that are"
        " correlated within 300 s. k0 … k7 lean on each other (condition number"
        f" {significant(result.solution.condition_number, 2)}): trust their sum, the curve, not"
        f" each of them.{held}",
    )


def _meaning(name: str, result: Identification) -> str:
    basis = {
        "k0": "1", "k1": "1/s", "k2": "1/s²", "k3": "1/s³", "k4": "1/s⁴", "k5": "s",
        "k6": "ln s", "k7": "ln(1 − s)", "kt": f"T − {result.model.t_ref_c:g} °C",
    }  # fmt: skip
    if name in basis:
        return basis[name]
    delay = result.model.delays_s[int(name.removeprefix("R")) - 1]
    return "current" if delay == 0.0 else f"current {delay:g} s ago"


def effect_tables(result: Identification) -> list[Block]:
    """Return the effects with their parameters, and how they were found."""
    found = result.found
    if found is None:
        return []
    ids = dict.fromkeys(effect_id for effect_id, _ in found.estimates)
    equations = "; ".join(f"{effect_id}: {LIBRARY[effect_id].equation}" for effect_id in ids)
    before, after = found.held_out_rmse_v
    headings, rows = effect_rows(found)
    tried, steps = step_rows(found)
    return [
        Table(
            _plain(headings),
            rows,
            f"{equations}. Names are signatures at the terminals, not proof of a mechanism."
            if ids
            else "The logs show none by more than chance.",
        ),
        Table(
            _plain(tried),
            steps,
            f"Root mean square error on data left out: {significant(before, 4)} V without effects,"
            f" {significant(after, 4)} V with those above. One is taken if the mean logarithm of"
            " the ratio of errors, log by log, lies so many standard errors (t) above zero as"
            " chance seldom reaches (within the logs half as many), and if the error falls by 1 %."
            " Which effects to take was chosen on the same data that judge them, so the last figure"
            " is a little too good.",
        ),
    ]


def _plain(headings: list[str]) -> list[str]:
    return [heading.removeprefix("<") for heading in headings]


def error_table(result: Identification) -> Table:
    """Return the voltage error, in the fit and held out, and how it splits in time."""
    noise = result.model.noise
    residual = np.concatenate([item.residual_v for item in result.fits])
    return Table(
        ["voltage error", "value", "unit", "what it is"],
        [
            ["MAE of the fit", number(result.voltage_mae_pct), "%", "relative to the voltage"],
            ["RMSE of the fit", significant(result.voltage_rmse_v, 3), "V", ""],
            ["largest of the fit", significant(float(np.abs(residual).max()), 3), "V", ""],
            ["MAE held out", number(noise.voltage_mae_pct), "%", noise.judged_on],
            ["RMSE held out", significant(noise.voltage_rmse_v, 3), "V", noise.judged_on],
            ["fast part (σ)", significant(noise.fast_std_v, 3), "V",
             f"lasts {number(noise.fast_time_s, 1, 's')}: averages out"],
            ["slow part (σ)", significant(noise.slow_std_v, 3), "V",
             f"lasts {number(noise.slow_time_s, 0, 's')}: averages out over far longer times"],
            ["lasting part (σ)", significant(noise.lasting_std_v, 3), "V",
             "stays for a whole log: does not average out"],
        ],
        "The split is fitted to the error's autocovariance; its parts need not add up to the RMSE,"
        " and the filter takes its σ from them.",
    )  # fmt: skip


def energy_table(result: Identification) -> Table:
    """Return the energy balance."""
    energy = result.energy
    share = _share(energy.regenerated_kwh, energy.driven_kwh)
    lost = _share(energy.heat_kwh, energy.net_kwh)
    return Table(
        ["energy", "kWh", "", ""],
        [
            ["driven", significant(energy.driven_kwh, 4), "", "∫U·I over I > 0"],
            [
                "regenerated",
                significant(energy.regenerated_kwh, 4),
                share,
                "of driven; over I < 0",
            ],
            ["net", significant(energy.net_kwh, 4), "", "driven − regenerated"],
            ["Joule heat", significant(energy.heat_kwh, 4), lost, "of net; slope resistance × ∫I²"],
            ["efficiency", "", number(energy.efficiency_pct, 1, "%"), "net / (net + heat)"],
        ],
    )


def log_table(result: Identification) -> Table:
    """Return one row for each log."""
    rows = []
    for log, item, held_out in zip(result.logs, result.fits, result.held_out_error_v, strict=True):
        judged = np.isfinite(held_out)
        relative = np.abs(held_out[judged]) / item.rows.voltage_v[judged]
        rows.append(
            [
                log.name,
                duration(log.duration_s),
                str(len(log)),
                str(len(item.rows)),
                span(item.rows.soc_pct.max(), item.rows.soc_pct.min(), 1),
                span(log.temperature_c.min(), log.temperature_c.max(), 1),
                span(log.current_a.min(), log.current_a.max(), 0),
                number(item.voltage_mae_pct),
                number(100.0 * float(relative.mean()) if judged.any() else None),
                number(item.soc_newton_mae_pct, 2),
            ]
        )
    return Table(
        [
            "log", "duration", "rows", "rows used", "SoC [%]", "temperature [°C]", "current [A]",
            "U MAE [%]", "U MAE held out [%]", "SoC by inverse MAE [%]",
        ],
        rows,
    )  # fmt: skip


def removed_table(result: Identification) -> Table:
    """Return how many rows each rule removed."""
    totals: dict[str, int] = {}
    for item in result.fits:
        for rule, count in item.rows.removed.items():
            totals[rule] = totals.get(rule, 0) + count
    rows = [[RULES.get(rule, rule), str(count)] for rule, count in totals.items()]
    rows.append(["used", str(sum(len(item.rows) for item in result.fits))])
    return Table(["rows", "count"], rows)


def settings_table(result: Identification) -> Table:
    """Return the options and ranges of the model."""
    model = result.model
    return Table(
        ["model", ""],
        [
            ["capacity", number(model.capacity_ah, 3, "Ah")],
            ["delays", ", ".join(f"{delay:g}" for delay in model.delays_s) + " s"],
            ["rate", f"{model.rate_hz:g} Hz"],
            ["ε", f"{model.epsilon:g}"],
            ["Tr", f"{model.t_ref_c:g} °C"],
            ["temperature measured on", model.temperature_source],
            ["identified over SoC", span(*model.range.soc_pct, 1, "%")],
            ["identified over temperature", span(*model.range.temperature_c, 1, "°C")],
            ["identified over current", span(*model.range.current_a, 1, "A")],
            ["condition number", significant(result.solution.condition_number, 2)],
            ["pseudo-OCV held to rise", "yes" if result.solution.constrained else "not needed"],
            ["made by", model.made.by],
            ["fingerprint of the logs", model.made.fingerprint[:16]],
        ],
    )


def _share(part: float, whole: float) -> str:
    return number(100.0 * part / whole if whole else None, 1, "%")
