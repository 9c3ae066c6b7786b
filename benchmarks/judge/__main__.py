"""Chains of days with a corrupted gauge: how often it is seen and named, and false alarms.

    cd benchmarks && python -m judge PACK… [--chains 8] [--healthy 60] [--data FOLDER] [--day-one]

Recorded packs are those of `packs.recorded`; `_dev` packs are the ones that constants were chosen
on, and share no log with the judged ones. `twin_lfp` and `pybamm_lfp` (which needs pybamm) draw a
pack from each seed. Each chain draws its training logs (the model's), then other logs in random
order as days. Prints one line of JSON for each judgement; `python -m judge --table FILE…` prints
the table of such lines.
"""

from __future__ import annotations

import argparse
import json
import sys
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import cangauge
from cangauge.extras.validation.twin.drive import draw_drive
from cangauge.extras.validation.twin.pack import draw_pack
from cangauge.extras.validation.twin.plant import TwinPlant
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.logs.read import CellColumns
from packs.recorded import Pack, counted_ah, load, one_hz
from pybamm_plant import draw_pybamm_plant

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
DAYS = (1, 3, 7, 15)
SHORTEST_S = 600.0
TRAINING = {"car1": 4, "car1_dev": 4, "lg_hg2_dev": 2}
"""Training logs where there are few; 5 elsewhere."""
FAULTS = {
    "none": ("none", (0.0,)),
    "offset in the count": ("current_offset", (1.0, -1.0, 2.0, -2.0)),
    "offset of the sensor": ("current_offset", (1.0, -1.0, 2.0, -2.0)),
    "start": ("start_or_reset", (5.0, -5.0, 8.0, -8.0)),
    "voltage": ("voltage_sensor", (1.0, -1.0, 1.5, -1.5)),
    "count": ("count_scale", (3.0, -3.0, 5.0, -5.0)),
    "capacity": ("pack_capacity", (5.0, 10.0)),
    "weak cell": ("weak_cell", (10.0, 15.0)),
    "none, with cells": ("none", (0.0,)),
}
"""Fault: cause to name, and sizes [A at 60 Ah, % SoC, % of the voltage, %]."""


def corrupted(
    logs: Sequence[cangauge.Log], fault: str, size: float, capacity_ah: float
) -> tuple[list[cangauge.Log], float]:
    """Return the logs of a chain whose gauge has a fault, and the capacity that it is told [Ah]."""
    offset_a = size * capacity_ah / 60.0
    hours, changed, told_ah = 0.0, [], capacity_ah
    start = next(float(log.soc_pct[np.isfinite(log.soc_pct)][0]) for log in logs)
    for log in logs:
        elapsed = (log.time_s - log.time_s[0]) / 3600.0
        soc, volts, amps = log.soc_pct, log.voltage_v, log.current_a
        if fault.startswith("offset"):
            soc = soc - 100.0 * offset_a * (hours + elapsed) / capacity_ah
            amps = amps + offset_a if "sensor" in fault else amps
        elif fault == "start":
            soc = soc + size
        elif fault == "voltage":
            volts = volts * (1.0 + size / 100.0)
        elif fault == "count":
            soc = start + (1.0 + size / 100.0) * (soc - start)
        elif fault == "capacity":  # the pack has less than it is told
            told_ah = capacity_ah * (1.0 + size / 100.0)
            soc = start + (soc - start) / (1.0 + size / 100.0)
        hours += float(elapsed[-1])
        changed.append(
            replace(log, soc_pct=np.clip(soc, 0.0, 100.0), voltage_v=volts, current_a=amps)
        )
    return changed, told_ah


def with_cells(
    logs: Sequence[cangauge.Log], model: cangauge.Model, lack_pct: float, chain: int
) -> list[CellColumns]:
    """Return voltages of the cells of a pack beside its logs: one of them lacks capacity.

    The others differ by 0.5 % in capacity and in charge (σ), each voltage by 2 mV.
    """
    rng = np.random.default_rng([chain, 5])
    number = model.cells or round(model.nominal_v / 3.7)
    lack, balance = rng.normal(0.0, 0.5, (2, number))
    lack[rng.integers(number)] = lack_pct
    found = []
    for log in logs:
        soc = np.interp(
            log.time_s, log.time_s[np.isfinite(log.soc_pct)], log.soc_pct[np.isfinite(log.soc_pct)]
        )
        slope = model.voltage_model().pseudo_ocv_slope(soc)[:, None] / number
        moved = balance + lack * (soc[:, None] - 100.0) / 100.0
        noise = rng.normal(0.0, 0.002, moved.shape)
        found.append(CellColumns(1, log.voltage_v[:, None] / number + slope * moved + noise))
    return found


def chains(pack: Pack, number: int, seed: int) -> Iterator[tuple[cangauge.Model, list, float]]:
    """Yield model, days in random order and capacity of a number of chains of a recorded pack."""
    logs = {log.name: one_hz(log) for log in [*pack.training, *pack.judged]}
    own = pack.training if pack.name.endswith("_dev") else pack.judged
    names = [log.name for log in own if logs[log.name].duration_s >= SHORTEST_S]
    training = min(TRAINING.get(pack.name, 5), len(names) - 1)
    for chain in range(number):
        rng = np.random.default_rng([seed, zlib.crc32(pack.name.encode()), chain])
        order = [names[k] for k in rng.permutation(len(names))]
        chosen = [logs[name] for name in order[:training]]
        capacity_ah = pack.capacity_of(chosen)
        model = cangauge.fit(
            chosen, capacity_ah=capacity_ah, chemistry=pack.chemistry, cells=pack.cells
        ).model
        yield model, [logs[name] for name in order[training:]], capacity_ah


