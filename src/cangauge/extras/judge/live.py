"""A second opinion on the battery's own SoC while the service runs: `[judge]`.

Samples are kept, one a second, with the SoC that the battery publishes. A stretch of them ends
with a pause of ten minutes, after a day, or with the service; it is written as a log, and all logs
are judged by `cangauge judge` in a process of its own. The logs outlive a restart.
"""

from __future__ import annotations

import json
import logging
import math
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cangauge._extras import require_extra
from cangauge._files import write_text_atomic
from cangauge._logging import emit
from cangauge.errors import InputError
from cangauge.extras.judge.chain import PARTED_S, SHORTEST_S
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot
from cangauge.service.worker import Worker
from cangauge.types import Estimate, Sample

if TYPE_CHECKING:
    from cangauge.bus.vehicle import Vehicle
    from cangauge.service.config import RunConfig
    from cangauge.service.run import Service

ROW_EVERY_S: Final = 1.0
LONGEST_S: Final = 86400.0
"""A storage battery never pauses: its logs are of a day [s]."""
WITHIN_S: Final = 900.0
"""Longest judgement [s]: fifteen days of driving take a minute on a small computer."""
CLOSE_WITHIN_S: Final = 2.0
RESULT: Final = "judgement.json"
PAGE: Final = "judgement.html"

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Stored:
    """Where the logs lie, how many are kept, and what judges them.

    Parameters
    ----------
    folder : Path
    keep : int
        Logs; the oldest are removed.
    command : tuple of str
        Judges the logs that follow; prints the object of `cangauge judge --json`.
    """

    folder: Path
    keep: int
    command: tuple[str, ...]

    def logs(self) -> list[Path]:
        """Return the logs in order of time."""
        found = self.folder.glob("*.parquet")
        # A hidden one is what a killed service was writing.
        return sorted(path for path in found if not path.name.startswith("."))

    def is_judged(self) -> bool:
        """Return whether the result is younger than the newest log."""
        result = self.folder / RESULT
        newest_s = max((log.stat().st_mtime for log in self.logs()), default=0.0)
        return newest_s <= (result.stat().st_mtime if result.is_file() else 0.0)

    def put(self, rows: list[tuple[float, ...]]) -> None:
        """Write rows of time, current, voltage, temperature and published SoC as a log."""
        time_s, current_a, voltage_v, temperature_c, soc_pct = np.array(rows).T
        name = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        log = Log(time_s, current_a, voltage_v, temperature_c, soc_pct=soc_pct, name=name)
        write_log(log, self.folder / f"{name}.parquet")
        for old in self.logs()[: -self.keep]:
            old.unlink()

    def judge(self) -> dict[str, Any]:
        """Judge all logs; write the result, and a page; raise InputError with the reason if not."""
        command = [*self.command, *map(str, self.logs())]
        command += ["--report", str(self.folder / PAGE), "--json"]
        ended = subprocess.run(  # noqa: S603 - our own command
            command, capture_output=True, text=True, check=False, timeout=WITHIN_S
        )
        result: dict[str, Any] = json.loads(ended.stdout or "{}")
        if ended.returncode != 0:
            problem = result.get("error", {}).get("message", ended.stderr.strip()[-500:])
            raise InputError(problem)
        write_text_atomic(self.folder / RESULT, ended.stdout)
        return result


class LiveJudge(Output):
    """Keep samples, and have them judged at the end of each stretch.

    Parameters
    ----------
    stored : Stored
    published_pct : callable
        Returns the SoC that the battery published last [%]; NaN before. A value that is no SoC is
        kept as NaN: a log with one would be refused, and with it the judgement of all.
    """

    def __init__(self, stored: Stored, published_pct: Callable[[], float]) -> None:
        self._stored, self._published_pct = stored, published_pct
        self._rows: list[tuple[float, ...]] = []
        self._came_s = math.inf
        self._worker = Worker("cangauge-judge", self._failed, jobs_at_most=2)
        if not stored.is_judged():
            self._worker.submit(self._judge)

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        """Keep a sample a second; a pause before it ends the stretch."""
        del estimate
        self._came_s = time.monotonic()
        if any(map(math.isnan, sample[:4])):
            return
        if self._rows:
            since_s = sample.time_s - self._rows[-1][0]
            if since_s < 0.0 or since_s > PARTED_S or sample.time_s - self._rows[0][0] > LONGEST_S:
                self._end_stretch()
            elif since_s < ROW_EVERY_S:
                return
        soc_pct = self._published_pct()
        self._rows.append((*sample[:4], soc_pct if 0.0 <= soc_pct <= 100.0 else math.nan))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """End the stretch in a pause."""
        if self._rows and snapshot.made_s - self._came_s > PARTED_S:
            self._end_stretch()

    def close(self) -> None:
        """Write what is kept; it is judged at the next start, and the last result stays."""
        self._end_stretch(is_judged=False)
        self._worker.close(CLOSE_WITHIN_S)

    def _end_stretch(self, *, is_judged: bool = True) -> None:
        rows, self._rows = self._rows, []
        if not rows or rows[-1][0] - rows[0][0] < SHORTEST_S:
            return

        def work() -> None:
            self._stored.put(rows)
            if is_judged:
                self._judge()

        self._worker.submit(work)

    def _judge(self) -> None:
        result = self._stored.judge()
        text = "second opinion on the battery's own SoC: " + result["text"].replace("\n", " ")
        is_off = result["now"]["verdict"] == "off"
        self.trouble = text if is_off else ""
        emit(_LOG, logging.WARNING if is_off else logging.INFO, "judge.result", text)

    @staticmethod
    def _failed(error: Exception) -> None:
        text = f"the battery's own SoC was not judged: {error}"
        emit(_LOG, logging.WARNING, "judge.failed", text)


def output_of(_config: RunConfig, vehicle: Vehicle) -> Callable[[Service], LiveJudge]:
    """Return what makes the judge that a configuration asks for; may raise InputError."""
    if vehicle.soc_reference is None:
        raise InputError(
            "the vehicle has no SoC of its own",
            field="judge",
            cure="name its signal under [soc] of the map file",
        )
    require_extra("report", "judge")
    return make_output


def make_output(service: Service) -> LiveJudge:
    """Make the folder and return the judge; may raise InputError."""
    config = service.config
    if config.judge is None:
        raise ValueError("no [judge]")
    folder = Path(config.judge.folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made: {error.strerror}", field="judge.folder") from error
    command = [sys.executable, "-P", "-m", "cangauge", "judge", "-m", config.model]
    if config.capacity_ah is not None:
        command += ["--capacity-ah", str(config.capacity_ah)]
    stored = Stored(folder, config.judge.keep, tuple(command))
    return LiveJudge(stored, lambda: service.pipeline.decoder.reference_soc_pct)
