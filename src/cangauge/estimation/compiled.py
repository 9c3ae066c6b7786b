"""The estimator with its step in C, some hundred times as fast and within 1e-9 of Python's.

`Estimator` is the reference. `CompiledEstimator` hands each sample to the extension `_core`, whose
state is known to C alone: bytes that only a core of the same sources reads. What is rare (health,
power) is computed by the reference from a view of the filter. It is used wherever the extension was
built at installation, live and offline, unless `CANGAUGE_PURE_PYTHON` is set.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
from numpy.typing import NDArray

from cangauge._core_digest import sources_digest
from cangauge._logging import emit
from cangauge._typing import FloatArray
from cangauge.estimation.core_constants import (
    KINDS,
    Constants,
    core_forms,
    model_constants,
    settings_constants,
)
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.delay_line import DROPPED, SPACING_S, DelayLine
from cangauge.model.effects.base import CoreForm
from cangauge.model.model_file import Model
from cangauge.types import REASONS, Estimate, Sample, Status

_LOG = logging.getLogger(__name__)


def _load(root: Path) -> Any:
    """Return the extension; None without one, or if the sources in a checkout are other ones."""
    try:
        core: Any = import_module("cangauge._core")
    except ImportError:  # no compiler at installation
        return None
    folder = root / "core"
    if (folder / "cangauge.h").is_file() and sources_digest(folder) != core.SOURCES:
        emit(
            _LOG.warning,
            "core.stale",
            "the compiled core is not of these sources: continuing in Python; "
            "compile it by `python hatch_build.py`",
        )
        return None
    return core


PROGRESS_EVERY: Final = 5000
"""Samples between two calls of a progress callback."""

_core: Final = _load(Path(__file__).parents[3])


def make_estimator(model: Model, settings: EstimatorSettings | None = None) -> Estimator:
    """Return an estimator, compiled where the extension is present and knows the model's effects.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings, optional
    """
    if _core is not None and not os.environ.get("CANGAUGE_PURE_PYTHON"):
        try:
            return CompiledEstimator(model, settings)
        except ValueError as lacking:  # the core lacks an effect, or has too few places
            emit(_LOG.info, "core.lacking", f"estimating in Python: {lacking}")
    return Estimator(model, settings)


class CompiledEstimator(Estimator):
    """`Estimator` whose step is compiled; see `make_estimator`.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings

    Attributes
    ----------
    native : Core
        The estimator in C.

    Raises
    ------
    ValueError
        If the core lacks an effect of the model, or has no place for its numbers.
    """

    core: ClassVar[str] = "compiled"
    _release: ClassVar[str] = getattr(_core, "SOURCES", "")

    def __init__(self, model: Model, settings: EstimatorSettings | None = None) -> None:
        super().__init__(model, settings)
        online, forms = self.online, core_forms(self.online)
        self.native: Any = _core.Core(
            _arrays(model_constants(self, forms) | _of_effects(forms)),
            _arrays(settings_constants(self)),
            int(2.0 * online.delay_line.longest_s / SPACING_S) + 2 * DROPPED,
            DROPPED,
            SPACING_S,
            Estimate,
            tuple(Status),
            REASONS,
        )
        online.delay_line = _CoreLine(online.model.loads.delays_s, self.native)
        self._is_over_soc = np.array([e.uses_soc for e, _ in online.extended.effects], bool)

    def update(self, sample: Sample) -> None:
        """Process one sample; see `Estimator.update`."""
        self.is_refused = not self.native.update(sample)

    def run(
        self, columns: Sequence[FloatArray], progress: Callable[[int], None] | None = None
    ) -> list[NDArray[Any]]:
        """Process whole columns; return those of the estimates.

        Parameters
        ----------
        columns : sequence of arrays of shape (n,)
            Time [s], current [A], voltage [V] and temperature [°C].
        progress : callable, optional
            Called with the number of samples done, every `PROGRESS_EVERY`.

        Returns
        -------
        list of arrays of shape (n,)
            Columns of `Estimate`, from `time_s` to `reasons`.
        """
        given = [np.ascontiguousarray(each, dtype=np.float64) for each in columns]
        rows = given[0].size
        found = [*np.empty((7, rows)), *np.empty((2, rows), np.int64)]
        for first in range(0, rows, PROGRESS_EVERY):
            part = slice(first, first + PROGRESS_EVERY)
            self.native.run(tuple(each[part] for each in (*given, *found)))
            if progress is not None and first + PROGRESS_EVERY <= rows:
                progress(first + PROGRESS_EVERY)
        return found

    @property
    def estimate(self) -> Estimate:
        """The estimate after the latest sample; see `Estimator.estimate`."""
        return cast("Estimate", self.native.estimate())

    @property
    def row(self) -> int:
        """Number of the row whose voltage was compared with the model last; −1 before any."""
        return int(self.native.row())

    def uncounted_std_pct(self, seconds: float) -> float:
        """Return what the SoC's standard deviation lacks [%] when no sample came for a time [s]."""
        return float(self.native.uncounted_std_pct(seconds))

    def start_from(self, soc_pct: float, soc_std_pct: float, away_s: float) -> None:
        """Start from the SoC of another one; see `Estimator.start_from`."""
        self.native.start_from(soc_pct, soc_std_pct, away_s)

    def _follow(self, before: Estimator) -> None:
        self.native.take_over(cast("CompiledEstimator", before).native)

    def _packed(self, stamp_shift_s: float) -> bytes:
        return bytes(self.native.state(stamp_shift_s))

    def _unpack(self, packed: bytes, age_s: float) -> None:
        self.native.restore(packed, age_s)

    def _refresh(self) -> None:
        """Show the reference what health, power and cells are computed from."""
        learned, *arrays, time_s, moved_pct, temperature_c = self.native.view()
        load, drives, low_passed = map(np.frombuffer, arrays)
        state = {name: np.frombuffer(each) for name, each in learned.items()}
        self.hypotheses.filters = [self.hypotheses.filters[0].resume({"evidence": 0.0, **state})]
        self._counter.time_s, self._counter.moved_pct = time_s, moved_pct
        self._memory.temperature_c = temperature_c
        # The reference has the drives of effects beside the SoC in one sum.
        over = self._is_over_soc
        drives = np.array([sum(drives[~over].tolist()), *drives[over].tolist()])
        self.online.resume(load, drives, low_passed.tolist())


def _of_effects(forms: list[CoreForm]) -> Constants:
    """Return the fields of the effects, a row for each."""
    columns = zip_longest(*(form.values for form in forms), fillvalue=0.0)
    lags = zip_longest(*(form.tau_s for form in forms), fillvalue=0.0)
    return {
        "effect_kind": [KINDS.index(form.kind) for form in forms],
        "effect_value": list(zip(*columns, strict=True)),
        "effect_tau_s": list(zip(*lags, strict=True)),
    }


def _arrays(constants: Constants) -> dict[str, FloatArray]:
    return {name: np.ascontiguousarray(each, np.float64) for name, each in constants.items()}


class _CoreLine(DelayLine):
    """The delay line in the core."""

    def __init__(self, delay_s: Sequence[float], core: Any) -> None:
        super().__init__(delay_s)
        self._core = core

    @property
    def filled_s(self) -> float:
        """Length of the gap-free stretch up to the newest sample [s]."""
        return float(self._core.filled_s())

    def current_at(self, ago_s: float) -> float:
        """Return I(t − `ago_s`) [A], t being the newest sample's time."""
        return float(self._core.current_at(ago_s))
