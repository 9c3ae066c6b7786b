"""The withheld check: draw cases, withhold their causes, diagnose, score.

All causes are in one label file, whose hash is printed before the diagnosis starts. Extended models
of laboratory cases are also evaluated on held-out logs.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import multiprocessing
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from cangauge._io import write_text_atomic
from cangauge._resources import single_threaded
from cangauge.errors import InputError
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.validation.generation import MODEL, Label, draw_group
from cangauge.extras.validation.plan import EFFECTS, Group
from cangauge.extras.validation.score import Outcome, outcome_of
from cangauge.extras.validation.worker_pool import Task, diagnose_all
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.model_file import Model

OPEN, WITHHELD, TASKS, ANSWERS = "open", "withheld", "tasks.json", "answers.jsonl"
LABELS: Final = "labels.json"
SCHEMA: Final = 1
OPEN_SET: Final = "open-set"
_CONTROL_EVERY: Final = 5
"""One open-set task in this many leaves out an effect that is not the cause, so that the request
does not reveal the cause."""

_SETTLING_S: Final = 300.0
"""Time after which the SoC of the EKF is evaluated; it does not get the initial SoC [s]."""

Progress = Callable[[int], None]


def write_labels(labels: Sequence[dict[str, Any]], folder: Path) -> str:
    """Write all labels to one file, sorted by case, and return its SHA-256."""
    ordered = sorted(labels, key=lambda label: label["name"])
    path = folder / LABELS
    write_text_atomic(path, json.dumps({"schema": SCHEMA, "labels": ordered}, indent=1) + "\n")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_labels(folder: Path, sha256: str) -> dict[str, dict[str, Any]]:
    """Return the labels by case, for the scorer alone.

    Raises
    ------
    InputError
        If the file cannot be read, or its hash is not the one printed before the diagnosis.
    """
    path = folder / LABELS
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"the labels cannot be read: {error.strerror}", source=path) from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise InputError(
            "the labels changed: another hash was printed before the diagnosis",
            source=path,
            value=found,
            cure="draw the cases again",
        )
    whole = json.loads(content)
    return {label["name"]: label for label in whole["labels"]}


@dataclass(frozen=True)
class CheckFiles:
    """Files of a check.

    Parameters
    ----------
    folder : Path
        With `open/` for the diagnosis and `withheld/` for the scorer.
    sha256 : str
        Hash of the labels.
    tasks : tuple of Task
    about : dict
        Seed of the plan, and whether it is final.
    """

    folder: Path
    sha256: str
    tasks: tuple[Task, ...]
    about: dict[str, Any]


def draw_all(
    groups: Sequence[Group],
    folder: Path,
    *,
    data: Path | None,
    jobs: int,
    open_set: int,
    about: dict[str, Any],
    progress: Progress,
) -> CheckFiles:
    """Draw all cases, write files and labels, and list the diagnoses to run.

    Parameters
    ----------
    groups : sequence of Group
    folder : Path
    data : Path, optional
        Folder of the recorded logs.
    jobs : int
        Number of processes.
    open_set : int
        Simulated cases of each effect that are diagnosed again without it in the library.
    about : dict
        Stored with the cases; `seed` shuffles the tasks.
    progress : callable
        Called with the number of cases drawn.
    """
    place, withheld = folder / OPEN, folder / WITHHELD
    for path in (place, withheld):
        path.mkdir(parents=True, exist_ok=True)
    labels: list[Label] = []
    with (
        single_threaded(),
        ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool,
    ):
        running = [pool.submit(draw_group, group, place, withheld, data) for group in groups]
        for future in as_completed(running):
            labels += future.result()
            progress(len(future.result()))
    sha256 = write_labels(labels, withheld)
    tasks = _tasks(labels, open_set, np.random.default_rng([int(about["seed"]), 11]))
    content = {
        "schema": SCHEMA,
        **about,
        "labels_sha256": sha256,
        "tasks": [asdict(task) for task in tasks],
    }
    write_text_atomic(folder / TASKS, json.dumps(content, indent=1) + "\n")
    return CheckFiles(folder, sha256, tasks, about)


def _tasks(labels: Sequence[Label], open_set: int, rng: np.random.Generator) -> tuple[Task, ...]:
    drawn = sorted(
        (label for label in labels if "failed" not in label), key=lambda label: label["name"]
    )
    tasks = [
        Task("", label["name"], label["protocol"], wants_model="judged_on" in label)
        for label in drawn
    ]
    open_set_tasks: list[Task] = []
    for effect in EFFECTS:
        of_effect = [
            label
            for label in drawn
            if label["protocol"] == "simulated" and label["effects"] == [effect]
        ]
        open_set_tasks += [
            Task("", label["name"], OPEN_SET, (effect,)) for label in of_effect[:open_set]
        ]
    controls = [
        replace(task, leave_out=(str(rng.choice([e for e in EFFECTS if e not in task.leave_out])),))
        for task in open_set_tasks[:: _CONTROL_EVERY - 1]
    ]
    tasks += open_set_tasks + controls
    return tuple(
        replace(tasks[k], id=f"task_{number:05d}")
        for number, k in enumerate(rng.permutation(len(tasks)).tolist(), start=1)
    )


def load_files(folder: Path) -> CheckFiles:
    """Return the cases that an earlier check kept; raise InputError if there are none."""
    path = folder / TASKS
    try:
        whole = json.loads(path.read_text(encoding="utf-8"))
        tasks = tuple(
            Task(**{**task, "leave_out": tuple(task["leave_out"])}) for task in whole.pop("tasks")
        )
        sha256 = str(whole.pop("labels_sha256"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "no cases of an earlier check in this folder",
            source=folder,
            cure="draw some with --keep FOLDER",
        ) from error
    whole.pop("schema")
    return CheckFiles(folder, sha256, tasks, whole)


def diagnose_tasks(
    files: CheckFiles, tasks: Sequence[Task], jobs: int, progress: Progress
) -> dict[str, dict[str, Any]]:
    """Diagnose tasks without access to the labels; return the answers by task id.

    Answers of an earlier check are renamed to `answers-1.jsonl`, `answers-2.jsonl`, …

    Parameters
    ----------
    files : CheckFiles
    tasks : sequence of Task
    jobs : int
        Number of processes.
    progress : callable
        Called with the number of answers received.
    """
    answers = {}
    path = files.folder / ANSWERS
    if path.exists():
        path.rename(_free_name(path))
    # Line by line, so that an interrupted check can be scored.
    with path.open("w", encoding="utf-8") as file:
        for task, answer in diagnose_all(tasks, files.folder / OPEN, jobs):
            answers[task.id] = answer
            file.write(json.dumps({"task": task.id, **answer}) + "\n")
            file.flush()
            progress(1)
    return answers


def load_answers(files: CheckFiles) -> dict[str, dict[str, Any]]:
    """Return the answers that an earlier check kept; raise InputError if there are none."""
    try:
        text = (files.folder / ANSWERS).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(
            "no answers of an earlier check in this folder",
            source=files.folder,
            cure="leave out --score-only",
        ) from error
    # The last line is incomplete if the check was interrupted.
    whole = text[: text.rfind("\n") + 1]
    found = [json.loads(line) for line in whole.splitlines()]
    return {item.pop("task"): item for item in found}


def _free_name(path: Path) -> Path:
    numbered = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in itertools.count(1))
    return next(name for name in numbered if not name.exists())


def score_answers(
    files: CheckFiles,
    tasks: Sequence[Task],
    answers: dict[str, dict[str, Any]],
    undrawn_of: Collection[str] | None = None,
) -> list[Outcome]:
    """Compare answers with the labels; cases that could not be drawn or diagnosed are crashes.

    Parameters
    ----------
    files : CheckFiles
    tasks : sequence of Task
    answers : dict
        By task id.
    undrawn_of : collection of str, optional
        Protocols whose undrawn cases count; by default all.

    Raises
    ------
    InputError
        If the labels changed.
    """
    labels = read_labels(files.folder / WITHHELD, files.sha256)
    outcomes = [
        outcome_of(task, labels[task.case], answers[task.id])
        for task in tasks
        if task.id in answers
    ]
    for name, label in labels.items():
        if "failed" in label and (undrawn_of is None or label["protocol"] in undrawn_of):
            task = Task(f"undrawn_{name}", name, label["protocol"])
            outcomes.append(outcome_of(task, label, {"error": label["failed"]}))
    return outcomes


def sample_tasks(tasks: Sequence[Task], at_most: int | None) -> list[Task]:
    """Return at most this many tasks, drawn with a fixed seed."""
    if at_most is None or at_most >= len(tasks):
        return list(tasks)
    chosen = np.random.default_rng(0).permutation(len(tasks))[:at_most]
    return [tasks[k] for k in sorted(chosen.tolist())]


def evaluate_held_out(
    files: CheckFiles, tasks: Sequence[Task], answers: dict[str, dict[str, Any]], progress: Progress
) -> dict[str, Any]:
    """Return the errors of plain and extended models on logs that the diagnosis did not get.

    A case without an extended model counts with the plain one.
    """
    labels = read_labels(files.folder / WITHHELD, files.sha256)
    errors = []
    with TemporaryDirectory(prefix="models-") as folder:
        for task in tasks:
            if not task.wants_model or task.id not in answers:
                continue
            plain = files.folder / OPEN / task.case / MODEL
            model = answers[task.id].get("extended_model")
            better = plain
            if model is not None:
                better = Path(folder) / f"{task.id}.json"
                better.write_text(json.dumps(model), encoding="utf-8")
            errors.append(_model_errors(labels[task.case], plain, better, files.folder / WITHHELD))
            progress(1)
    return _pool_errors(errors)


def _model_errors(
    label: Mapping[str, Any], plain: Path, extended: Path, withheld: Path
) -> dict[str, Any]:
    """Return the errors of plain and extended model on the held-out logs of a case.

    Parameters
    ----------
    label : mapping
        Its `judged_on` names the held-out logs by group.
    plain, extended : Path
        Model files.
    withheld : Path
        Folder of the held-out logs.

    Returns
    -------
    dict
        Group → list of `{"log", "plain": {…}, "extended": {…}}`, with errors as sums and counts to
        be pooled.
    """
    models = {"plain": Model.load(plain), "extended": Model.load(extended)}
    return {
        group: [
            {"log": item["log"]}
            | {
                name: _log_errors(read_log(withheld / item["file"]), model)
                for name, model in models.items()
            }
            for item in items
        ]
        for group, items in label["judged_on"].items()
    }


def _log_errors(log: Log, model: Model) -> dict[str, float]:
    """Return sums of squared voltage errors and of absolute SoC errors of one log.

    The voltage is predicted at the counted SoC, where the delay line is full. The SoC is that of
    the EKF without an initial SoC, after `_SETTLING_S`.
    """
    start = log.first_soc()
    # Counting starts at the first SoC.
    rows = log.rows(slice(0 if start is None else start[0], None))
    known = EstimatorSettings(method="coulomb", initial_soc_pct=None if start is None else start[1])
    voltage = run_estimator(samples_of(rows), model, known).residual_v
    full = rows.time_s - rows.time_s[0] >= max(model.delays_s)
    voltage = voltage[full & np.isfinite(voltage)]
    found = run_estimator(samples_of(log), model, EstimatorSettings())
    reference = np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct
    error = found.soc_pct - reference
    error = error[np.isfinite(error) & (log.time_s - log.time_s[0] >= _SETTLING_S)]
    return {
        "voltage_squares": float(np.sum(voltage**2)),
        "voltage_rows": float(voltage.size),
        "soc_absolute": float(np.sum(np.abs(error))),
        "soc_rows": float(error.size),
    }


def _pooled(items: Sequence[Mapping[str, Any]], name: str) -> dict[str, float | None]:
    """Return voltage RMSE [V] and SoC MAE [%] of one model over all logs."""

    def total(key: str) -> float:
        return float(sum(item[name][key] for item in items))

    rows, soc_rows = total("voltage_rows"), total("soc_rows")
    return {
        "rmse_v": float(np.sqrt(total("voltage_squares") / rows)) if rows else None,
        "soc_mae_pct": total("soc_absolute") / soc_rows if soc_rows else None,
    }


def _pool_errors(errors: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the errors of each group of held-out logs, pooled and by log."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for item in errors:
        for group, logs in item.items():
            groups.setdefault(group, []).extend(logs)
    return {
        group: {
            "plain": _pooled(logs, "plain"),
            "extended": _pooled(logs, "extended"),
            "logs": [
                {
                    "log": log["log"],
                    "plain": _pooled([log], "plain"),
                    "extended": _pooled([log], "extended"),
                }
                for log in logs
            ],
        }
        for group, logs in groups.items()
    }
