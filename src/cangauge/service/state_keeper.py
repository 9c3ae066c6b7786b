"""Keeps the gauge's state in a file: read and checked at the start, written as the service runs.

Nothing that happens to the file stops the estimator: it is told of in one line, at most once a
minute, and the service goes on without.
"""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from cangauge.atomic import write_text_atomic
from cangauge.errors import CangaugeError, InputError
from cangauge.report.words import duration, number
from cangauge.service.background import BackgroundWriter
from cangauge.service.gauge import Gauge
from cangauge.service.state_file import (
    StateContent,
    boot_id,
    model_fingerprint,
    read_state,
    state_text,
)
from cangauge.service.upkeep import CHECKPOINT_EVERY_S

FILE_NAME: Final = "cangauge-state.json"
"""What the file is called in a folder."""

WARN_EVERY_S: Final = 60.0

STOP_WITHIN_S: Final = 0.7
"""How long the last writing may take when the service ends [s]."""

REBOOT_S: Final = 600.0
"""After the machine was off, its clock may have stood still: the pause counts as at least this
[s]."""

FUTURE_S: Final = 60.0
"""A state so much from the future was written under another clock [s]."""

DAMAGED_SUFFIX: Final = ".refused"


@dataclass(frozen=True)
class StateSettings:
    """Where the state is kept.

    Parameters
    ----------
    path : Path
    max_age_s : float
        An older one is refused [s].
    every_s : float
        How often it is written [s].
    """

    path: Path
    max_age_s: float = 7.0 * 86400.0
    every_s: float = CHECKPOINT_EVERY_S


def state_path(given: str | None, environment: Mapping[str, str]) -> Path | None:
    """Return where the state is to be kept, if anywhere.

    A folder stands for a file in it. If none is given but systemd made a folder for the service
    (`StateDirectory=`), it is there.
    """
    folders = environment.get("STATE_DIRECTORY", "").split(":")
    chosen = given or folders[0]
    if not chosen:
        return None
    path = Path(chosen)
    try:
        return path / FILE_NAME if not given or path.is_dir() else path
    except OSError as error:  # a name that no file can have
        raise InputError(
            f"no file can have this name: {error.strerror}",
            field="state",
            value=f"{str(path)[:40]}…",
            cure="give a shorter one",
        ) from error


