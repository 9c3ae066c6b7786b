"""The service's state across restarts: restored at the start, saved while it runs.

    {"format": "cangauge-state", "version": 6, "sha256": "…", "content": {…}}

The hash is that of the content, written without spaces and with sorted keys. A file that cannot be
used is set aside; one that cannot be written never stops the estimator.
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

from pydantic import BaseModel, ConfigDict

from cangauge._config import validated
from cangauge._files import (
    atomic_path,
    is_own,
    open_regular,
    read_bounded,
    remove_parts,
    text_sha256,
    written_name,
)
from cangauge._logging import emit
from cangauge._text import duration, known_soc
from cangauge.errors import InputError
from cangauge.estimation.state import EstimatorState
from cangauge.service.pipeline import Pipeline
from cangauge.service.status import CLOCKS_APART_S
from cangauge.service.worker import CLOSE_WITHIN_S, Worker

STATE_FORMAT: Final = "cangauge-state"
STATE_VERSION: Final = 6
"""To be increased with every change of the content."""
FILE_NAME: Final = "cangauge-state.json"
"""Name of the file in a folder."""
REBOOT_S: Final = 600.0
"""Least duration of a pause over a reboot [s]: the clock may have stopped with the machine."""
_LOG = logging.getLogger(__name__)


class StateContent(BaseModel):
    """Content of the file, without its hash.

    `saved_s` is Unix time [s], `boot_id` the boot of the machine (None: unknown), `model` the hash
    of the model's content, `battery` that of `Vehicle.battery`; a bus is interface and channel.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    saved_s: float
    boot_id: str | None
    model: str
    model_name: str
    bus: str
    battery: str
    vehicle_name: str
    time_source: str
    estimator: EstimatorState


def state_path(given: str | None, environment: Mapping[str, str]) -> Path | None:
    """Return the path of the state file, if any; for a folder it is a file in it.

    The default is systemd's `StateDirectory=`, if there is one. InputError if there is no such
    folder, or another file, which was named by mistake and stays. (Whatever has the name
    `FILE_NAME` was a state, which a disk may have lost: it is set aside later.)
    """
    place = given or environment.get("STATE_DIRECTORY", "").split(":")[0]
    if not place:
        return None
    path = Path(place)
    if given is None or os.path.isdir(path):  # noqa: PTH112 - never raises
        path /= FILE_NAME
    if not path.parent.is_dir():
        raise InputError(
            "the folder of this file does not exist",
            source=path,
            field="state",
            cure="create it or name another one",
        )
    if path.name != FILE_NAME and os.path.exists(path):  # noqa: PTH110 - never raises
        with open_regular(path) as file:
            beginning = file.read(64)
        if beginning and b'"format": "' + STATE_FORMAT.encode() not in beginning:
            raise InputError(
                "not a cangauge state file, so it is not replaced",
                source=path,
                field="state",
                cure="name a new file, or a folder",
            )
    return path


