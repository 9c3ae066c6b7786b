"""Draw cases: which logs, which references, which fault at which size, all from one seed.

A *split* is a choice of diagnosed logs and references of one pack. Its cases inject one effect each
into those logs. The size of an effect is the RMS change of voltage that it makes, in floors; a
floor is the RMS error of left-out references. Healthy cases are the logs as they are. A plan holds
the sizes, so that a drawn case never depends on the engine that it tests.
"""

from __future__ import annotations

import pickle
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.weights import packs
from benchmarks.weights.outside import OUTSIDE, inject_outside

from cangauge._typing import FloatArray
from cangauge.extras.validation.twin.drive import draw_drive
from cangauge.extras.validation.twin.faults import FAULT_KINDS, Fault, FaultKind
from cangauge.extras.validation.twin.injection import fit_surrogate_pack, inject
from cangauge.extras.validation.twin.pack import TwinPack, draw_pack
from cangauge.extras.validation.twin.recording import record_drive, rms
from cangauge.logs.log import Log

FLOORS = (0.4, 5.0)
"""Sizes are drawn uniformly in the logarithm between these [floors]."""
LEAST_FLOORS = 0.3
"""A case whose physical limits allow less than this is not drawn."""
EFFECTS: dict[str, tuple[str, ...]] = {
    "voltage_reading": ("voltage_offset", "voltage_gain"),
    "current_reading": ("current_offset", "current_gain"),
    "start": ("initial_soc",),
    "capacity": ("capacity", "coulombic_efficiency"),
    "clock": ("time_skew",),
    "temperature": (
        "temperature_offset",
        "temperature_lag",
        "core_temperature",
        "entropic_coefficient",
    ),
    "resistance": (
        "resistance_growth",
        "resistance_growth",
        "resistance_step",
        "resistance_temperature",
        "resistance_soc",
        "resistance_asymmetry",
        "charge_transfer",
        "fast_polarization",
    ),
    "slow_voltage": ("slow_diffusion", "hysteresis"),
    "weak_cell": ("weak_cell",),
}
"""Fault → its effects, drawn alike; the commonest of all, a grown resistance, twice."""
OUTSIDE_SHARE = 0.1
COUNTS = (1, 1, 1, 2, 2, 3, 4, 6)
"""Numbers of diagnosed logs."""
REFERENCES = (3, 20)
PER_SPLIT = 5
NUMBERS = {
    "weights": {
        "i3": 30, "i3_winter": 12, "lg_25": 8, "lg_cold": 12, "car1": 24, "a123": 12, "leaf": 4,
        "simulated": 24,
    },
    "frozen": {
        "i3": 24, "i3_winter": 8, "lg_25": 6, "lg_cold": 10, "lg_40": 8, "car1": 16,
        "simulated": 14,
    },
}  # fmt: skip
"""Splits of each data set."""
DRIVES = 24
"""Drives of a simulated pack."""


@dataclass(frozen=True)
class Injection:
    """One effect of one size, as the twin or a sensor would show it."""

    effect: str
    size: float
    shape: dict[str, float]
    seed: int

    def into(self, log: Log, pack: TwinPack) -> tuple[Log, FloatArray]:
        """Return the log with the effect, and the gap that it opens [V]."""
        if self.effect == "temperature_offset":
            return self._warmer(log, pack)
        if self.effect == "resistance_growth":
            gap_v = -self.size * log.current_a
            return replace(log, voltage_v=log.voltage_v + gap_v), gap_v
        if self.effect in OUTSIDE:
            return inject_outside(log, pack, self.effect, self.size, self.seed)
        fault = Fault(self.effect, self.size, self.shape, self.seed)
        changed, gap_v = inject(log, [fault], pack)
        if log.soc_pct is not None and np.isfinite(log.soc_pct).sum() > 1:
            changed = replace(changed, soc_pct=log.soc_pct)
        return changed, gap_v

    @property
    def kind(self) -> FaultKind:
        """Kind of the effect."""
        return (FAULT_KINDS | OUTSIDE)[self.effect]

    def _warmer(self, log: Log, pack: TwinPack) -> tuple[Log, FloatArray]:
        """Return the log with a thermometer that reads too high."""
        warmer = replace(log, temperature_c=log.temperature_c + self.size)
        ohm = pack.resistance_ohm * packs.PER_K * self.size
        return warmer, -ohm * log.current_a + packs.ENTROPY_PER_K * pack.nominal_v * self.size

    def limits(self, pack: TwinPack) -> tuple[float, float]:
        """Return the smallest and the largest physical size."""
        if self.effect == "temperature_offset":
            return 0.5, 15.0
        if self.effect == "resistance_growth":
            return 0.01 * pack.resistance_ohm, 2.0 * pack.resistance_ohm
        return self.kind.limits(pack)

    def is_signed(self) -> bool:
        """Whether the size may be negative."""
        if self.effect in ("temperature_offset", "resistance_growth"):
            return self.effect == "temperature_offset"
        return self.kind.signed