class StateKeeper:
    """Reads the state at the start, writes it when asked and at the end; use it in a `with` block.

    Parameters
    ----------
    settings : StateSettings
    gauge : Gauge
    tell : callable
        Takes a line of text for the user.
    wall_s, monotonic_s : callable
        Clocks [s]: Unix time, and one that is never set.
    """

    def __init__(
        self,
        settings: StateSettings,
        gauge: Gauge,
        tell: Callable[[str], None],
        *,
        wall_s: Callable[[], float] = time.time,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings = settings
        self._gauge = gauge
        self._model = gauge.model
        self._fingerprint = model_fingerprint(gauge.model)
        self._tell = tell
        self._wall_s = wall_s
        self._monotonic_s = monotonic_s
        self._boot_id = boot_id()
        self._writer: BackgroundWriter[StateContent] = BackgroundWriter(self._write)
        self._samples_kept = 0
        self._warned_s = -math.inf
        self._restored_pct: float | None = None
        self.restored = False
        """Whether the gauge went on from the file."""

    def __enter__(self) -> Self:
        self._sweep()
        self._restore()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.checkpoint()
        if not self._writer.flush(STOP_WITHIN_S):
            self._tell(f"warning: {self.settings.path}: the last state was not written in time")
        self._warn_of_errors(at_once=True)

    def checkpoint(self) -> None:
        """Have the state written, if a sample came since the last time; returns at once."""
        self._warn_of_errors()
        self._tell_verdict()
        if self._gauge.samples == self._samples_kept:
            return
        state = self._gauge.snapshot()
        if state is None:
            return
        self._samples_kept = self._gauge.samples
        if self._gauge.model is not self._model:
            # The configuration was read again.
            self._model = self._gauge.model
            self._fingerprint = model_fingerprint(self._model)
        self._writer.submit(
            StateContent.model_construct(
                saved_s=self._wall_s(),
                boot_id=self._boot_id,
                model=self._fingerprint,
                model_name=self._model.name[:200],
                time_source=self._gauge.settings.time_source,
                estimator=state,
            )
        )

    def flush(self, seconds: float) -> bool:
        """Wait until what was asked for is written; False if that takes longer [s]."""
        return self._writer.flush(seconds)

    # --- at the start -----------------------------------------------------------------------

    def _restore(self) -> None:
        path = self.settings.path
        try:
            content = read_state(path)
            age_s = self._checked_age(content)
            latest = self._gauge.restore(content.estimator, age_s)
        except FileNotFoundError:
            self._tell(f"{path}: no state yet; starting without")
            return
        except InputError as error:
            self._refuse(error)
            return
        self.restored = True
        self._restored_pct = latest.soc_pct
        ago = "some time ago" if math.isnan(age_s) else f"{duration(age_s)} ago"
        soc = f"{number(latest.soc_pct, 2)} ± {number(latest.soc_std_pct, 2, '%')}"
        self._tell(f"{path}: going on from {ago}: SoC {soc}")

    def _checked_age(self, content: StateContent) -> float:
        """Return how old the state is at least [s]; NaN if no clock knows."""
        path = self.settings.path
        if content.model != self._fingerprint:
            raise InputError(
                f"of another model ({content.model_name})", source=path, field="content.model"
            )
        time_source = self._gauge.settings.time_source
        if content.time_source != time_source:
            raise InputError(
                f"time was by {content.time_source}, and is by {time_source}",
                source=path,
                field="content.time_source",
            )
        if math.isnan(content.estimator.soc_pct):
            raise InputError("holds no SoC", source=path, field="content.estimator.estimate")
        if time_source == "replay-clock":
            return 0.0
        age_s = self._wall_s() - content.saved_s
        if age_s > self.settings.max_age_s:
            raise InputError(
                f"{age_s / 3600.0:.1f} h old, and older than {self.settings.max_age_s / 3600.0:g} h"
                " is not used",
                source=path,
            )
        if age_s < -FUTURE_S:
            return math.nan
        age_s = max(age_s, 0.0)
        return max(age_s, REBOOT_S) if content.boot_id != self._boot_id else age_s

    def _refuse(self, error: InputError) -> None:
        path = self.settings.path
        aside = path.with_name(path.name + DAMAGED_SUFFIX)
        try:
            path.replace(aside)
            kept = f"; kept as {aside.name}"
        except OSError as problem:
            kept = f" (and cannot be put aside: {problem.strerror})"
        # A SoC that the user gave was true at some earlier start: there is a state, so the car has
        # been used since. Kept with a wide deviation it would tell nothing that the voltage does
        # not, and counting alone would never be rid of it.
        how = (
            "by voltage, for the given SoC is of an earlier start"
            if (self._gauge.ask_the_voltage())
            else "without"
        )
        self._tell(f"warning: state refused: {error}{kept}; starting {how}")

    def _sweep(self) -> None:
        """Remove what a process that was killed while writing has left."""
        path = Path(os.path.realpath(self.settings.path))
        left = re.compile(rf"\.{re.escape(path.stem[:200])}\.[0-9a-f]{{8}}{re.escape(path.suffix)}")
        with suppress(OSError):
            for each in path.parent.iterdir():
                if left.fullmatch(each.name):
                    each.unlink()

    # --- as it runs -------------------------------------------------------------------------

    def _write(self, content: StateContent) -> None:
        write_text_atomic(self.settings.path, state_text(content))

    def _tell_verdict(self) -> None:
        verdict = self._gauge.pause_verdict
        if self._restored_pct is None or verdict in {"", "open"}:
            return
        before, self._restored_pct = self._restored_pct, None
        latest = self._gauge.latest
        soc = f"{number(latest.soc_pct, 1)} ± {number(latest.soc_std_pct, 1, '%')}"
        words = {
            "parked": f"the voltage bears the restored SoC out; now {soc}",
            "moved": f"the voltage refutes the restored SoC of {before:.1f} %; by it {soc}",
        }
        self._tell(words.get(verdict, f"restored SoC and voltage are weighed; now {soc}"))

    def _warn_of_errors(self, *, at_once: bool = False) -> None:
        error = self._writer.take_error()
        if error is None:
            return
        now_s = self._monotonic_s()
        if now_s - self._warned_s < WARN_EVERY_S and not at_once:
            return
        self._warned_s = now_s
        is_told = isinstance(error, CangaugeError)
        text = str(error) if is_told else f"{self.settings.path}: {error!r}"
        self._tell(f"warning: state not written: {text}")
