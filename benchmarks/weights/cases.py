"""Draw cases: which logs, which references, which effect at which size, all from one seed.

A *split* is a choice of diagnosed logs and references of one pack. Its cases inject one effect each
into those logs. The size of an effect is the RMS change of voltage that it makes, in floors; a
floor is the RMS error of left-out references. Healthy cases are the logs as they are.
"""

from __future__ import annotations

import pickle
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.pybamm_plant import draw_pybamm_plant
from benchmarks.weights import engine, packs

from cangauge.extras.validation.twin.drive import draw_drive
from cangauge.extras.validation.twin.faults import Fault, fault_kind, fault_kinds
from cangauge.extras.validation.twin.injection import fit_surrogate_pack, inject
from cangauge.extras.validation.twin.pack import TwinPack, draw_pack
from cangauge.extras.validation.twin.plant import Plant, TwinPlant
from cangauge.extras.validation.twin.recording import record_drive, rms
from cangauge.logs.log import Log

FLOORS = (0.4, 5.0)
"""Sizes are drawn uniformly in the logarithm between these [floors]."""
LEAST_FLOORS = 0.3
"""A case whose physical limits allow less than this is not drawn."""
EFFECTS = tuple(kind.id for kind in fault_kinds())
OUTSIDE = tuple(kind.id for kind in fault_kinds(outside=True))
PER_SPLIT = 5
NUMBERS = {
    "weights": {
        "i3": (200, 60, 20), "i3_winter": (80, 16, 6), "lg_25": (80, 16, 8), "lg_cold": (80, 16, 8),
        "car1": (120, 36, 12), "a123": (60, 18, 6), "leaf": (28, 8, 0), "simulated": (160, 40, 20),
        "pybamm": (60, 16, 8),
    },
    "frozen": {
        "i3": (60, 24, 6), "i3_winter": (20, 8, 0), "lg_25": (20, 8, 3), "lg_cold": (20, 10, 0),
        "lg_40": (20, 8, 0), "car1": (40, 18, 3), "simulated": (60, 18, 8), "pybamm": (20, 8, 2),
    },
}  # fmt: skip
"""Cases of each data set: with an effect of the library, healthy, with an effect outside it."""


