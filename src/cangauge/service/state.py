"""The service's state across restarts: restored at the start, saved while it runs.

    {"format": "cangauge-state", "version": 3, "sha256": "…", "content": {…}}

The hash is that of the content, written without spaces and with sorted keys. Everything is checked
before use: size, JSON, format, version, hash, then the type and range of every field. A file that
cannot be read or written never stops the estimator: the error is logged and the service goes on.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import stat
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Final, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cangauge._io import PRIVATE, open_regular, refuse_foreign, text_sha256, write_text_atomic
from cangauge._logging import emit
from cangauge._text import duration, number
from cangauge.errors import CangaugeError, InputError
from cangauge.estimation.state import EstimatorState
from cangauge.model.model_file import Model
from cangauge.service.async_writer import AsyncWriter
from cangauge.service.loop import CHECKPOINT_EVERY_S
from cangauge.service.pipeline import Pipeline

STATE_FORMAT: Final = "cangauge-state"
STATE_VERSION: Final = 3
"""To be increased with every change of the estimator's state."""

LARGEST_BYTES: Final = 8 << 20
"""Largest state file that is read [bytes]; a full delay line takes 0.3 MB."""

FILE_NAME: Final = "cangauge-state.json"
"""Name of the file in a folder."""

STOP_WITHIN_S: Final = 0.7
"""Time limit of the last write when the service ends [s]."""

REBOOT_S: Final = 600.0
"""Least duration of a pause over a reboot [s]: the clock may have stopped with the machine."""

FUTURE_S: Final = 60.0
"""A state further in the future than this [s] has another clock: its age is unknown."""

REFUSED_SUFFIX: Final = ".refused"

_LONGEST_NAME: Final = 200
_OWN_NAMES: Final = frozenset({FILE_NAME, FILE_NAME + REFUSED_SUFFIX})
_BEGINNING_BYTES: Final = 64
_BEGINNING: Final = re.compile(rb'\s*\{\s*"format"\s*:\s*"' + STATE_FORMAT.encode() + rb'"')
"""Beginning of every state file, of any version; the rest may be damaged."""

_LOG = logging.getLogger(__name__)
Hash = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


@dataclass(frozen=True)
class StateSettings:
    """Where and how often the state is saved.

    Parameters
    ----------
    path : Path
    max_age_s : float
        Age above which a state is refused [s].
    every_s : float
        Interval between writes [s].
    """

    path: Path
    max_age_s: float = 7.0 * 86400.0
    every_s: float = CHECKPOINT_EVERY_S


def state_path(given: str | None, environment: Mapping[str, str]) -> Path | None:
    """Return the path of the state file, if any.

    For a folder it is a file in it. The default is systemd's `StateDirectory=`, if there is one.
    """
    folders = environment.get("STATE_DIRECTORY", "").split(":")
    chosen = given or folders[0]
    if not chosen:
        return None
    path = Path(chosen)
    try:
        return path / FILE_NAME if not given or path.is_dir() else path
    except OSError as error:  # an impossible file name
        raise InputError(
            f"impossible file name: {error.strerror}",
            field="state",
            value=f"{str(path)[:40]}…",
            cure="give a shorter one",
        ) from error


def check_state_path(path: Path) -> None:
    """Raise InputError if the state cannot be kept at `path`, before anything is changed.

    A state that is damaged or of another release, model or age is set aside later. What is no
    state at all was named by mistake: it is neither moved nor replaced.
    """
    refuse_foreign(path)
    if not path.parent.is_dir():
        raise InputError(
            "the folder of this file does not exist",
            source=path,
            field="state",
            cure="create it or name another one",
        )
    _refuse_no_state(path)


def _refuse_no_state(path: Path) -> None:
    """Raise InputError for anything but a state, an empty file, or nothing at all."""
    try:
        if not path.exists() or (path.name in _OWN_NAMES and path.is_file()):
            return
        with open_regular(path) as file:
            beginning = file.read(_BEGINNING_BYTES)
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}",
            source=path,
            field="state",
            cure="change its rights",
        ) from error
    if beginning and not _BEGINNING.match(beginning):
        raise InputError(
            "not a cangauge state file, so it is not replaced",
            source=path,
            field="state",
            cure="name a new file, or a folder",
        )