def twin_chains(
    number: int, seed: int, *, with_pybamm: bool
) -> Iterator[tuple[cangauge.Model, list, float]]:
    """Yield the same of simulated LFP packs, a pack a chain."""
    for chain in range(number):
        rng = np.random.default_rng([seed, chain])
        pack_rng = np.random.default_rng([seed + chain, 1])
        pack = draw_pack(pack_rng, chemistry_name="lfp")
        plant = draw_pybamm_plant(pack_rng, pack) if with_pybamm else TwinPlant(pack)
        logs = []
        for day in range(1, 11):
            drive = draw_drive(
                np.random.default_rng([seed + chain, 4, day]),
                plant.pack,
                hours=float(rng.uniform(0.5, 1.5)),
                ambient_c=float(rng.uniform(10.0, 30.0)),
                start_soc=float(rng.uniform(60, 100)) / 100.0,
            )
            run = record_drive(plant, drive, ())
            logs.append(replace(run.log, soc_pct=run.true_soc_pct))
        model = cangauge.fit(
            logs[:3], capacity_ah=pack.capacity_ah, chemistry="lfp", cells=pack.cells
        ).model
        yield model, logs[3:], pack.capacity_ah


def run(name: str, arguments: argparse.Namespace) -> None:
    """Judge the chains of a pack, and print a line for each judgement."""
    number = max(arguments.chains, arguments.healthy)
    if name in {"twin_lfp", "pybamm_lfp"}:
        seed = 100 + 1000 * (arguments.seed - 1)
        drawn = twin_chains(number, seed, with_pybamm=name == "pybamm_lfp")
    else:
        pack, *winter = load(arguments.data, ["i3", "i3_winter"] if name == "i3" else [name])
        pack = replace(pack, judged=[*pack.judged, *(log for one in winter for log in one.judged)])
        drawn = chains(pack, number, arguments.seed)
    for chain, (fitted, logs, capacity_ah) in enumerate(drawn):
        model = fitted
        if arguments.day_one:
            model = cangauge.Model.prior(fitted.chemistry, fitted.cells, capacity_ah)
        for fault in arguments.faults:
            cause, sizes = FAULTS[fault]
            if chain >= (arguments.healthy if fault == "none" else arguments.chains):
                continue
            size = sizes[chain % len(sizes)]
            changed, told_ah = corrupted(logs, fault, size, capacity_ah)
            spans = np.cumsum([np.ptp(counted_ah(log)) for log in logs])
            for days in DAYS if fault != "none" or chain < 16 else DAYS[:3]:
                if days > len(logs) and days != min(d for d in DAYS if d >= len(logs)):
                    continue
                seen = changed[:days]
                cells = with_cells(seen, fitted, size, chain) if "cell" in fault else []
                judgement = cangauge.judge(seen, model, capacity_ah=told_ah, cell_voltages=cells)
                best = max(
                    (key for key in judgement.probabilities if key != "none"),
                    key=judgement.probabilities.__getitem__,
                )
                day = min(days, len(logs))
                widest = max(np.ptp(counted_ah(log)) for log in logs[:day]) / capacity_ah
                line = {
                    "pack": name, "chain": chain, "fault": fault, "cause": cause, "size": size,
                    "days": days, "none": judgement.probabilities["none"], "best": best,
                    "named": judgement.cause.verdict, "verdict": judgement.verdict,
                    "value": judgement.cause.size and judgement.cause.size.value,
                    "error_pct": judgement.error_pct, "std_pct": judgement.error_std_pct,
                    "drawn_ah": float(spans[day - 1]), "widest": float(widest),
                }  # fmt: skip
                print(json.dumps(line), flush=True)


def table(paths: Sequence[str]) -> None:
    """Print seen, rightly named and told "cannot tell", by pack, fault and number of days."""
    lines = [json.loads(line) for path in paths for line in Path(path).read_text().splitlines()]
    cells: dict[tuple[str, str], dict[int, list]] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        cells[line["pack"], line["fault"]][line["days"]].append(line)
    print("Each cell: off / rightly named / cannot tell, of all.\n")
    print("| pack | fault | " + " | ".join(f"{days} d" for days in DAYS) + " |")
    print("|---|---|" + "---|" * len(DAYS))
    for (pack, fault), of_days in cells.items():
        shown = []
        for days in DAYS:
            group = of_days.get(days, [])
            seen = sum(line["verdict"] == "off" for line in group)
            right = sum(
                line["named"] == line["cause"] and line["verdict"] == "off" for line in group
            )
            open_ = sum(line["verdict"] == "cannot_tell" for line in group)
            text = f"{seen} / {open_} of {len(group)}" if fault.startswith("none") else ""
            shown.append(text or f"{seen} / {right} / {open_} of {len(group)}" if group else "–")
        print(f"| {pack} | {fault} | " + " | ".join(shown) + " |")


def main() -> None:
    """Run or tabulate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("packs", nargs="*")
    parser.add_argument("--chains", type=int, default=8)
    parser.add_argument("--healthy", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=[*FAULTS])
    parser.add_argument("--day-one", action="store_true", help="judge by the chemistry alone")
    parser.add_argument("--table", nargs="+")
    arguments = parser.parse_args()
    if arguments.table:
        table(arguments.table)
        sys.exit()
    for name in arguments.packs:
        run(name, arguments)


if __name__ == "__main__":
    main()
