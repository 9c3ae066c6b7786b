"""Options of `cangauge gap` that plan the next test and add one to a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from cangauge._formatting import printable
from cangauge.cli.output import note, print_table
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.diagnosis import Diagnosis
    from cangauge.diagnosis.next_test import NextSteps
    from cangauge.diagnosis.verdict import Verdict


@dataclass(frozen=True, slots=True)
class NextTestOptions:
    """`--plan`, `--plan-file` and `--limits`.

    Parameters
    ----------
    plan : bool
    file : Path, optional
        Of the proposed test's profile; implies `plan`.
    limits : str, optional
        Implies `plan`.

    Raises
    ------
    InputError
        If the limits cannot be understood.
    """

    plan: bool
    file: Path | None
    limits: str | None

    def __post_init__(self) -> None:
        # Before any long work; the defaults are those of the diagnosis.
        from cangauge.diagnosis.profiles import Limits
        from cangauge.model.effects.base import WITHIN_C

        Limits(1.0, 1.0, (0.0, 100.0), WITHIN_C).changed(self.limits or "").require_room()

    def steps(self, found: Diagnosis, first: Verdict | None, tests: Sequence[str]) -> NextSteps:
        """Return what an added test changed, and the plan, as far as asked for.

        Parameters
        ----------
        found : Diagnosis
            Including the added tests.
        first : Verdict, optional
            Without them.
        tests : sequence of str
            Their names.
        """
        from cangauge.diagnosis.next_test import AddedTest, NextSteps, plan_test
        from cangauge.diagnosis.profiles import Limits

        added = None if first is None else AddedTest(tuple(tests), first, found.verdict)
        if not self.plan and self.file is None and self.limits is None:
            return NextSteps(added)
        try:
            limits = Limits.of(found.problem).changed(self.limits or "")
            return NextSteps(added, plan_test(found.problem, found.verdict, limits))
        except InputError as error:  # the diagnosis stands without it
            note(f"no plan: {error}")
            return NextSteps(added)

    def texts(self, steps: NextSteps) -> dict[Path, str]:
        """Return the file to write with its content."""
        if steps.plan is None or self.file is None:
            return {}
        if not steps.plan.helps:
            note(f"warning: {self.file}: the best of the tests, but none is expected to help")
        return {self.file: steps.plan.best.profile.to_csv()}

    def to_dict(self, steps: NextSteps) -> dict[str, Any]:
        """Return what `cangauge gap --json` adds."""
        result = {} if steps.added is None else {"added_test": steps.added.to_dict()}
        if steps.plan is not None:
            result["plan"] = steps.plan.to_dict(None if self.file is None else str(self.file))
        return result


def show_tests(steps: NextSteps) -> None:
    """Print what an added test changed, and the planned tests."""
    from cangauge.extras.report.summary import PLAN_TITLE, plan_rows

    if steps.added is not None:
        typer.echo(printable(steps.added.sentence))
    if steps.plan is not None:
        typer.echo(printable(steps.plan.sentence))
        print_table(PLAN_TITLE, *plan_rows(steps.plan))
