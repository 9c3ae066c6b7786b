"""A Dask client that computes in this process, for tests that need no cluster."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import pytest

from cangauge.errors import InputError
from cangauge.extras.fleet.jobs import TEXT, Job
from cangauge.extras.fleet.sources import FleetLog, ReadOptions


@dataclass(frozen=True)
class Done:
    """A future with its result."""

    key: str
    result: Any
    status: str = "finished"

    def exception(self) -> Exception:
        error = self.result[1]
        assert isinstance(error, Exception)
        return error


class Here:
    """Client, and iterator of the finished tasks."""

    loop = None

    def __init__(self, monkeypatch: pytest.MonkeyPatch, while_waiting: Callable[[], None]) -> None:
        distributed = pytest.importorskip("distributed")
        monkeypatch.setattr(distributed, "as_completed", lambda **_: self)
        self._done: deque[Done] = deque()
        self._looks = 0
        self._while_waiting = while_waiting

    def submit(self, work: Callable[..., Any], *given: Any, key: str, pure: bool = True) -> Done:
        del pure
        for each in given:
            if isinstance(each, Done) and each.status == "error":
                return Done(key, each.result, "error")
        plain = [each.result if isinstance(each, Done) else each for each in given]
        try:
            return Done(key, work(*plain))
        except Exception as error:  # noqa: BLE001 - kept in the future, as by distributed
            return Done(key, (type(error), error, None), "error")

    def nthreads(self) -> dict[str, int]:
        return {"here": 1}

    def add(self, done: Done) -> None:
        self._done.append(done)

    def has_ready(self) -> bool:
        """Answer three of four questions by no, as while a task takes long."""
        self._looks += 1
        if self._looks % 4:
            self._while_waiting()
        return not self._looks % 4

    def __next__(self) -> tuple[Done, Any]:
        done = self._done.popleft()
        return done, done.result


@dataclass(frozen=True, eq=False)
class NotingJob(Job):
    """Its state names the logs that led to it; it needs `initial_soc_pct` of some."""

    options: ReadOptions = field(default_factory=ReadOptions)

    kind: ClassVar[str] = "noting"
    columns: ClassVar[dict[str, Any]] = {"state": TEXT}
    needs_soc: ClassVar[set[str]] = set()
    fails: ClassVar[set[str]] = set()

    def identity(self) -> dict[str, Any]:
        return {}

    def row(self, log: FleetLog, path: Path | None, state: str | None) -> dict[str, Any]:
        assert path is not None
        if path.stem in self.fails:
            raise OSError("connection reset")
        if path.stem in self.needs_soc and log.initial_soc_pct is None:
            raise InputError("SoC at start unknown", value=path.stem)
        soc = "" if log.initial_soc_pct is None else f"{log.initial_soc_pct:.0f}"
        return {"state": f"{state or ''}{path.stem}{soc}"}


@dataclass(frozen=True, eq=False)
class ChainedJob(NotingJob):
    kind: ClassVar[str] = "chained"
    is_chained: ClassVar[bool] = True
