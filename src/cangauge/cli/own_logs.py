"""`cangauge gap-check` on one's own healthy logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import Progress

from cangauge._io import write_text_atomic
from cangauge.cli.options import assumed_of, check_outputs, within
from cangauge.cli.output import emit_json, note, print_table

if TYPE_CHECKING:
    from cangauge.extras.validation.own_logs import Finding, Healthy
    from cangauge.logs.log import Log
    from cangauge.model.model_file import Model


@dataclass(frozen=True, slots=True)
class OwnLogsOptions:
    """Own logs to check the diagnosis on.

    Parameters
    ----------
    logs, references : list of Path
        Each of `logs` is left out in turn, `references` never.
    model : Path, optional
    capacity_ah : float, optional
    at_most : int, optional
        Number of logs to leave out.
    report : Path, optional
    json_output : bool
    """

    logs: list[Path]
    references: list[Path]
    model: Path | None
    capacity_ah: float | None
    at_most: int | None
    report: Path | None
    json_output: bool

    def check(self, read: Callable[[Path], Log], progress: Progress) -> None:
        """Inject every effect into the logs, diagnose, and print what was found.

        Raises
        ------
        InputError
            If a log cannot be read or diagnosed, or there are too few.
        """
        from cangauge.extras.validation.own_logs import PER_LOG, OwnLogs, summarize

        inputs = [*self.logs, *self.references, *([self.model] if self.model else [])]
        check_outputs([self.report], inputs)
        within(self.capacity_ah, 1e-3, 1e5, option="--capacity-ah", unit="Ah")
        own = OwnLogs(
            tuple(read(path) for path in self.logs),
            tuple(read(path) for path in self.references),
            self._model(),
            self.capacity_ah,
        )
        found: list[Healthy | Finding] = []
        left_out = len(own.left_out(self.at_most))
        with progress:
            running = progress.add_task("diagnosing", total=left_out * PER_LOG)
            for item in own.findings(self.at_most):
                found.append(item)
                progress.advance(running)
            progress.update(running, completed=left_out * PER_LOG)
        result = summarize(found)
        self._show(result | {"assumed": assumed_of([*own.logs, *own.references])})

    def _model(self) -> Model | None:
        from cangauge.model.model_file import Model

        if self.model is None:
            return None
        model = Model.load(self.model)
        if self.capacity_ah is None:
            return model
        return model.model_copy(update={"capacity_ah": self.capacity_ah})

    def _show(self, result: dict[str, Any]) -> None:
        from cangauge.extras.validation.own_logs import summary, table

        if self.report is not None:
            # bokeh takes half a second to import.
            from cangauge.extras.report.check import own_logs_report

            write_text_atomic(self.report, own_logs_report(result))
            note(f"report: {self.report}")
        if self.json_output:
            emit_json(result)
            return
        print_table("What this diagnosis would find on this pack", *table(result))
        note(summary(result))
