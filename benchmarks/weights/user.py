"""What a user sees: faults in two recorded trips, and wrong models beside healthy logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.weights import packs
from rich.table import Table

from cangauge.bus.recording import read_log
from cangauge.diagnosis import Diagnosis, diagnose, learn_references
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

LOGS = (15, 17)
REFERENCES = (1, 3, 5, 7, 9, 11, 13, 19, 2, 4, 6, 8)
"""Summer trips: diagnosed, and without a fault."""


def _started(log: Log, change_pct: float = 0.0) -> Log:
    row, start_pct = log.first_soc()
    soc = np.full(len(log), np.nan)
    soc[row] = start_pct + change_pct
    return replace(log, soc_pct=soc)


def _late(log: Log) -> Log:
    return replace(log, current_a=np.interp(log.time_s - 0.5, log.time_s, log.current_a))


def _less_capacity(log: Log, model: Model) -> Log:
    """Return the log of a pack with 8 % less capacity under the same current."""
    log = _started(log)
    smaller = model.model_copy(update={"capacity_ah": 0.92 * model.capacity_ah})
    change_v = smaller.predict(log).voltage_v - model.predict(log).voltage_v
    return replace(log, voltage_v=log.voltage_v + change_v)


CELLS: dict[str, tuple[str, Callable[[Log, Model], Log]]] = {
    "voltage × 1.02": ("voltage_reading", lambda x, _: replace(x, voltage_v=1.02 * x.voltage_v)),
    "voltage + 3 V": ("voltage_reading", lambda x, _: replace(x, voltage_v=x.voltage_v + 3.0)),
    "current + 3 A": ("current_reading", lambda x, _: replace(x, current_a=x.current_a + 3.0)),
    "current × 1.05": ("current_reading", lambda x, _: replace(x, current_a=1.05 * x.current_a)),
    "temperature + 8 K": (
        "temperature", lambda x, _: replace(x, temperature_c=x.temperature_c + 8.0),
    ),
    "current 0.5 s late": ("clock", lambda x, _: _late(x)),
    "resistance + 0.03 Ω": (
        "resistance", lambda x, _: replace(x, voltage_v=x.voltage_v - 0.03 * x.current_a),
    ),
    "capacity − 8 %": ("capacity", _less_capacity),
    "initial SoC + 12 %": ("start", lambda x, _: _started(x, 12.0)),
}  # fmt: skip
"""What is done to both trips → the fault."""


def _trip(data: Path, number: int) -> Log:
    return read_log(data / "bmw_i3" / f"TripA{number:02d}.csv.gz")


def trips(data: Path) -> Table:
    """Return what is stated of two trips with six and with twelve references."""
    every = [_trip(data, number) for number in REFERENCES]
    columns = {}
    for count in (6, 12):
        references = every[:count]
        model = fit(references, capacity_ah=packs.I3_AH).model
        healthy = learn_references(references, model)
        for name, (_, change) in CELLS.items():
            logs = [change(_trip(data, number), model) for number in LOGS]
            columns[name, count] = diagnose(logs, model, healthy)
    table = Table("injected into both trips", "6 references", "12 references")
    for name, (fault, _) in CELLS.items():
        table.add_row(name, *(_said(columns[name, count], fault) for count in (6, 12)))
    return table


def _said(found: Diagnosis, fault: str) -> str:
    """Return the faults stated with their probability, and whether one is right."""
    stated, p = found.posterior.stated, found.posterior.faults
    if not stated:
        return f"none (P(no fault) {found.posterior.none:.0%})"
    text = " or ".join(f"{name.replace('_', ' ')} {p[name]:.0%}" for name in stated)
    if len(stated) > 1:
        return text
    return f"{text}: {'right' if stated == (fault,) else 'wrong'}"


def _wrong_models(model: Model) -> dict[str, Model]:
    loads, curve = model.loads, model.curve
    tripled = [3.0 * ohm for ohm in loads.resistance_ohm]
    three = [3.0 * ohm for ohm in loads.arrhenius.resistance_ohm]
    scaled = loads.arrhenius.model_copy(update={"resistance_ohm": tuple(three)})
    flat = loads.arrhenius.model_copy(update={"factor": 0.0})
    higher = [volts + 8.0 for volts in curve.voltage_v]
    three_times = {
        "loads": loads.model_copy(update={"resistance_ohm": tuple(tripled), "arrhenius": scaled})
    }
    eight_volts = {"curve": curve.model_copy(update={"voltage_v": tuple(higher)})}
    return {
        "as fitted": model,
        "resistances × 3": model.model_copy(update=three_times),
        "curve + 8 V": model.model_copy(update=eight_volts),
        "resistances × 3, curve + 8 V": model.model_copy(update=three_times | eight_volts),
        "without R(T)": model.model_copy(
            update={"loads": loads.model_copy(update={"arrhenius": flat})}),
        "capacity × 1.25": model.model_copy(update={"capacity_ah": 1.25 * model.capacity_ah}),
    }  # fmt: skip


def models(data: Path) -> Table:
    """Return what is said of wrong models beside healthy logs of three packs."""
    table = Table(
        "pack", "model", "error [V]", "expected error [V]", "corrected error [V]", "found"
    )
    recorded = {x.name: x for part in packs.PARTS for x in packs.recorded(data, part)}
    for name in ("i3", "car1", "lg_cold"):
        pack = recorded[name]
        logs, references = pack.logs[:1], pack.logs[1:9]
        model = fit(references, capacity_ah=pack.capacity_ah).model
        for label, wrong in _wrong_models(model).items():
            check = diagnose(logs, wrong, references).model_check
            missed = "; ".join(
                f"{each.evidence.shape.effect.id} "
                + ", ".join(
                    f"{v.value:.3g} {v.unit}".removesuffix(" 1")
                    for v in each.evidence.parameters.values()
                    if v.ci
                )
                for each in check.missed
            )
            after = check.missed[-1].rmse_v if check.missed else check.references_rmse_v
            table.add_row(
                name,
                label,
                f"{check.references_rmse_v:.2f}",
                f"{check.among_themselves_rmse_v:.2f}",
                f"{after:.2f}",
                missed or "nothing",
            )
    return table