@dataclass
class Drawn:
    """One case, ready for a diagnosis."""

    logs: list[Log]
    truth: dict[str, Any]


@dataclass
class Split:
    """References and the cases that share them."""

    pack: str
    world: str
    chemistry: str
    cells: int
    capacity_ah: float
    floor_v: float
    references: list[Log]
    cases: list[Drawn]


def plan(part: str, data: Path, folder: Path, seed: int, floor_of: Callable[..., float]) -> None:
    """Draw the splits of a part with their cases, sized, one file each.

    `floor_of` returns the RMS error of left-out references [V] of logs and a capacity.
    """
    of_name = {x.name: x for x in packs.recorded(data, part)}
    folder.mkdir(parents=True, exist_ok=True)
    number = 0
    for name, splits in NUMBERS[part].items():
        for k in range(splits):
            number += 1
            file = folder / f"{number:03d}_{name}.pkl"
            if file.exists():
                continue
            rng = np.random.default_rng([seed, zlib.crc32(name.encode()), k])
            if name in of_name:
                pack, own = of_name[name], None
            else:
                seeds = packs.SIMULATED[part]
                pack, own = made_pack(seeds[k % len(seeds)], folder)
            split = _draw(pack, own, rng, floor_of)
            file.write_bytes(pickle.dumps(split))
            print(f"{number:3d} {name:10s} {len(split.cases)} cases", flush=True)


def _draw(
    pack: packs.PackLogs,
    own: TwinPack | None,
    rng: np.random.Generator,
    floor_of: Callable[..., float],
) -> Split:
    order = [pack.logs[k] for k in rng.permutation(len(pack.logs))]
    few = pack.references[0]
    count = min(int(rng.choice(COUNTS)), len(order) - few)
    most = min(REFERENCES[1], len(order) - count)
    number = round(float(np.exp(rng.uniform(np.log(few), np.log(most + 0.49)))))
    keeps_soc = bool(rng.random() < 0.5)
    chosen = order if keeps_soc else [_start_alone(log) for log in order]
    logs, references = chosen[:count], chosen[count : count + number]
    surrogate = own or fit_surrogate_pack(
        pack.logs, capacity_ah=pack.capacity_ah, cells=pack.cells, name=pack.name
    )
    floor_v = floor_of(references, pack.capacity_ah)
    cases = [Drawn(logs, {"effect": None, "fault": "none"})]
    for _ in range(PER_SPLIT):
        drawn = _case(logs, surrogate, floor_v, rng)
        if drawn is not None:
            cases.append(drawn)
    return Split(
        pack.name,
        pack.world,
        "lfp" if pack.name == "a123" else "oxide",
        pack.cells,
        pack.capacity_ah,
        floor_v,
        references,
        cases,
    )


def _start_alone(log: Log) -> Log:
    row, start_pct = log.first_soc()
    soc = np.full(len(log), np.nan)
    soc[row] = start_pct
    return replace(log, soc_pct=soc)


