"""A second opinion on the battery's own SoC while the service runs: `[judge]`.

Samples are kept, one a second, with the SoC that the battery publishes. A stretch of them ends
with a pause of ten minutes, after a day, or with the service. It is written as a log, and all logs
are judged by `cangauge judge` in a process of its own. The logs outlive a restart.
"""

from __future__ import annotations

import json
import logging
import math
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cangauge._extras import require_extra
from cangauge._files import make_folder, write_text_atomic
from cangauge._logging import emit
from cangauge.errors import InputError
from cangauge.extras.judge.chain import LONGEST_S, PARTED_S, SHORTEST_S
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

WITHIN_S: Final = 900.0
"""Longest judgement [s]: fifteen days of driving take a minute on a small computer."""
RESULT: Final = "judgement.json"
PAGE: Final = "judgement.html"
_NUMBER: Final = re.compile(r"\d+")

_LOG = logging.getLogger(__name__)


def stored_logs(folder: Path) -> list[Path]:
    """Return the logs in a folder in the order in which they were written."""
    # A hidden one is what a killed service was writing.
    return sorted(path for path in folder.glob("*.parquet") if not path.name.startswith("."))


def store(folder: Path, keep: int, rows: Sequence[Sequence[float]]) -> None:
    """Write rows as a log, and remove the oldest beyond `keep`.

    Its name begins with a number, since a date repeats and goes back where the clock is set.

    Parameters
    ----------
    folder : Path
    keep : int
    rows : sequence
        Time, current, voltage, temperature and published SoC of each.
    """
    time_s, current_a, voltage_v, temperature_c, soc_pct = np.array(rows).T
    last = [int(digits[0]) for log in stored_logs(folder) if (digits := _NUMBER.match(log.name))]
    name = f"{max(last, default=0) + 1:06d}-{datetime.now(UTC):%Y%m%dT%H%M%S}"
    log = Log(time_s, current_a, voltage_v, temperature_c, soc_pct=soc_pct, name=name)
    write_log(log, folder / f"{name}.parquet")
    for old in stored_logs(folder)[:-keep]:
        old.unlink()


class LiveJudge(Output):
    """Keep samples, and have them judged at the end of each stretch.

    Parameters
    ----------
    folder : Path
        Of the logs, the result and its page.
    keep : int
        Logs; the oldest are removed.
    command : sequence of str
        Judges the logs that follow; prints the object of `cangauge judge --json`.
    published_pct : callable
        Returns the SoC that the battery published last [%]; NaN before. A value that is no SoC is
        kept as NaN: a log with one would be refused, and with it the judgement of all.
    """

    def __init__(
        self,
        folder: Path,
        keep: int,
        command: Sequence[str],
        published_pct: Callable[[], float],
    ) -> None:
        self._folder, self._keep, self._command = folder, keep, command
        self._published_pct = published_pct
        self._rows: list[tuple[float, ...]] = []
        self._came_s = math.inf
        self._worker = Worker("cangauge-judge", _failed, jobs_at_most=2)
        newest_s = max((log.stat().st_mtime for log in stored_logs(folder)), default=0.0)
        result = folder / RESULT
        if newest_s > (result.stat().st_mtime if result.is_file() else 0.0):
            self._worker.submit(self._judge)

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        """Keep a sample a second; a pause before it ends the stretch."""
        del estimate
        self._came_s = time.monotonic()
        if any(map(math.isnan, sample[:4])):
            return
        if self._rows:
            since_s = sample.time_s - self._rows[-1][0]
            whole_s = sample.time_s - self._rows[0][0]
            if not 0.0 <= since_s <= PARTED_S or whole_s > LONGEST_S:
                self._end_stretch()
            elif since_s < 1.0:
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
        if not self._worker.close(2.0):
            _failed(
                TimeoutError("a judgement was not over at the end; its last logs may be missing")
            )

    def _end_stretch(self, *, is_judged: bool = True) -> None:
        rows, self._rows = self._rows, []
        if not rows or rows[-1][0] - rows[0][0] < SHORTEST_S:
            return

        def work() -> None:
            store(self._folder, self._keep, rows)
            if is_judged:
                self._judge()

        if not self._worker.submit(work):
            _failed(TimeoutError("earlier judgements take too long; a log was dropped"))

    def _judge(self) -> None:
        """Judge all logs; write the result and a page; raise InputError with the reason if not."""
        command = [*self._command, *map(str, stored_logs(self._folder))]
        command += ["--report", str(self._folder / PAGE), "--json"]
        ended = subprocess.run(  # noqa: S603 - our own command
            command, capture_output=True, text=True, check=False, timeout=WITHIN_S
        )
        result: dict[str, Any] = json.loads(ended.stdout or "{}")
        if ended.returncode != 0:
            raise InputError(result.get("error", {}).get("message", ended.stderr.strip()[-500:]))
        write_text_atomic(self._folder / RESULT, ended.stdout)
        text = "second opinion on the battery's own SoC: " + result["text"].replace("\n", " ")
        is_off = result["now"]["verdict"] == "off"
        self.trouble = text if is_off else ""
        emit(_LOG.warning if is_off else _LOG.info, "judge.result", text)


def _failed(error: Exception) -> None:
    text = f"the battery's own SoC was not judged: {error}"
    emit(_LOG.warning, "judge.failed", text)


def output_of(config: RunConfig, vehicle: Vehicle) -> Callable[[Service], LiveJudge]:
    """Make the folder; return what makes the judge that a configuration asks for.

    Raises
    ------
    InputError
        If the vehicle has no SoC of its own, or the folder cannot be made.
    """
    asked = config.judge
    if asked is None:
        raise ValueError("no [judge]")
    if vehicle.soc_reference is None:
        raise InputError(
            "the vehicle has no SoC of its own",
            field="judge",
            cure="name its signal under [soc] of the map file",
        )
    require_extra("report", "judge")
    command = [sys.executable, "-P", "-m", "cangauge", "judge", "-m", str(config.model)]
    if config.capacity_ah is not None:
        command += ["--capacity-ah", str(config.capacity_ah)]

    def make_output(service: Service) -> LiveJudge:
        folder = Path(asked.folder)
        try:
            make_folder(folder)
        except OSError as error:
            raise InputError(f"cannot be made: {error.strerror}", field="judge.folder") from error

        def published_pct() -> float:  # a reload brings another decoder
            return service.pipeline.decoder.reference_soc_pct

        return LiveJudge(folder, asked.keep, command, published_pct)

    return make_output
