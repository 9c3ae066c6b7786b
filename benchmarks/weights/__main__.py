"""Fit the weights of the diagnosis to labelled cases, and score them on cases drawn beforehand.

    python -m benchmarks.weights fit    [--data FOLDER] [--cases FOLDER]   seconds once drawn
    python -m benchmarks.weights plan                                      frozen.json, once
    python -m benchmarks.weights check  [--data FOLDER] [--cases FOLDER]   the frozen cases

`fit` draws cases of the part "weights", prints the scores with every data set held out in turn,
and writes `src/cangauge/diagnosis/weights.json`. `check` draws what `frozen.json` names and scores
it by the weights that ship; its exit status is 1 where the right group comes first, or healthy logs
raise an alarm, less well than published. PyBaMM's cases are left out where it is not installed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from benchmarks.weights import cases, evidence, fit, packs, score

from cangauge.errors import InputError

ROOT = Path(__file__).parents[2]
FROZEN = Path(__file__).with_name("frozen.json")
SHIPPED = ROOT / "src/cangauge/diagnosis/weights.json"
LEAST_FIRST, MOST_ALARMS = 0.7, 0.05
"""Bounds of `check`: the right group first at one floor or more, and alarms on healthy logs. Two
standard deviations of the frozen cases away from what was measured."""
SEEDS = {"weights": 1, "frozen": 20261125}


def draw_all(items: list[dict[str, object]], part: str, data: Path, folder: Path) -> None:
    """Draw every split of a plan that is not drawn yet, and gather its evidence."""
    for number, item in enumerate(items):
        began = time.monotonic()
        try:
            cases.draw_one(items, number, part, data, folder)
        except (InputError, ValueError, RuntimeError) as error:  # PyBaMM absent, its solver
            print(f"{number:3d} {item['pack']}: not drawn: {error}", flush=True)
            continue
        print(f"{number:3d} {item['pack']:10s} {time.monotonic() - began:6.1f} s", flush=True)


def shipped() -> np.ndarray:
    """Return the weights that ship, as one array."""
    weights = json.loads(SHIPPED.read_text())["weights"]
    return np.concatenate([weights[part] for part in fit.PARTS])


def main() -> int:
    """Run one of the commands; return its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=["fit", "plan", "check"])
    parser.add_argument("--data", type=Path, default=ROOT / "../shared/data")
    parser.add_argument("--cases", type=Path, default=ROOT / "out/weights")
    parser.add_argument("--half", type=int, choices=[1, 2], help="half of the frozen splits")
    parser.add_argument("--only", nargs="*", help="data sets to draw")
    given = parser.parse_args()
    if given.command == "plan":
        items = cases.plan("frozen", given.data, SEEDS["frozen"])
        FROZEN.write_text("[\n" + ",\n".join(json.dumps(x) for x in items) + "\n]\n")
        print(f"{len(items)} splits, {sum(len(x['cases']) for x in items)} cases in {FROZEN}")
        return 0
    part = "weights" if given.command == "fit" else "frozen"
    items = (
        cases.plan(part, given.data, SEEDS[part])
        if part == "weights"
        else json.loads(FROZEN.read_text())
    )
    if given.only:
        items = [x if x["pack"] in given.only else {**x, "pack": ""} for x in items]
    if given.half is not None and part == "frozen":
        items = [x if x["half"] == given.half else {**x, "pack": ""} for x in items]
    folder = given.cases / part
    draw_all(items, part, given.data, folder)
    found = evidence.gather(folder, [k for k, x in enumerate(items) if x["pack"]])
    if part == "frozen":
        out = fit.probabilities(shipped(), found)
        print(score.table(found, out))
        first, alarms = score.bounds(found, out)
        return int(first < LEAST_FIRST or alarms > MOST_ALARMS)
    out = fit.held_out(found)
    table = score.table(found, out)
    print("Every data set held out in turn:\n" + table)
    for share in (0.0, 0.03, 0.1, 0.3, 1.0):  # open set against naming
        line = score.trade(found, fit.held_out(found, cause_out=share))
        print(f"cause-out weight {share:4.2f}: {line}")
    w = fit.fit(found)
    ends = np.cumsum([0, *fit.PARTS.values()])
    weights = {
        part: w[a:b].round(4).tolist()
        for part, a, b in zip(fit.PARTS, ends[:-1], ends[1:], strict=True)
    }
    logs = {x.name: [log.name for log in x.logs] for x in packs.recorded(given.data, part)}
    logs |= {
        f"{k} packs, seeds": list(v)
        for k, v in (("simulated", packs.SIMULATED[part]), ("pybamm", packs.PYBAMM[part]))
    }
    whole = {
        "weights": weights,
        "command": "python -m benchmarks.weights fit",
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "cases": {
            p: sum(x.pack == p and not x.cause_out for x in found)
            for p in sorted({x.pack for x in found})
        },
        "trained_on": logs,
        "held_out": table.splitlines(),
    }
    SHIPPED.write_text(json.dumps(whole, indent=1) + "\n")
    print(f"wrote {SHIPPED}: {weights}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
