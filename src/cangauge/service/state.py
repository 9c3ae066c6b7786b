"""The state file: what the service remembers over a restart. JSON, versioned, with its own hash.

    {"format": "cangauge-state", "version": 1, "sha256": "…", "content": {…}}

The hash is that of the content, written without spaces and with sorted keys. Nothing is believed
before it is checked: size, JSON, format, version, hash, then every field's type and range.

Keeps the gauge's state in a file: read and checked at the start, written as the service runs.

Nothing that happens to the file stops the estimator: it is told of in one line, at most once a
minute, and the service goes on without.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import stat
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Final, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cangauge._formatting import duration, number
from cangauge._io import write_text_atomic
from cangauge.errors import CangaugeError, InputError
from cangauge.estimate.state import EstimatorState
from cangauge.model.model_file import Model, model_json
from cangauge.service.async_writer import BackgroundWriter
from cangauge.service.loop import CHECKPOINT_EVERY_S
from cangauge.service.pipeline import Pipeline

# --- The state file: what the service remembers over a restart. JSON, versioned, with its ow…

STATE_FORMAT: Final = "cangauge-state"
STATE_VERSION: Final = 1
"""To be raised with every change of what an estimator remembers."""

LARGEST_BYTES: Final = 8 << 20
"""A delay line at its fullest takes 0.3 MB."""

Hash = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class StateContent(BaseModel):
    """What the file holds, besides its own hash."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    saved_s: Annotated[float, Field(allow_inf_nan=False, ge=-1e12, le=1e12)]
    """Unix time at which it was taken [s]."""
    boot_id: Annotated[str, Field(max_length=64)] | None
    """Which start of the machine it belongs to; None where the system does not tell."""
    model: Hash
    """Fingerprint of the model."""
    model_name: Annotated[str, Field(max_length=200)]
    time_source: Annotated[str, Field(max_length=32)]
    estimator: EstimatorState


def model_fingerprint(model: Model) -> str:
    """Return a hash of all that a model says."""
    return hashlib.sha256(model_json(model).encode()).hexdigest()


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
        If it cannot be read, is damaged, or is of another version; one line with the reason.
    """
    data = _parsed(_bytes(path), path)
    if not isinstance(data, dict) or data.get("format") != STATE_FORMAT:
        raise InputError("is no cangauge state", source=path, field="format")
    if data.get("version") != STATE_VERSION:
        raise InputError(
            f"this release keeps version {STATE_VERSION}",
            source=path,
            field="version",
            value=_shown(data.get("version")),
        )
    content = data.get("content")
    if not isinstance(content, dict) or data.get("sha256") != _content_hash(content):
        raise InputError("damaged: its content is not what was written", source=path,
                         field="sha256")  # fmt: skip
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
    """Return which start of the machine this is; None where the system does not tell."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()[:64]
    except (OSError, ValueError):
        return None


def _bytes(path: Path) -> bytes:
    try:
        # A pipe or device could keep the service waiting for ever.
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError("is no regular file", source=path)
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
        # Decoded here: of bytes, `json` would also take UTF-16 and UTF-32, which is never written.
        return json.loads(raw.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]
        raise InputError(f"is no JSON: {reason}", source=path) from error


def _canonical(content: dict[str, Any]) -> str:
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _content_hash(content: dict[str, Any]) -> str:
    try:
        return _hash(_canonical(content))
    except (ValueError, RecursionError):  # 1e999 is read as infinity, which no hash is made of
        return ""


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number that a state may hold")


def _shown(value: object) -> str | int | float | None:
    if isinstance(value, str):
        return value[:60]
    return value if isinstance(value, int | float) and abs(value) < 1e15 else None


# --- Keeps the gauge's state in a file: read and checked at the start, written as the servic…

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
    gauge : Pipeline
    tell : callable
        Takes a line of text for the user.
    wall_s, monotonic_s : callable
        Clocks [s]: Unix time, and one that is never set.
    """

    def __init__(
        self,
        settings: StateSettings,
        gauge: Pipeline,
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
            if (self._gauge.discard_initial_soc())
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
        verdict = self._gauge.estimator.filter.verdict
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