def _case(
    logs: Sequence[Log], pack: TwinPack, floor_v: float, rng: np.random.Generator
) -> Drawn | None:
    fault = str(rng.choice(list(EFFECTS)))
    effect = str(rng.choice(EFFECTS[fault]))
    if rng.random() < OUTSIDE_SHARE:
        fault, effect = "unknown", str(rng.choice(list(OUTSIDE)))
    floors = float(np.exp(rng.uniform(*np.log(FLOORS))))
    sign, seed = float(rng.choice([-1.0, 1.0])), int(rng.integers(2**31))
    shape = {}
    if effect == "resistance_step":
        shortest_s = min(log.duration_s for log in logs)
        shape = {"at_s": float(rng.uniform(0.2, 0.7)) * shortest_s}
    unit = Injection(effect, 1.0, shape, seed)
    if effect == "initial_soc" and max(log.first_soc()[1] for log in logs) > 80.0:
        sign = -1.0  # a full pack cannot be fuller
    sign = sign if unit.is_signed() else 1.0

    def gap_of(size: float) -> float:
        sized = replace(unit, size=sign * size)
        return rms(np.concatenate([sized.into(log, pack)[1] for log in logs]))

    size, gap = _sized(gap_of, unit.limits(pack), floors * floor_v)
    if not gap >= LEAST_FLOORS * floor_v:
        return None
    found = replace(unit, size=sign * size)
    changed = [found.into(log, pack)[0] for log in logs]
    truth = {"effect": effect, "fault": fault, "size": found.size, "floors": gap / floor_v}
    return Drawn(changed, truth | {"ohm": pack.resistance_ohm})


def _sized(
    gap_of: Callable[[float], float], limits: tuple[float, float], target_v: float
) -> tuple[float, float]:
    """Return size and gap [V]: secants in the logarithm, within limits, to 10 %."""
    low, high = limits
    size = float(np.sqrt(low * high))
    gap, slope = gap_of(size), 1.0
    best = size, gap
    for _ in range(4):
        if abs(np.log(gap / target_v)) < 0.1:
            break
        new = float(np.clip(size * (target_v / max(gap, 1e-9)) ** (1 / slope), low, high))
        if new == size:
            break
        found = gap_of(new)
        if not np.isfinite(found):
            break
        if abs(np.log(new / size)) > 1e-3:
            ratio = np.log(max(found, 1e-9) / max(gap, 1e-9)) / np.log(new / size)
            slope = float(np.clip(ratio, 0.3, 4.0))
        size, gap = new, found
        if abs(np.log(max(gap, 1e-9) / target_v)) < abs(np.log(max(best[1], 1e-9) / target_v)):
            best = size, gap
    return best


def made_pack(seed: int, folder: Path) -> tuple[packs.PackLogs, TwinPack]:
    """Simulate healthy drives of a pack, once; a fault acts on its own physics."""
    file = folder / f"pack_{seed}.pickle"
    if not file.exists():
        rng = np.random.default_rng([seed, 1])
        drawn = draw_pack(rng)
        middle_c = float(rng.uniform(8.0, 25.0))
        ambient = rng.permutation(np.linspace(middle_c - 9.0, middle_c + 9.0, DRIVES))
        drives = [
            draw_drive(rng, drawn, hours=float(rng.uniform(0.5, 1.2)), ambient_c=float(c))
            for c in ambient
        ]
        logs = [
            packs.thinned(record_drive(drawn, x, name=f"drive_{k}").log, 0.5)
            for k, x in enumerate(drives)
        ]
        exact = replace(
            drawn.sensors, current_step_a=0.0, voltage_step_v=0.0, temperature_step_k=0.0
        )
        own = replace(drawn, sensors=exact)
        file.write_bytes(pickle.dumps((logs, drawn.capacity_ah, drawn.cells, own)))
    logs, capacity_ah, cells, own = pickle.loads(file.read_bytes())
    return packs.PackLogs("simulated", "simulated", logs, capacity_ah, cells, (3, 20)), own
