"""Rows of a fleet's table: what `estimate`, `gap` or `judge` answers on one log."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import pyarrow as pa
import pyarrow.parquet as pq

from cangauge._extras import require_extra
from cangauge._files import atomic_path
from cangauge._text import plain
from cangauge.cli.options import ReadingOptions
from cangauge.errors import InputError

if TYPE_CHECKING:
    from cangauge.diagnosis import Healthy
    from cangauge.model.model_file import Model

Answer = Literal["estimate", "gap", "judge"]
Row = dict[str, Any]
CONNECT_S: Final = 10.0
"""Time for the scheduler to answer [s]."""


@dataclass(frozen=True, slots=True)
class FleetJob:
    """What is asked about every log.

    Parameters
    ----------
    answer : {"estimate", "gap", "judge"}
        Whose answer a row holds.
    model : Path
        Model file.
    reading : ReadingOptions
        How logs and captures are read.
    references : tuple of Path
        Logs without a fault, for "gap".
    """

    answer: Answer
    model: Path
    reading: ReadingOptions
    references: tuple[Path, ...] = ()

    def row(self, path: Path) -> Row:
        """Return the row of a log; one that fails has its error only.

        Returns
        -------
        dict
            `log`; the numbers and texts of the command's `--json` by dotted names, lists as JSON;
            `notes`, what the command prints on stderr; `error`, None if there is an answer.
        """
        notes = io.StringIO()
        try:
            with redirect_stderr(notes):
                found = dict(_flat(plain(self._ask(path))))
        except Exception as error:  # noqa: BLE001 - one log never stops the others
            return failed(path, error)
        return {"log": str(path), **found, "notes": notes.getvalue().strip(), "error": None}

    def _ask(self, path: Path) -> Mapping[str, Any]:
        asked = {"estimate": _estimated, "gap": _diagnosed, "judge": _judged}
        return asked[self.answer](self, path)


# What computes is imported by the processes that compute, and only what the answer needs.


def _estimated(job: FleetJob, path: Path) -> Mapping[str, Any]:
    from cangauge.cli.estimate import estimate_file
    from cangauge.estimation.settings import EstimatorSettings

    return estimate_file(path, _model(job.model), EstimatorSettings(), job.reading).to_dict()


def _diagnosed(job: FleetJob, path: Path) -> Mapping[str, Any]:
    from cangauge.diagnosis import diagnose
    from cangauge.logs.charge import refuse_contradictions

    log, model = job.reading.load(path), _model(job.model)
    refuse_contradictions([log], model.capacity_ah)
    return diagnose([log], model, _learned(job)).to_json()


def _judged(job: FleetJob, path: Path) -> Mapping[str, Any]:
    from cangauge.extras.judge.judgement import judge

    log = job.reading.load(path)
    return judge([log], _model(job.model), cell_voltages=[job.reading.cells_of(log)]).to_dict()


@lru_cache(maxsize=1)
def _model(path: Path) -> Model:
    from cangauge.model.model_file import Model

    return Model.load(path)


@lru_cache(maxsize=1)
def _learned(job: FleetJob) -> Healthy | tuple[()]:
    """Return what the references show, learned once by each process."""
    from cangauge.diagnosis import learn_references

    if not job.references:
        return ()
    return learn_references([job.reading.load(path) for path in job.references], _model(job.model))


def failed(path: Path, error: BaseException) -> Row:
    """Return the row of a log without an answer."""
    text = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    return {"log": str(path), "error": text}


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list):
            yield prefix + name, json.dumps(value, ensure_ascii=False)
        else:
            yield prefix + name, value


def run(job: FleetJob, logs: Sequence[Path], scheduler: str | None) -> Iterator[Row]:
    """Yield the rows of all logs, as they are finished.

    Parameters
    ----------
    job : FleetJob
    logs : sequence of Path
    scheduler : str, optional
        Address of a Dask scheduler, whose workers see the same files; None: a process for each
        core of this machine.

    Raises
    ------
    InputError
        If the scheduler does not answer, or Dask is not installed.
    """
    with _pool(scheduler, len(logs)) as pool:
        paths: dict[Future[Row], Path] = {pool.submit(job.row, path): path for path in logs}
        for future in as_completed(paths):
            error = future.exception()  # a process that died
            yield future.result() if error is None else failed(paths[future], error)


@contextmanager
def _pool(scheduler: str | None, logs: int) -> Iterator[Executor]:
    if scheduler is None:
        # Not forked: the threads of a library would be lost, and its locks kept.
        with ProcessPoolExecutor(min(logs, os.cpu_count() or 1), get_context("spawn")) as pool:
            yield pool
        return
    require_extra("fleet", "--scheduler")
    from distributed import Client

    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"does not answer: {error}",
            field="--scheduler",
            value=scheduler,
            cure="start `dask scheduler` and `dask worker`, and give its address",
        ) from error
    with client:
        yield client.get_executor(pure=False)


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write a Parquet table with the columns of all rows."""
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: pa.array([row.get(name) for row in rows]) for name in names}
    with atomic_path(path) as part:
        pq.write_table(pa.table(columns), part)