class StateKeeper:
    """Restore the state at the start, save it on request and at the end; use it in a `with` block.

    Parameters
    ----------
    settings : StateSettings
    pipeline : Pipeline
    bus : str
        Interface and channel: the state of another bus is refused.
    wall_s : callable
        Unix time [s].
    """

    def __init__(
        self,
        settings: StateSettings,
        pipeline: Pipeline,
        bus: str = "",
        *,
        wall_s: Callable[[], float] = time.time,
    ) -> None:
        self.settings = settings
        self._bus = bus[:_LONGEST_NAME]
        self._pipeline = pipeline
        self._model = pipeline.model
        self._fingerprint = model_fingerprint(pipeline.model)
        self._wall_s = wall_s
        self._boot_id = boot_id()
        self._writer = AsyncWriter("cangauge-state", on_error=self._failed)
        self._samples_kept = 0
        self._restored_pct: float | None = None
        self.restored = False
        """True if the estimator continued from the file."""

    def __enter__(self) -> Self:
        self._remove_temporary()
        self._restore()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.checkpoint()
        if self._writer.close(STOP_WITHIN_S):
            text = f"{self.settings.path}: the last state was not written in time"
            emit(_LOG, logging.WARNING, "state.failed", text)

    def checkpoint(self) -> None:
        """Start saving the state if it has new samples; return at once."""
        self._log_decision()
        if self._pipeline.samples == self._samples_kept:
            return
        state = self._pipeline.snapshot()
        if state is None:
            return
        self._samples_kept = self._pipeline.samples
        if self._pipeline.model is not self._model:
            # The configuration was reloaded.
            self._model = self._pipeline.model
            self._fingerprint = model_fingerprint(self._model)
        content = StateContent.model_construct(
            saved_s=self._wall_s(),
            boot_id=self._boot_id,
            model=self._fingerprint,
            model_name=self._model.name[:_LONGEST_NAME],
            bus=self._bus,
            vehicle=self._pipeline.vehicle.name[:_LONGEST_NAME],
            time_source=self._pipeline.settings.time_source,
            estimator=state,
        )
        self._writer.replace(partial(self._write, content))

    def flush(self, seconds: float) -> bool:
        """Wait until the state is written; return False if that takes longer [s]."""
        return self._writer.flush(seconds)

    def _restore(self) -> None:
        path = self.settings.path
        try:
            content = read_state(path)
            age_s = self._checked_age(content)
            latest = self._pipeline.restore(content.estimator, age_s)
        except FileNotFoundError:
            emit(_LOG, logging.INFO, "state.none", f"{path}: no saved state; starting without one")
            return
        except InputError as error:
            self._refuse(error)
            return
        self.restored = True
        self._restored_pct = latest.soc_pct
        ago = "of unknown age" if math.isnan(age_s) else f"saved {duration(age_s)} ago"
        soc = f"{number(latest.soc_pct, 2)} ± {number(latest.soc_std_pct, 2, '%')}"
        emit(
            _LOG,
            logging.INFO,
            "state.restored",
            f"{path}: continuing from a state {ago}: SoC {soc}",
        )

    def _checked_age(self, content: StateContent) -> float:
        """Return the least age of the state [s]; NaN if it is unknown."""
        path, vehicle = self.settings.path, self._pipeline.vehicle.name[:_LONGEST_NAME]
        for field, is_other, owner in (
            ("model", content.model != self._fingerprint, content.model_name),
            ("vehicle", content.vehicle != vehicle, content.vehicle),
            ("bus", content.bus != self._bus, content.bus),
        ):
            if is_other:
                raise InputError(
                    f"of another {field} ({owner})", source=path, field=f"content.{field}"
                )
        time_source = self._pipeline.settings.time_source
        if content.time_source != time_source:
            raise InputError(
                f"saved with time source {content.time_source}, now it is {time_source}",
                source=path,
                field="content.time_source",
            )
        if math.isnan(content.estimator.soc_pct):
            raise InputError("has no SoC", source=path, field="content.estimator.estimate")
        if time_source == "replay-clock":
            return 0.0
        age_s = self._wall_s() - content.saved_s
        if age_s > self.settings.max_age_s:
            raise InputError(
                f"{age_s / 3600.0:.1f} h old, more than the limit of"
                f" {self.settings.max_age_s / 3600.0:g} h",
                source=path,
            )
        if age_s < -FUTURE_S:
            return math.nan
        age_s = max(age_s, 0.0)
        return max(age_s, REBOOT_S) if content.boot_id != self._boot_id else age_s

    def _refuse(self, error: InputError) -> None:
        path = self.settings.path
        _refuse_no_state(path)
        aside = _free_name(path)
        try:
            path.replace(aside)
            kept = f"; kept as {aside.name}"
        except OSError as problem:
            kept = f" (and cannot be renamed: {problem.strerror})"
        # A state exists, so the car has been used since the configured initial SoC was true. With
        # a wide standard deviation that SoC would add nothing to the voltage, and Coulomb counting
        # would never correct it.
        how = (
            "from the voltage, since the given initial SoC is outdated"
            if self._pipeline.discard_initial_soc()
            else "without one"
        )
        text = f"state refused: {error}{kept}; starting {how}"
        emit(_LOG, logging.WARNING, "state.refused", text)

    def _remove_temporary(self) -> None:
        """Remove temporary files of a process that was killed while writing."""
        path = Path(os.path.realpath(self.settings.path))
        left = re.compile(rf"\.{re.escape(path.stem[:200])}\.[0-9a-f]{{8}}{re.escape(path.suffix)}")
        with suppress(OSError):
            for each in path.parent.iterdir():
                if left.fullmatch(each.name):
                    each.unlink()

    def _write(self, content: StateContent) -> None:
        _refuse_no_state(self.settings.path)  # it may have been swapped: a pipe would never end
        write_text_atomic(self.settings.path, state_text(content), PRIVATE)

    def _log_decision(self) -> None:
        verdict = self._pipeline.estimator.verdict
        if self._restored_pct is None or verdict in {"", "open"}:
            return
        before, self._restored_pct = self._restored_pct, None
        latest = self._pipeline.latest
        soc = f"{number(latest.soc_pct, 1)} ± {number(latest.soc_std_pct, 1, '%')}"
        words = {
            "parked": f"the voltage confirms the restored SoC; now {soc}",
            "moved": f"the voltage refutes the restored SoC of {before:.1f} %; now {soc}",
        }
        text = words.get(verdict, f"restored SoC and voltage are combined; now {soc}")
        emit(_LOG, logging.INFO, "state.judged", text)

    def _failed(self, error: Exception) -> None:
        text = str(error)
        if not isinstance(error, CangaugeError):
            text = f"{self.settings.path}: {error!r}"
        emit(_LOG, logging.WARNING, "state.failed", f"state not written: {text}")


