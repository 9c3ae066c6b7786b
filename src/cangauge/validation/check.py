"""The sealed file: every cause in one file whose hash is shown before the diagnosis starts.

The whole check: draw and seal, diagnose apart, unseal and score.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import multiprocessing
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from cangauge._io import write_text_atomic
from cangauge._resources import THREADS
from cangauge.errors import InputError
from cangauge.validation.cases import EFFECTS, Group
from cangauge.validation.draw import MODEL, Label, draw_group
from cangauge.validation.held_out_evaluation import judge_later, later_figures, write_model
from cangauge.validation.score import Outcome, outcome_of
from cangauge.validation.workers import Task, diagnose_all

# --- The sealed file: every cause in one file whose hash is shown before the diagnosis starts

LABELS: Final = "labels.json"
SCHEMA: Final = 1


def seal(labels: Sequence[dict[str, Any]], folder: Path) -> str:
    """Write all causes and return the file's SHA-256.

    Parameters
    ----------
    labels : sequence of dict
        Each with the `name` of its case.
    folder : Path
        One that the diagnosis is not told of.
    """
    ordered = sorted(labels, key=lambda label: label["name"])
    path = folder / LABELS
    write_text_atomic(path, json.dumps({"schema": SCHEMA, "labels": ordered}, indent=1) + "\n")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def unseal(folder: Path, sha256: str) -> dict[str, dict[str, Any]]:
    """Return the causes by the name of their case; for the scorer alone.

    Parameters
    ----------
    folder : Path
    sha256 : str
        What was shown before the diagnosis started.

    Raises
    ------
    InputError
        If the file is not the one that was sealed.
    """
    path = folder / LABELS
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"the sealed file cannot be read: {error.strerror}", source=path
        ) from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise InputError(
            "the sealed file is not the one whose hash was shown before the diagnosis",
            source=path,
            value=found,
            cure="draw the cases anew",
        )
    whole = json.loads(content)
    return {label["name"]: label for label in whole["labels"]}


# --- The whole check: draw and seal, diagnose apart, unseal and score

OPEN, SEALED, TASKS, ANSWERS = "open", "sealed", "tasks.json", "answers.jsonl"
OPEN_SET: Final = "open-set"
DECOY_EVERY: Final = 5
"""One in so many open-set requests leaves out an effect that is not the cause, so that the request
does not tell it."""

Progress = Callable[[int], None]


@dataclass(frozen=True)
class Drawn:
    """Cases on the disk, sealed.

    Parameters
    ----------
    folder : Path
        Holds `open/` for the diagnosis and `sealed/` for the scorer.
    sha256 : str
        Of the sealed file.
    tasks : tuple of Task
    about : dict
        Seed, whether it is final, and so on.
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
) -> Drawn:
    """Draw all cases, seal their causes and say what is to be diagnosed.

    Parameters
    ----------
    groups : sequence of Group
    folder : Path
    data : Path, optional
        Folder of the recorded logs.
    jobs : int
        Processes.
    open_set : int
        So many cases of each effect on the simulated plant are diagnosed once more, with that
        effect out of the library.
    about : dict
        To be kept with the cases; `seed` is used.
    progress : callable
        Called with the number of cases drawn.
    """
    place, sealed = folder / OPEN, folder / SEALED
    for path in (place, sealed):
        path.mkdir(parents=True, exist_ok=True)
    labels: list[Label] = []
    with (
        _one_thread(),
        ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool,
    ):
        running = [pool.submit(draw_group, group, place, sealed, data) for group in groups]
        for future in as_completed(running):
            labels += future.result()
            progress(len(future.result()))
    sha256 = seal(labels, sealed)
    tasks = _tasks(labels, open_set, np.random.default_rng([int(about["seed"]), 11]))
    drawn = Drawn(folder, sha256, tasks, about)
    _write(drawn)
    return drawn


def _tasks(labels: Sequence[Label], open_set: int, rng: np.random.Generator) -> tuple[Task, ...]:
    there = sorted(
        (label for label in labels if "failed" not in label), key=lambda label: label["name"]
    )
    asked = [
        Task("", label["name"], label["protocol"], wants_model="judged_on" in label)
        for label in there
    ]
    again: list[Task] = []
    for effect in EFFECTS:
        with_it = [
            label
            for label in there
            if label["protocol"] == "simulated" and label["effects"] == [effect]
        ]
        again += [Task("", label["name"], OPEN_SET, (effect,)) for label in with_it[:open_set]]
    decoys = [
        replace(task, leave_out=(str(rng.choice([e for e in EFFECTS if e not in task.leave_out])),))
        for task in again[:: DECOY_EVERY - 1]
    ]
    asked += again + decoys
    return tuple(
        replace(asked[k], id=f"task_{number:05d}")
        for number, k in enumerate(rng.permutation(len(asked)).tolist(), start=1)
    )