@dataclass(eq=False)
class StateKeeper:
    """Restore the state at the start, save it on request and at the end; use it in a `with` block.

    The state of another bus (interface and channel), or one older than `max_age_s` [s], is refused.
    `wall_s` gives Unix time [s]; `restored` is whether the estimator continued from the file.
    """

    path: Path
    pipeline: Pipeline
    bus: str
    max_age_s: float
    wall_s: Callable[[], float] = time.time

    def __post_init__(self) -> None:
        self._boot_id = _boot_id()
        self._worker = Worker("cangauge-state", self._failed, jobs_at_most=3)
        self._hashed = (self.pipeline.model, text_sha256(self.pipeline.model.to_json()))
        self._samples_kept = 0
        self.restored = False

    def __enter__(self) -> Self:
        remove_parts(self.path)
        if not os.path.exists(self.path):  # noqa: PTH110 - never raises
            emit(_LOG.info, "state.none", f"{self.path}: no saved state; starting without one")
            return self
        try:
            if not is_own(written_name(self.path).lstat()):  # a link of another user, or his file
                raise InputError("belongs to another user", source=self.path)  # noqa: TRY301
            content = read_state(self.path)
            age_s = self._age_s(content)
            latest = self.pipeline.restore(content.estimator, age_s)
        except InputError as error:
            self._set_aside(error)
            return self
        self.restored = True
        ago = "of unknown age" if math.isnan(age_s) else f"saved {duration(age_s)} ago"
        if content.estimator.writer != self.pipeline.estimator.writer:
            ago += ", of another release, method or capacity, of which the SoC alone is kept"
        emit(
            _LOG.info,
            "state.restored",
            f"{self.path}: continuing from a state {ago}: SoC"
            f" {known_soc(latest.soc_pct, latest.soc_std_pct, 2)}",
        )
        return self

    def __exit__(self, *_: object) -> None:
        self.checkpoint()
        if not self._worker.close(CLOSE_WITHIN_S):
            emit(
                _LOG.warning, "state.failed", f"{self.path}: the last state was not written in time"
            )

    def checkpoint(self) -> None:
        """Start saving the state if it has new samples; return at once."""
        pipeline = self.pipeline
        if pipeline.samples == self._samples_kept or (state := pipeline.snapshot()) is None:
            return
        content = StateContent.model_construct(
            **self._uses(),
            saved_s=self.wall_s(),
            boot_id=self._boot_id,
            model_name=pipeline.model.name,
            vehicle_name=pipeline.vehicle.name,
            estimator=state,
        )
        if self._worker.submit(partial(self._write, content)):
            self._samples_kept = pipeline.samples

    def _uses(self) -> dict[str, Any]:
        """Return what a state belongs to."""
        pipeline = self.pipeline
        if pipeline.model is not self._hashed[0]:  # the configuration was reloaded
            self._hashed = (pipeline.model, text_sha256(pipeline.model.to_json()))
        return {
            "model": self._hashed[1],
            "battery": text_sha256(pipeline.vehicle.battery),
            "bus": self.bus,
            "time_source": pipeline.settings.time_source,
        }

    def _age_s(self, content: StateContent) -> float:
        """Return the age of a state that may be used [s]; NaN: unknown. Else raise InputError."""
        path = self.path
        names = {"model": content.model_name, "battery": content.vehicle_name}
        for field, wanted in self._uses().items():
            if (owner := getattr(content, field)) != wanted:
                raise InputError(
                    f"of another {field.replace('_', ' ')} ({names.get(field, owner)})",
                    source=path,
                    field=field,
                )
        if content.time_source == "replay-clock":
            return 0.0
        age_s = self.wall_s() - content.saved_s
        limit_s = self.max_age_s
        if age_s > limit_s:
            raise InputError(
                f"{age_s / 3600.0:.1f} h old, more than the limit of {limit_s / 3600.0:g} h",
                source=path,
            )
        if age_s < -CLOCKS_APART_S:
            return math.nan
        return max(age_s, REBOOT_S if content.boot_id != self._boot_id else 0.0)

    def _set_aside(self, error: InputError) -> None:
        aside = self.path.with_name(f"{self.path.name}.refused")
        try:
            self.path.replace(aside)
            kept = f"; kept as {aside.name}"
        except OSError as problem:
            kept = f" (and cannot be renamed: {problem.strerror})"
        # A state exists, so the car has been used since the configured initial SoC was true. With
        # a wide standard deviation that SoC would add nothing to the voltage, and Coulomb counting
        # would never correct it.
        how = "without one"
        if self.pipeline.discard_initial_soc():
            how = "from the voltage, since the given initial SoC is outdated"
        emit(_LOG.warning, "state.refused", f"state refused: {error}{kept}; starting {how}")

    def _write(self, content: StateContent) -> None:
        with atomic_path(self.path, rights=0o600) as part:
            part.write_text(state_text(content), encoding="utf-8")

    def _failed(self, error: Exception) -> None:
        emit(_LOG.warning, "state.failed", f"state not written: {self.path}: {error}")


def state_text(content: StateContent) -> str:
    """Return the file's text."""
    text = _canonical(content.model_dump(mode="json"))
    head = {"format": STATE_FORMAT, "version": STATE_VERSION, "sha256": text_sha256(text)}
    return f'{json.dumps(head)[:-1]}, "content": {text}}}\n'


def read_state(path: Path) -> StateContent:
    """Read and check a state file.

    Raises
    ------
    InputError
        If there is none, or it cannot be read, is damaged, or has another version.
    """
    raw = read_bounded(path, 8 << 20, "a state file")  # a full delay line takes 0.3 MB
    try:
        data = json.loads(raw.decode("utf-8"))
        content = data["content"]
        found = (data["format"], data["version"], data["sha256"])
        digest = text_sha256(_canonical(content))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError("not a cangauge state file", source=path) from error
    if found[:2] != (STATE_FORMAT, STATE_VERSION):
        raise InputError(
            f"this release reads version {STATE_VERSION}",
            source=path,
            field="version",
            value=found[1],
            cure="remove the file: the start is then --initial-soc, or found by the first voltages",
        )
    if found[2] != digest:
        raise InputError("damaged: the hash does not match", source=path, field="sha256")
    return validated(StateContent, content, path)


def _canonical(content: Any) -> str:
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _boot_id() -> str | None:
    """Return the kernel's id of this boot; None if there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()[:64]
    except (OSError, ValueError):
        return None
