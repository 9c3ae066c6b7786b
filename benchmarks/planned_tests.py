"""Does the proposed next step settle it? Planned steps beside a random drive, on simulated packs.

    python benchmarks/planned_tests.py [--packs 4] [--seed 7]

Packs and drives are simulated by the twin; every effect of the library is injected at two floors. A
case counts where a gap is reported and two effects or more are in the 90 % set. The best step of
`gap --plan` is then carried out on the simulated pack with the same fault: a drive is driven and
diagnosed together with the first log, a measurement reads what the fault makes it read, with its
error. A random drive of equal length is the comparison. A step of resistance is left out: it happens
once. Prints the mean probability of the true cause before and after.
"""

from __future__ import annotations

import argparse

import numpy as np

from cangauge.diagnosis.answer import GROUP_OF, answer
from cangauge.diagnosis.evidence import References, analyse, columns, learn
from cangauge.diagnosis.pack_fit import Trace, trace
from cangauge.diagnosis.planner import MEASUREMENTS, plan, proposed_drives, settled
from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.faults import Fault, fault_kind
from cangauge.extras.validation.twin.injection import inject, scale_injection
from cangauge.extras.validation.twin.plant import Plant
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.extras.validation.twin.simulation import draw_plant
from cangauge.logs.log import Log

FLOORS = 2.0
IN_ENGINE = {  # size of the twin's fault → size of the engine's effect
    "capacity": -1.0,
    "initial_soc": -1.0,
}


def driven(plant: Plant, wanted: Trace, fault: Fault, seed: int) -> Log:
    """Drive a profile with the simulated pack and its fault."""
    n = len(wanted.current_a)
    drive = Drive(
        time_s=np.arange(n, dtype=float), current_a=wanted.current_a, ambient_c=np.full(n, wanted.temperature_c[0]),
        start_c=float(wanted.temperature_c[0]), start_soc=min(wanted.start_pct, 100.0) / 100.0, history=1.0, seed=seed,
    )  # fmt: skip
    return inject(record_drive(plant, drive, ()).log, [fault], plant.pack, seed=seed).log


def after_drive(known: References, first: Log, second: Log, capacity_ah: float, effect: str) -> float:
    """Return the probability of the truth by both logs."""
    both = [columns(known, trace(log, capacity_ah)) for log in (first, second)]
    return answer(known, analyse(known, both)).probabilities[effect]


def main() -> None:
    """Run the cases and print the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packs", type=int, default=4)
    parser.add_argument("--seed", type=int, default=7)
    given = parser.parse_args()
    rows = []
    for number in range(given.packs):
        plant = draw_plant(np.random.default_rng([given.seed, number, 1]))
        rng, pack = np.random.default_rng([given.seed, number, 2]), plant.pack
        ambient = [float(x) for x in rng.uniform(10.0, 22.0) + np.linspace(-6.0, 6.0, 4)]
        drives = [draw_drive(rng, pack, hours=2.0, ambient_c=ambient[1], start_soc=1.0, end_soc=0.05, discharge=True)]
        drives += [draw_drive(rng, pack, hours=0.8, ambient_c=c) for c in ambient]
        refs = [record_drive(plant, x, ()).log for x in drives]
        known = learn([trace(x, pack.capacity_ah) for x in refs], pack.capacity_ah)
        for effect in GROUP_OF:
            if effect == "resistance_step":
                continue
            seed = int(rng.integers(2**31))
            clean = record_drive(plant, draw_drive(rng, pack, hours=0.8, ambient_c=ambient[2]), ()).log
            sign = -1.0 if effect == "initial_soc" else 1.0
            scaled = scale_injection([clean], Fault(effect, sign, seed=seed), FLOORS * known.healthy_v2**0.5, pack)
            log = inject(clean, [scaled.fault], pack).log
            first = columns(known, trace(log, pack.capacity_ah))
            evidence = analyse(known, [first])
            now = answer(known, evidence)
            unsure = [name for name in now.credible_set if name in GROUP_OF]
            if not now.detected or len(unsure) < 2:
                continue
            proposed = plan(known, [first], evidence, now)
            best = proposed.steps[0]
            if best.kind == "drive":
                profile = proposed_drives(known, [first.log])[best.name][1]
                planned = after_drive(known, log, driven(plant, profile, scaled.fault, seed), pack.capacity_ah, effect)
            else:
                one = next(x for x in MEASUREMENTS if x.name == best.name)
                size = scaled.fault.size * IN_ENGINE.get(effect, 1.0)
                reads = one.readings[effect](known.pack, size) if effect in one.readings else 0.0
                reads += one.std(known.pack) * float(rng.normal())
                planned = settled(known.pack, evidence, now.probabilities, one, reads)[effect]
            other = record_drive(plant, draw_drive(rng, pack, hours=0.5, ambient_c=ambient[1]), ()).log
            random = after_drive(known, log, inject(other, [scaled.fault], pack).log, pack.capacity_ah, effect)
            rows.append((effect, best.name, best.gain, now.probabilities[effect], planned, random, fault_kind(effect).unit))
            print(f"{number} {effect:24s} {best.name:38s} expected {best.gain:+.2f}: {rows[-1][3]:.2f} → {planned:.2f}; random {random:.2f}", flush=True)
    table = np.array([row[2:6] for row in rows], dtype=float)
    print(f"{len(rows)} ambiguous cases: before {table[:, 1].mean():.2f}, planned {table[:, 2].mean():.2f}, random drive {table[:, 3].mean():.2f}")


if __name__ == "__main__":
    main()