def _write(drawn: Drawn) -> None:
    whole = {
        "schema": SCHEMA,
        **drawn.about,
        "labels_sha256": drawn.sha256,
        "tasks": [asdict(task) for task in drawn.tasks],
    }
    write_text_atomic(drawn.folder / TASKS, json.dumps(whole, indent=1) + "\n")


def drawn_before(folder: Path) -> Drawn:
    """Return the cases that an earlier run kept.

    Raises
    ------
    InputError
        If there are none in the folder.
    """
    path = folder / TASKS
    try:
        whole = json.loads(path.read_text(encoding="utf-8"))
        tasks = tuple(
            Task(**{**task, "leave_out": tuple(task["leave_out"])}) for task in whole.pop("tasks")
        )
        sha256 = str(whole.pop("labels_sha256"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "no cases of an earlier run are in this folder",
            source=folder,
            cure="draw some with --keep FOLDER",
        ) from error
    whole.pop("schema")
    return Drawn(folder, sha256, tasks, whole)


def diagnose_tasks(
    drawn: Drawn, tasks: Sequence[Task], jobs: int, progress: Progress
) -> dict[str, dict[str, Any]]:
    """Return the answer to each task by its id; nothing here opens the sealed file.

    Answers that an earlier run kept are put aside as `answers-1.jsonl`, `answers-2.jsonl`, …

    Parameters
    ----------
    drawn : Drawn
    tasks : sequence of Task
        All of its tasks or some.
    jobs : int
        Processes.
    progress : callable
        Called with the number of answers that came.
    """
    answers = {}
    path = drawn.folder / ANSWERS
    if path.exists():
        path.rename(_free_name(path))
    # Line by line, so that a long check that is stopped can be scored as far as it came.
    with path.open("w", encoding="utf-8") as file:
        for task, answer in diagnose_all(tasks, drawn.folder / OPEN, jobs):
            answers[task.id] = answer
            file.write(json.dumps({"task": task.id, **answer}) + "\n")
            file.flush()
            progress(1)
    return answers


def answers_before(drawn: Drawn) -> dict[str, dict[str, Any]]:
    """Return the answers that an earlier run kept.

    Raises
    ------
    InputError
        If there are none.
    """
    try:
        text = (drawn.folder / ANSWERS).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(
            "no answers of an earlier run are in this folder",
            source=drawn.folder,
            cure="leave out --score-only",
        ) from error
    # The last line may have been cut off when the check was stopped.
    whole = text[: text.rfind("\n") + 1]
    found = [json.loads(line) for line in whole.splitlines()]
    return {item.pop("task"): item for item in found}


def _free_name(path: Path) -> Path:
    numbered = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in itertools.count(1))
    return next(name for name in numbered if not name.exists())


def outcomes_of(
    drawn: Drawn,
    tasks: Sequence[Task],
    answers: dict[str, dict[str, Any]],
    undrawn_of: Collection[str] | None = None,
) -> list[Outcome]:
    """Unseal the causes and return what each answer is worth.

    Cases that could not be drawn or diagnosed are crashes.

    Parameters
    ----------
    drawn : Drawn
    tasks : sequence of Task
    answers : dict
        By the task's id.
    undrawn_of : collection of str, optional
        Protocols whose cases that could not be drawn count; all by default.

    Raises
    ------
    InputError
        If the sealed file is not the one whose hash was shown.
    """
    labels = unseal(drawn.folder / SEALED, drawn.sha256)
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


def some_of(tasks: Sequence[Task], at_most: int | None) -> list[Task]:
    """Return so many tasks at random, always the same ones; all without a number."""
    if at_most is None or at_most >= len(tasks):
        return list(tasks)
    chosen = np.random.default_rng(0).permutation(len(tasks))[:at_most]
    return [tasks[k] for k in sorted(chosen.tolist())]


def later_of(
    drawn: Drawn, tasks: Sequence[Task], answers: dict[str, dict[str, Any]], progress: Progress
) -> dict[str, Any]:
    """Return the figures of extended models on logs that were kept back (see `later`).

    A case without an extended model keeps the plain one.
    """
    labels = unseal(drawn.folder / SEALED, drawn.sha256)
    judged = []
    with TemporaryDirectory(prefix="models-") as folder:
        for task in tasks:
            if not task.wants_model or task.id not in answers:
                continue
            plain = drawn.folder / OPEN / task.case / MODEL
            model = answers[task.id].get("extended_model")
            better = (
                plain if model is None else write_model(model, Path(folder) / f"{task.id}.json")
            )
            judged.append(judge_later(labels[task.case], plain, better, drawn.folder / SEALED))
            progress(1)
    return later_figures(judged)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let the processes that start within use one thread each: the cores are theirs already."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
