"""Does the planned test settle it? Planned tests beside random drives on simulated packs.

    python benchmarks/planned_tests.py [--cases 30] [--seed 2] [--minutes 20] [--keep FILE.jsonl]

Packs, drives and faults are drawn as in the protocol `simulated` of `gap-check`, with development
seeds. A case counts where the first log leaves it ambiguous: two effects or more in the 90 % set.
The test that `gap --plan` proposes is then driven by the simulated pack with the same fault, and
diagnosed together with the first log; so is a random drive of equal length in its place. A
resistance step is left out: it happens once, and not again in every test. Weak cells lag by what
was taken out in between.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from cangauge.diagnosis import NONE, UNKNOWN, Verdict
from cangauge.diagnosis.next_test import design_of, plan_test
from cangauge.diagnosis.problem import DiagnosisProblem, build_problem
from cangauge.diagnosis.profiles import Limits, Profile
from cangauge.diagnosis.verdict import decide
from cangauge.errors import InputError
from cangauge.extras.validation.cases import CaseOptions, DrawnCase, Scenario, draw_case
from cangauge.extras.validation.plan import EFFECTS
from cangauge.extras.validation.recordings import model_rmse_v
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import Fault
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.identify.fit import fit
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

CASES_PER_PACK, CLEAN_DRIVES = 4, 3
NOT_REPEATED = "resistance_step"


@dataclass(frozen=True)
class Outcome:
    """Probability of the true effect, and whether it is named."""

    truth: str
    test: str
    expected: float
    """Expected probability of the true one, as the plan states it."""
    before: float
    planned: float
    random: float
    named_before: bool
    named_planned: bool
    named_random: bool


@dataclass(frozen=True, eq=False)
class Pack:
    """A simulated pack with its model and references."""

    scenario: Scenario
    model: Model
    references: list[Log]
    options: CaseOptions

    @classmethod
    def draw(cls, seed: int) -> Pack:
        """Draw a pack as `gap-check` does."""
        options = CaseOptions()
        scenario = options.draw_scenario(seed)
        training = [recording.log for recording in scenario.training]
        references = [recording.log for recording in scenario.references]
        model = fit(training, capacity_ah=scenario.pack.capacity_ah).model
        known = fit([*training, *references], capacity_ah=scenario.pack.capacity_ah)
        drives = scenario.draw_drives(np.random.default_rng([seed, 5]), CLEAN_DRIVES)
        clean = [record_drive(scenario.plant, drive, ()).log for drive in drives]
        floor_v = model_rmse_v(known, clean)
        return cls(scenario, model, references, replace(options, floor_v=floor_v))

    def with_test(self, case: DrawnCase, drive: Drive, first: DiagnosisProblem) -> Verdict:
        """Return the verdict on a case and a test; the first one if the pack is empty at once."""
        soc = float(case.recordings[0].true_soc_pct[0]) / 100.0
        faults = [later(item.fault, soc, drive.start_soc) for item in case.faults]
        log = record_drive(self.scenario.plant, drive, faults, name="test").log
        try:
            test = design_of(first, log)
        except InputError as error:
            print(error, file=sys.stderr)
            return decide(first)
        return decide(replace(first, diagnosed=(*first.diagnosed, test)))


def later(fault: Fault, soc: float, test_soc: float) -> Fault:
    """Return a fault of a pack at a test's SoC [-], by what it was at another.

    Weak cells lag more the emptier the pack is; the simulator balances them at every start.
    """
    if fault.id != "weak_cell":
        return fault
    shape = fault.full_shape()
    lag = (soc - test_soc) / (1.0 - fault.size)
    return replace(fault, shape={**shape, "deficit": max(shape["deficit"] + lag, 0.0)})


def drive_of(profile: Profile, seed: int) -> Drive:
    """Return the load of a profile, on the grid of the drives of the twin."""
    return Drive(
        time_s=profile.time_s,
        current_a=profile.current_a,
        ambient_c=np.full(profile.time_s.size, profile.start_c),
        start_c=profile.start_c,
        start_soc=profile.start_soc_pct / 100.0,
        seed=seed,
    )


def outcomes(seed: int, minutes: float, skip: int) -> Iterator[Outcome | None]:
    """Yield an outcome for each case that is ambiguous after its first log, None for others."""
    rng = np.random.default_rng([seed, 20])
    order: list[str] = []
    for first in itertools.count(0, CASES_PER_PACK):
        pack_seed = 2 * int(rng.integers(2**30))
        pack = None if first + CASES_PER_PACK <= skip else Pack.draw(pack_seed)
        for number in range(first, first + CASES_PER_PACK):
            order = order or [str(name) for name in rng.permutation(EFFECTS)
                              if name != NOT_REPEATED]  # fmt: skip
            case_seed, effect = 2 * int(rng.integers(2**30)), order.pop()
            if pack is not None and number >= skip:
                case = draw_case(case_seed, [effect], pack.scenario, pack.options)
                yield outcome_of(pack, case, effect, minutes)


def outcome_of(pack: Pack, case: DrawnCase, truth: str, minutes: float) -> Outcome | None:
    """Diagnose a case alone, with the planned test, and with a random drive."""
    problem = build_problem(case.logs, pack.model, pack.references)
    first = decide(problem)
    effects = [name for name in first.credible_set if name not in {NONE, UNKNOWN}]
    if len(effects) < 2:
        return None
    plan = plan_test(problem, first, replace(Limits.of(problem), minutes=minutes))
    rng = np.random.default_rng([case.truth["seed"], 21])
    drives = {
        "planned": drive_of(plan.best.profile, int(rng.integers(2**31))),
        "random": pack.scenario.draw_drives(rng, 1, minutes / 60.0)[0],
    }
    found = {name: pack.with_test(case, drive, problem) for name, drive in drives.items()}
    return Outcome(
        truth=truth,
        test=plan.best.profile.name,
        expected=plan.best.probability,
        before=first.probabilities[truth],
        planned=found["planned"].probabilities[truth],
        random=found["random"].probabilities[truth],
        named_before=first.cause == truth,
        named_planned=found["planned"].cause == truth,
        named_random=found["random"].cause == truth,
    )


def table(results: Sequence[Outcome], seen: int) -> Table:
    """Return mean probabilities of the truth and how often it is named."""
    shown = Table(title=f"{len(results)} ambiguous of {seen} cases", title_justify="left")
    for heading in ("", "mean P(true effect)", "95 % interval", "named", "at ≥ 90 %"):
        shown.add_column(heading, justify="left" if not heading else "right")
    rng = np.random.default_rng(0)
    draws = rng.integers(len(results), size=(2000, len(results)))
    for heading, name in (
        ("first log alone", "before"),
        ("with the planned test", "planned"),
        ("with a random drive", "random"),
    ):
        values = np.array([getattr(each, name) for each in results])
        low, high = np.quantile(values[draws].mean(axis=1), (0.025, 0.975))
        named = np.mean([getattr(each, f"named_{name}") for each in results])
        shown.add_row(heading, f"{values.mean():.2f}", f"{low:.2f} … {high:.2f}", f"{named:.0%}",
                      f"{np.mean(values >= 0.9):.0%}")  # fmt: skip
    expected = float(np.mean([each.expected for each in results]))
    shown.caption = f"The plans expected {expected:.2f}."
    return shown


def main() -> int:
    """Run the comparison; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=30, help="ambiguous cases")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--keep", type=Path, help="continue the outcomes in this file")
    given = parser.parse_args()
    results: list[Outcome | None] = []
    if given.keep is not None and given.keep.exists():
        lines = given.keep.read_text(encoding="utf-8").splitlines()
        results = [item and Outcome(**item) for item in map(json.loads, lines)]
    began = time.perf_counter()
    found = outcomes(given.seed, given.minutes, skip=len(results))
    while sum(map(bool, results)) < given.cases:
        results.append(next(found))
        line = json.dumps(results[-1] and asdict(results[-1]))
        print(f"{time.perf_counter() - began:.0f} s: {line}", file=sys.stderr, flush=True)
        if given.keep is not None:
            with given.keep.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
    Console().print(table([each for each in results if each], len(results)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