def plan(part: str, data: Path, seed: int) -> list[dict[str, Any]]:
    """Draw the splits of a part with their cases: names and numbers only, as JSON."""
    out = []
    of_name = {x.name: x for x in packs.recorded(data, part)}
    for name, (effects, healthy, outside) in NUMBERS[part].items():
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        causes: list[str | None] = [EFFECTS[k % len(EFFECTS)] for k in range(effects)]
        causes += [str(x) for x in rng.choice(OUTSIDE, outside)]
        causes = [causes[k] for k in rng.permutation(len(causes))]
        splits = max(healthy, -(-len(causes) // PER_SPLIT))
        for number in range(splits):
            mine = causes[number::splits] + [None] * (number < healthy)
            item: dict[str, Any] = {"pack": name, "seed": int(rng.integers(2**31))}
            count = int(rng.choice([1, 1, 2]))
            if name in of_name:
                pack = of_name[name]
                few, most = pack.references
                order = [pack.logs[k].name for k in rng.permutation(len(pack.logs))]
                count = min(count, len(order) - few)
                refs = int(rng.integers(few, min(most, len(order) - count) + 1))
                item |= {"logs": order[:count], "references": order[count : count + refs]}
            else:
                pool = (packs.SIMULATED if name == "simulated" else packs.PYBAMM)[part]
                item |= {"plant": int(pool[number % len(pool)]), "logs": count, "references": 4}
            item["cases"] = [_case(cause, rng) for cause in mine]
            out.append(item)
    return out


def _case(cause: str | None, rng: np.random.Generator) -> dict[str, Any]:
    low, high = np.log(FLOORS)
    floors, sign = float(np.exp(rng.uniform(low, high))), float(rng.choice([-1.0, 1.0]))
    if cause is None:
        return {"effect": None}
    sign = sign if fault_kind(cause).signed else 1.0
    return {
        "effect": cause,
        "floors": round(floors, 3),
        "sign": sign,
        "seed": int(rng.integers(2**31)),
    }


@dataclass
class Drawn:
    """One case, ready for a diagnosis."""

    pack: str
    world: str
    logs: list[Log]
    truth: dict[str, Any]


@dataclass
class Split:
    """References and the cases that share them."""

    pack: str
    world: str
    capacity_ah: float
    floor_v: float
    references: list[Log]
    cases: list[Drawn]


def _sized(
    gap_of: Callable[[float], float], limits: tuple[float, float], target_v: float
) -> tuple[float, float]:
    """Return size and gap [V]: secants in the logarithm, within limits, to 10 %."""
    low, high = limits
    size = float(np.sqrt(low * high))
    best, slope, last = (size, gap_of(size)), 1.0, None
    for _ in range(5):
        gap = best[1] if last is None else last[1]
        at = best[0] if last is None else last[0]
        if abs(np.log(gap / target_v)) < 0.1:
            break
        new = float(np.clip(at * (target_v / max(gap, 1e-9)) ** (1 / slope), low, high))
        if new == at:
            break
        found = gap_of(new)
        if np.isfinite(found) and abs(np.log(new / at)) > 1e-3:
            slope = float(
                np.clip(np.log(max(found, 1e-9) / max(gap, 1e-9)) / np.log(new / at), 0.3, 4.0)
            )
        last = (new, found) if np.isfinite(found) else (float(np.sqrt(new * low)), gap)
        if np.isfinite(found) and abs(np.log(max(found, 1e-9) / target_v)) < abs(
            np.log(max(best[1], 1e-9) / target_v)
        ):
            best = (new, found)
    return best


def _fault(case: dict[str, Any], shortest_s: float, fullest_pct: float) -> Fault:
    kind, sign = fault_kind(case["effect"]), case["sign"]
    if kind.id == "initial_soc" and fullest_pct > 80.0:
        sign = -1.0  # a full pack cannot be fuller
    shape = {}
    if "at_s" in kind.shape:
        shape = {"at_s": (0.2 + 0.5 * np.random.default_rng(case["seed"]).random()) * shortest_s}
    return Fault(kind.id, sign, shape, case["seed"])


def _start(log: Log) -> float:
    return float(log.soc_pct[np.flatnonzero(np.isfinite(log.soc_pct))[0]])


def draw_recorded(item: dict[str, Any], pack: packs.PackLogs, own: TwinPack | None = None) -> Split:
    """Inject the effects of a split into recorded logs."""
    by_name = {log.name: log for log in pack.logs}
    logs, references = ([by_name[x] for x in item[key]] for key in ("logs", "references"))
    surrogate = own or fit_surrogate_pack(
        pack.logs, capacity_ah=pack.capacity_ah, cells=pack.cells, name=pack.name
    )
    floor_v = engine.floor_v(references, pack.capacity_ah)
    cases = []
    for case in item["cases"]:
        changed, truth = logs, dict(case)
        if case["effect"] is not None:
            unit = _fault(case, min(x.duration_s for x in logs), max(map(_start, logs)))

            def gap_of(size: float, unit: Fault = unit) -> float:
                faults = [unit.sized(np.sign(unit.size) * size)]
                return rms(np.concatenate([inject(x, faults, surrogate).gap_v for x in logs]))

            size, gap = _sized(gap_of, unit.kind.limits(surrogate), case["floors"] * floor_v)
            if gap < LEAST_FLOORS * floor_v:
                continue
            fault = unit.sized(np.sign(unit.size) * size)
            changed = [inject(x, [fault], surrogate).log for x in logs]
            truth |= {"size": fault.size, "unit": fault.kind.unit, "reached": gap / floor_v}
        cases.append(Drawn(pack.name, pack.world, [_thin(x) for x in changed], truth))
    return Split(
        pack.name, pack.world, pack.capacity_ah, floor_v, [_thin(x) for x in references], cases
    )


def _thin(log: Log) -> Log:
    return packs.thinned(log, 1.0)


def made_pack(plant_name: str, seed: int, folder: Path) -> tuple[packs.PackLogs, TwinPack | None]:
    """Simulate ten healthy drives of a pack, once; they take faults as recorded logs do.

    The faults of a twin's pack act on its own physics, those of a PyBaMM pack on a surrogate.
    """
    file = folder / f"{plant_name}_{seed}.pkl"
    if not file.exists():
        rng = np.random.default_rng([seed, 1])
        drawn = draw_pack(rng)
        plant: Plant = TwinPlant(drawn)
        if plant_name == "pybamm":
            plant = draw_pybamm_plant(rng, drawn)
        middle = 16.0 if plant_name == "pybamm" else rng.uniform(8.0, 25.0)
        ambient = rng.permutation(np.linspace(middle - 9.0, middle + 9.0, 9))
        drives = [
            draw_drive(
                rng,
                plant.pack,
                hours=2.0,
                ambient_c=float(middle),
                start_soc=1.0,
                end_soc=0.05,
                discharge=True,
            )
        ]
        drives += [
            draw_drive(rng, plant.pack, hours=float(rng.uniform(0.5, 1.2)), ambient_c=float(c))
            for c in ambient
        ]
        logs = [
            packs.thinned(record_drive(plant, x, (), name=f"drive_{k}").log, 0.5)
            for k, x in enumerate(drives)
        ]
        exact = replace(
            plant.pack.sensors, current_step_a=0.0, voltage_step_v=0.0, temperature_step_k=0.0
        )
        own = replace(plant.pack, sensors=exact) if plant_name == "simulated" else None
        file.write_bytes(pickle.dumps((logs, plant.pack.capacity_ah, plant.pack.cells, own)))
    logs, capacity_ah, cells, own = pickle.loads(file.read_bytes())
    return packs.PackLogs(plant_name, plant_name, logs, capacity_ah, cells, (4, 4)), own


def draw_one(items: list[dict[str, Any]], number: int, part: str, data: Path, folder: Path) -> None:
    """Draw one split of a plan into a folder, once."""
    folder.mkdir(parents=True, exist_ok=True)
    of_name = {x.name: x for x in packs.recorded(data, part)}
    item = items[number]
    if not item["pack"]:
        return
    file = folder / f"{number:03d}_{item['pack']}.pkl"
    if not file.exists():
        if item["pack"] in of_name:
            split = draw_recorded(item, of_name[item["pack"]])
        else:
            pack, own = made_pack(item["pack"], item["plant"], folder)
            rng = np.random.default_rng([item["seed"], 3])
            names = [
                pack.logs[0].name,
                *(pack.logs[k].name for k in 1 + rng.permutation(len(pack.logs) - 1)),
            ]
            few = item["references"]
            split = draw_recorded(
                {**item, "references": names[:few], "logs": names[few : few + item["logs"]]},
                pack,
                own,
            )
        file.write_bytes(pickle.dumps(split))
