"""Fit the weights of the diagnosis to labelled cases, and score them on frozen ones.

    python -m benchmarks.weights fit    [--data FOLDER] [--cases FOLDER]   writes weights.json
    python -m benchmarks.weights check  [--data FOLDER] [--cases FOLDER]   the frozen cases
    python -m benchmarks.weights models [--data FOLDER]      wrong models beside healthy logs
    python -m benchmarks.weights trips  [--data FOLDER]      answers of two trips, as printed

`fit` draws cases of the part "weights", prints the scores with every data set held out in turn,
and writes `src/cangauge/diagnosis/weights.json`. `check` draws the part "frozen" and scores it by
the weights that ship.
"""

from __future__ import annotations

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.figures import publish
from benchmarks.weights import cases, fit, score, user
from rich.table import Table

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "src/cangauge/diagnosis/weights.json"
DESCRIBES = ("src/cangauge/diagnosis", "src/cangauge/model", "src/cangauge/identify")
SEEDS = {"weights": 11, "frozen": 20261129}


def main() -> int:
    """Run one of the commands; return its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=["fit", "check", "models", "trips"])
    parser.add_argument("--data", type=Path, default=ROOT / "../shared/data")
    parser.add_argument("--cases", type=Path, default=ROOT / "out/weights")
    parser.add_argument("--keep", action="store_true", help="keep the figures of docs/results.md")
    parser.add_argument("--every", type=int, default=1, help="score every N-th split only")
    given = parser.parse_args()
    if given.command == "models":
        tables = [user.models(given.data)]
    elif given.command == "trips":
        tables = [user.trips(given.data)]
    else:
        tables = _scored(given)
    publish(f"weights-{given.command}", tables, DESCRIBES, keeps=given.keep)
    return 0


def _scored(given: argparse.Namespace) -> list[Table]:
    """Draw and diagnose the cases of a part; write the weights fitted to those for weights."""
    part = "weights" if given.command == "fit" else "frozen"
    folder = given.cases / part
    cases.plan(part, given.data, folder, SEEDS[part], score.floor_v)
    examples = score.examples(folder, given.every)
    if part == "frozen":
        return score.tables(examples, [x.found["probabilities"] for x in examples])
    found = fit.held_out(examples)
    whole = {
        "weights": fit.fit(examples) | {"stated": score.stated_from(examples, found)},
        "command": "python -m benchmarks.weights fit",
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "cases": {
            pack: sum(x.pack == pack for x in examples)
            for pack in sorted({x.pack for x in examples})
        },
    }
    SHIPPED.write_text(json.dumps(whole, indent=1, ensure_ascii=False) + "\n")
    return score.tables(examples, found)


if __name__ == "__main__":
    sys.exit(main())