def _free_name(path: Path) -> Path:
    """Return the name under which a refused state is set aside: it replaces only an earlier one."""
    for count in range(1, 100):
        aside = path.with_name(f"{path.name}{REFUSED_SUFFIX}{count if count > 1 else ''}")
        try:
            if not aside.is_symlink():
                _refuse_no_state(aside)
                break
        except InputError:
            continue
    return aside


# --- The file


class StateContent(BaseModel):
    """Content of the file, without its hash."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    saved_s: Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
    """Unix time of the state [s]."""
    boot_id: Annotated[str, Field(max_length=64)] | None
    """Boot of the machine that it belongs to; None if unknown."""
    model: Hash
    """Fingerprint of the model."""
    model_name: Annotated[str, Field(max_length=_LONGEST_NAME)]
    bus: Annotated[str, Field(max_length=_LONGEST_NAME)]
    """Interface and channel."""
    vehicle: Annotated[str, Field(max_length=_LONGEST_NAME)]
    time_source: Annotated[str, Field(max_length=32)]
    estimator: EstimatorState


def model_fingerprint(model: Model) -> str:
    """Return the hash of a model's content."""
    return text_sha256(model.to_json())


def state_text(content: StateContent) -> str:
    """Return the file's text."""
    text = _canonical(content.model_dump(mode="json"))
    head = {"format": STATE_FORMAT, "version": STATE_VERSION, "sha256": _hash(text)}
    return f'{json.dumps(head)[:-1]}, "content": {text}}}\n'


def read_state(path: Path) -> StateContent:
    """Read and check a state file.

    Raises
    ------
    FileNotFoundError
        If there is none.
    InputError
        If it cannot be read, is damaged, or has another version.
    """
    data = _parsed(_bytes(path), path)
    if not isinstance(data, dict) or data.get("format") != STATE_FORMAT:
        raise InputError("not a cangauge state file", source=path, field="format")
    if data.get("version") != STATE_VERSION:
        raise InputError(
            f"this release reads version {STATE_VERSION}",
            source=path,
            field="version",
            value=_shown(data.get("version")),
        )
    content = data.get("content")
    if not isinstance(content, dict) or data.get("sha256") != _content_hash(content):
        raise InputError("damaged: the hash does not match", source=path, field="sha256")
    try:
        return StateContent.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            first["msg"].removeprefix("Value error, "),
            source=path,
            field="content." + ".".join(str(part) for part in first["loc"]),
            value=_shown(first["input"]),
        ) from error


def boot_id() -> str | None:
    """Return the kernel's id of this boot; None if there is none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()[:64]
    except (OSError, ValueError):
        return None


def _bytes(path: Path) -> bytes:
    try:
        # A pipe or device could block.
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError("not a regular file", source=path)
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size > LARGEST_BYTES:
                raise InputError(f"larger than {LARGEST_BYTES >> 20} MB", source=path)
            return file.read(LARGEST_BYTES + 1)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", source=path) from error


def _parsed(raw: bytes, path: Path) -> object:
    try:
        # Decoded here: from bytes, `json` would accept UTF-16 and UTF-32 too.
        return json.loads(raw.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]
        raise InputError(f"not JSON: {reason}", source=path) from error


def _canonical(content: dict[str, Any]) -> str:
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _hash(text: str) -> str:
    return text_sha256(text)


def _content_hash(content: dict[str, Any]) -> str:
    try:
        return _hash(_canonical(content))
    except (ValueError, RecursionError):  # 1e999 is read as infinity, which cannot be written
        return ""


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not allowed in a state")


def _shown(value: object) -> str | int | float | None:
    if isinstance(value, str):
        return value[:60]
    return value if isinstance(value, int | float) and abs(value) < 1e15 else None
