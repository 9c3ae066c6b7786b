"""Does the proposed next step settle it? Planned steps beside a random drive, on simulated packs.

    python benchmarks/planned_tests.py [--packs 4] [--seed 7]

Packs and drives are simulated by the twin; every effect of the library is injected at two floors.
A case counts where a gap is reported and two effects or more are in the 90 % set. The best step of
`gap --plan` is then carried out on the simulated pack with the same fault: a drive is driven and
diagnosed together with the first log, a measurement reads what the fault makes it read, with its
error. A random drive of equal length is the comparison. A step of resistance is left out: it
happens once. Prints the mean probability of the true cause before and after.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from cangauge.diagnosis.answer import GROUP_OF, answer
from cangauge.diagnosis.columns import Columns
from cangauge.diagnosis.evidence import analyse, columns, learn
from cangauge.diagnosis.pack_fit import Trace, trace
from cangauge.diagnosis.planner import MEASUREMENTS, plan, proposed_drives, settled
from cangauge.diagnosis.trials import STEP
from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.faults import Fault
from cangauge.extras.validation.twin.injection import inject, scale_injection
from cangauge.extras.validation.twin.plant import Plant
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.extras.validation.twin.simulation import draw_plant
from cangauge.logs.log import Log

FLOORS, LEAST_NAMES = 2.0, 2
IN_ENGINE = {
    "current_offset": 1.0, "current_gain": 1.0, "voltage_offset": 1.0, "voltage_gain": 1.0,
    "time_skew": 1.0, "capacity": -1.0, "initial_soc": -1.0, "coulombic_efficiency": 1.0,
}  # fmt: skip
"""Effects with the same size in the twin and in the engine → the sign between them. The others have
another unit: what is measured of them is the size that the diagnosis found."""


def driven(plant: Plant, wanted: Trace, fault: Fault, seed: int) -> Log:
    """Drive a profile with the simulated pack and its fault."""
    n = len(wanted.current_a)
    drive = Drive(
        time_s=np.arange(n, dtype=float),
        current_a=wanted.current_a,
        ambient_c=np.full(n, wanted.temperature_c[0]),
        start_c=float(wanted.temperature_c[0]),
        start_soc=min(wanted.start_pct, 100.0) / 100.0,
        history=1.0,
        seed=seed,
    )
    return inject(record_drive(plant, drive, ()).log, [fault], plant.pack, seed=seed).log


class Bench:
    """One simulated pack with its references."""

    def __init__(self, seed: int, number: int) -> None:
        self.plant = draw_plant(np.random.default_rng([seed, number, 1]))
        self.rng, pack = np.random.default_rng([seed, number, 2]), self.plant.pack
        self.ambient_c = self.rng.uniform(10.0, 22.0) + np.linspace(-6.0, 6.0, 4)
        drives = [self.drive(2.0, 1, start_soc=1.0, end_soc=0.05, discharge=True)]
        drives += [self.drive(0.8, k) for k in range(4)]
        traces = [trace(record_drive(self.plant, x, ()).log, pack.capacity_ah) for x in drives]
        self.known = learn(traces, pack.capacity_ah)

    def drive(self, hours: float, at: int, **given: Any) -> Drive:
        """Draw a drive at one of the references' temperatures."""
        c = float(self.ambient_c[at])
        return draw_drive(self.rng, self.plant.pack, hours=hours, ambient_c=c, **given)

    def columns(self, log: Log) -> Columns:
        """Return the columns of a log."""
        return columns(self.known, trace(log, self.plant.pack.capacity_ah))

    def both(self, first: Columns, second: Log, effect: str) -> float:
        """Return the probability of an effect by two logs."""
        evidence = analyse(self.known, [first, self.columns(second)])
        return answer(self.known, evidence).probabilities[effect]

    def case(self, effect: str) -> tuple[str, float, float, float] | None:
        """Return step, and P(truth) before, after it, after a random drive; None if not unsure."""
        pack, rng, seed = self.plant.pack, self.rng, int(self.rng.integers(2**31))
        clean = record_drive(self.plant, self.drive(0.8, 2), ()).log
        unit = Fault(effect, -1.0 if effect == "initial_soc" else 1.0, seed=seed)
        fault = scale_injection([clean], unit, FLOORS * self.known.healthy_rmse_v, pack).fault
        first = self.columns(inject(clean, [fault], pack).log)
        evidence = analyse(self.known, [first])
        now = answer(self.known, evidence)
        if not now.detected or len([x for x in now.credible_set if x in GROUP_OF]) < LEAST_NAMES:
            return None
        best = plan(self.known, [first], evidence, now).steps[0]
        if best.kind == "drive":
            profile = proposed_drives(self.known, [first.log])[best.name][1]
            planned = self.both(first, driven(self.plant, profile, fault, seed), effect)
        else:
            one = next(x for x in MEASUREMENTS if x.name == best.name)
            size = evidence.effects[effect].size
            if effect in IN_ENGINE:
                size = fault.size * IN_ENGINE[effect]
            reads = one.reading(self.known.pack, effect, size)
            reads += one.std(self.known.pack) * float(rng.normal())
            planned = settled(self.known.pack, evidence, now.probabilities, one, reads)[effect]
        other = inject(record_drive(self.plant, self.drive(0.5, 1), ()).log, [fault], pack).log
        random = self.both(first, other, effect)
        return best.name, now.probabilities[effect], planned, random


def main() -> None:
    """Run the cases and print the means."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--packs", type=int, default=4)
    parser.add_argument("--seed", type=int, default=7)
    given = parser.parse_args()
    rows = []
    for number in range(given.packs):
        bench = Bench(given.seed, number)
        for effect in GROUP_OF:
            found = None if effect == STEP.effect else bench.case(effect)
            if found is None:
                continue
            name, *p = found
            rows.append(p)
            print(
                f"{number} {effect:24s} {name:38s} {p[0]:.2f} → {p[1]:.2f}; random {p[2]:.2f}",
                flush=True,
            )
    before, planned, random = np.mean(rows, axis=0)
    print(
        f"{len(rows)} ambiguous cases: P(truth) before {before:.2f}, after the planned step"
        f" {planned:.2f}, after a random drive {random:.2f}"
    )


if __name__ == "__main__":
    main()
