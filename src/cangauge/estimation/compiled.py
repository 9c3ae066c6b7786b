"""The estimator with its step in C: the same numbers, bit for bit, some hundred times as fast.

`Estimator` is the reference; `CompiledEstimator` hands each sample to the extension `_core` and
leaves to Python what is rare: capacity and resistance, power, and states to save. It is used where
the extension was built at installation, unless `CANGAUGE_PURE_PYTHON` is set.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
from numpy.typing import NDArray

from cangauge._arithmetic import total
from cangauge._core_digest import sources_digest
from cangauge._logging import emit
from cangauge._typing import FloatArray
from cangauge.estimation.cells import PackTick
from cangauge.estimation.core_constants import CoreConstants, core_constants, effect_fields
from cangauge.estimation.ekf import KT, LEARNED, SocEkf
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.health import (
    RESISTANCE_TIME_S,
    SHORTEST_BLOCK_S,
    WINDOW_S,
    Health,
    HealthEstimator,
    VoltageTick,
)
from cangauge.estimation.hypothesis_filter import HypothesisFilter
from cangauge.estimation.power import Power
from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.state import (
    ChargeSinceUpdate,
    ClockState,
    CounterState,
    EkfState,
    EstimatorMemory,
    EstimatorState,
    HypothesisFilterState,
    ReferenceState,
    ResistanceState,
    Verdict,
)
from cangauge.model.delay_line import BLOCK, SPACING_S, DelayLine
from cangauge.model.model_file import Model
from cangauge.model.voltage_model import Curve
from cangauge.types import REASONS, Estimate, Reason, Sample, Status

_LOG = logging.getLogger(__name__)


def _load(root: Path) -> Any:
    """Return the extension; None without one, or if the sources in a checkout are other ones."""
    try:
        core: Any = import_module("cangauge._core")
    except ImportError:  # no compiler at installation
        return None
    if (root / "core" / "cangauge.h").is_file() and sources_digest(root / "core") != core.SOURCES:
        emit(
            _LOG, logging.WARNING, "core.stale",
            "the compiled core is not of these sources: continuing in Python; "
            "compile it by `python hatch_build.py`",
        )  # fmt: skip
        return None
    return core


_core: Final = _load(Path(__file__).parents[3])

VERDICTS: Final[tuple[Verdict, ...]] = ("", "open", "parked", "moved", "unclear")
"""Verdicts, in the order of `cg_verdict`."""


_STATUSES: Final = tuple(Status)

_LAG: Final = ("time_s", "input", "value")
_HYPOTHESES: Final = ("first", "second")


def is_compiled() -> bool:
    """Return whether estimators are compiled ones."""
    return _core is not None and not os.environ.get("CANGAUGE_PURE_PYTHON")


def make_estimator(
    model: Model,
    settings: EstimatorSettings | None = None,
    ekf_type: type[SocEkf] | None = None,
) -> Estimator:
    """Return an estimator, compiled where the extension is present and knows the model's effects.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings, optional
    ekf_type : type, optional
        Another implementation of the Kalman filter: the estimator is then not compiled.
    """
    settings = settings or EstimatorSettings()
    if is_compiled() and settings.filter == "own" and ekf_type is None:
        constants = core_constants(model, settings)
        if constants is not None:
            return CompiledEstimator(model, settings, constants)
    return Estimator(model, settings, ekf_type)


class CompiledEstimator(Estimator):
    """`Estimator` whose step is compiled; see `make_estimator`.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings
    constants : CoreConstants
        Of this model and these settings.
    """

    core: ClassVar[str] = "compiled"

    def __init__(self, model: Model, settings: EstimatorSettings, constants: CoreConstants) -> None:
        self._in_python = True
        self._forms = constants.effects
        self._hook = _Hook()
        self._core: Any = _core.Core(
            constants.model | {"function_v": _with_stride(constants.functions, _core.FUNCTIONS)},
            [effect_fields(form) for form in constants.effects],
            constants.settings,
            self._hook,
            int(2.0 * constants.longest_s / SPACING_S) + 2 * BLOCK,
            BLOCK,
            SPACING_S,
            Estimate,
            _STATUSES,
            REASONS,
        )
        super().__init__(model, settings)
        self._hook.core, self._hook.health = self._core, self._health
        self._hook.is_other = self._has_other_capacity
        self._hook.push()
        self._line = _CoreLine(self._voltage_model.delay_s, self._core)
        self._in_python = False

    def _make_curve(self) -> Curve:
        return cast("Curve", self._core)

    def update(self, sample: Sample) -> None:
        """Process one sample; see `Estimator.update`."""
        self._core.update(sample)

    def run(self, columns: Sequence[FloatArray]) -> list[NDArray[Any]]:
        """Process whole columns; return those of the estimates.

        Parameters
        ----------
        columns : sequence of arrays of shape (n,)
            Time [s], current [A], voltage [V] and temperature [°C].

        Returns
        -------
        list of arrays of shape (n,)
            Columns of `Estimate`, from `time_s` to `reasons`.
        """
        taken = [np.ascontiguousarray(each, dtype=np.float64) for each in columns]
        rows = taken[0].size
        found: list[NDArray[Any]] = [np.empty(rows) for _ in range(7)]
        found += [np.empty(rows, np.int64) for _ in range(2)]
        self._core.run((*taken, *found))
        return found

    @property
    def is_refused(self) -> bool:
        """Whether the latest sample was refused: without a plausible current, or not later."""
        return bool(self._core.is_refused)

    @is_refused.setter
    def is_refused(self, value: bool) -> None:
        """Leave it to the core: the reference sets it before it has one."""

    @property
    def filter(self) -> HypothesisFilter:
        """The filter in its present state."""
        if not self._in_python:
            self._pull_filter()
        return self._filter

    @filter.setter  # noqa: A003 - the reference's name
    def filter(self, value: HypothesisFilter) -> None:
        self._filter = value

    @property
    def estimate(self) -> Estimate:
        """The estimate after the latest sample; see `Estimator.estimate`."""
        return cast("Estimate", self._core.estimate())

    @property
    def health(self) -> Health:
        """Capacity, resistance and current offset, with standard deviations."""
        self._hook.pull()
        health = self._health.health
        is_filtering = self._core.get("state")["is_filtering"]
        return health._replace(offset_a=self._core.offset_a()) if is_filtering else health

    @property
    def time_s(self) -> float:
        """The estimator's own time at the latest sample [s]: it always increases."""
        return float(self._core.get("clock")["last_s"])

    def uncounted_std_pct(self, seconds: float) -> float:
        """Return what the SoC's standard deviation lacks [%] when no sample came for a time [s]."""
        return float(self._core.uncounted_std_pct(seconds))

    def pack_tick(self, sample: Sample) -> PackTick:
        """Return what is known of the pack after its latest sample, for its cells."""
        self._pull()
        return super().pack_tick(sample)

    def current_changes(self, time_s: float, stamps_s: Sequence[float]) -> list[float]:
        """Return the current at a sample's time less that at other stamps [A]; NaN for NaN."""
        self._pull()
        return super().current_changes(time_s, stamps_s)

    def power(self) -> Power:
        """Return the currents possible for 10 s and the energy left, after the latest sample."""
        self._pull()
        return super().power()

    def snapshot(self) -> EstimatorState:
        """Return a copy of everything needed to continue as if not interrupted."""
        self._pull()
        self._hook.pull()
        state = super().snapshot()
        effects = [self._effect_state(number) for number in range(len(self._forms))]
        return state.model_copy(update={"effects": effects})

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Continue from a state of the same model; see `Estimator.restore`."""
        with self._python():
            return super().restore(state, age_s)

    def take_over(self, before: Estimator) -> None:
        """Continue from another estimator; see `Estimator.take_over`."""
        with self._python():
            super().take_over(before)

    @contextmanager
    def _python(self) -> Iterator[None]:
        """Let the reference change its own state, which the core then continues from."""
        self._in_python = True
        self._hook.pull()
        try:
            yield
        finally:
            self._in_python = False
        self._push()

    def _pull(self) -> None:
        """Copy the core's state, but for delay line and effects, into that of the reference."""
        core = self._core
        core.estimate()
        latest = core.get("latest")
        status, reasons = Status(latest.pop("status")), Reason(latest.pop("reasons"))
        self._latest, self._pending = Estimate(**latest, status=status, reasons=reasons), None
        clock, counter = core.get("clock"), core.get("counter")
        age_s = clock.pop("age_s")
        self._clock.restore(
            age_s=age_s if clock.pop("is_restored") else None, state=ClockState(**clock)
        )
        is_restored = counter.pop("is_restored")
        self._counter.restore(CounterState(**counter), is_restored=is_restored)
        self._since = ChargeSinceUpdate(**core.get("since"))
        self._memory = EstimatorMemory(**core.get("memory"))
        self._references.state = ReferenceState(**core.get("references"))
        self._is_filtering = core.get("state")["is_filtering"]
        self._without_ocv_v = math.nan
        self._pull_filter()

    def _pull_filter(self) -> None:
        fields = self._core.get("filter")
        names = _HYPOTHESES[: fields.pop("hypotheses")]
        hypotheses = []
        for name in names:
            ekf = self._core.get(name)
            size, stride = KT + 1 + self._functions.number, _core.STATES
            rows = [ekf["p"][k * stride : k * stride + size] for k in range(LEARNED)]
            hypotheses.append(
                EkfState(ekf["x"][:size], rows, ekf["mean_innovation_v"], ekf["mean_seconds"])
            )
        fields.pop("stated_pct")
        verdict = VERDICTS[fields.pop("verdict")]
        self._filter.resume(HypothesisFilterState(hypotheses, verdict=verdict, **fields))

    def _push(self) -> None:
        """Let the core continue from the state of the reference."""
        core = self._core
        is_restored, age_s = self._clock.age_s is not None, self._clock.age_s or 0.0
        core.set("clock", asdict(self._clock.state) | {"age_s": age_s, "is_restored": is_restored})
        is_restored = self._counter.is_restored
        core.set("counter", asdict(self._counter.state) | {"is_restored": is_restored})
        core.set("since", asdict(self._since))
        core.set("memory", asdict(self._memory))
        core.set("references", asdict(self._references.state))
        core.set("latest", self._latest._asdict())
        core.set("state", {
            "is_pending": False, "is_filtering": self._is_filtering, "is_refused": False,
            "has_other_capacity": self._has_other_capacity(), "implausible": 0, "beside_soc_v": 0.0,
        })  # fmt: skip
        self._push_filter()
        self._hook.push()
        for number, state in enumerate(self._online.state()):
            self._push_effect(number, state)

    def _push_filter(self) -> None:
        state = self._filter.snapshot()
        for name, ekf in zip(_HYPOTHESES, state.hypotheses, strict=False):
            self._core.set(name, {
                "x": ekf.x, "p": _with_stride(ekf.p, _core.STATES), "was_outlier": False,
                "mean_innovation_v": ekf.mean_innovation_v, "mean_seconds": ekf.mean_seconds,
            })  # fmt: skip
        count, verdict = len(state.hypotheses), VERDICTS.index(state.verdict)
        self._core.set(
            "filter",
            vars(state) | {"hypotheses": count, "verdict": verdict, "stated_pct": math.nan},
        )

    def _effect_state(self, number: int) -> list[float]:
        """Return the state of an effect as `OnlineEffect.state` does."""
        kind = self._forms[number].kind
        if kind == "time_skew":
            return list(self._core.get_skew())
        numbers = _LAG[:1] if kind == "resistance_step" else _LAG
        lags = self._core.get_lags(number)
        return [lag[name] for lag in lags if lag["is_started"] for name in numbers]

    def _push_effect(self, number: int, state: Sequence[float]) -> None:
        """Set the state of an effect from that of `OnlineEffect.state`."""
        form = self._forms[number]
        if form.kind == "time_skew":
            waiting = 4 * int(state[0])
            times, currents = np.array(state[1 + waiting :]).reshape(2, -1).tolist()
            self._core.set_skew(list(state[1 : 1 + waiting]), times, currents)
            return
        numbers = 1 if form.kind == "resistance_step" else len(_LAG)
        lags = [
            dict(zip(_LAG, [*state[k : k + numbers], 0.0, 0.0], strict=False), is_started=True)
            for k in range(0, len(state), numbers)
        ]
        volts = 0.0
        if form.kind == "rc":  # until the temperature comes with the next sample
            volts = total(
                -ohm * lag["value"] for ohm, lag in zip(form.values[3:], lags, strict=False)
            )
        self._core.set_lags(number, volts, lags)


class _CoreLine(DelayLine):
    """The core's delay line."""

    def __init__(self, delay_s: Sequence[float], core: Any) -> None:
        super().__init__(delay_s)
        self._core = core

    @property
    def filled_s(self) -> float:
        return float(self._core.filled_s())

    def currents(self) -> list[float]:
        return [self.current_at(delay_s) for delay_s in self._delays]

    def current_at(self, ago_s: float) -> float:
        return float(self._core.current_at(ago_s))

    @property
    def contents(self) -> tuple[list[float], list[float], float]:
        times, currents, since_s = self._core.line()
        return times, currents, since_s

    def fill(self, time_s: Sequence[float], current_a: Sequence[float], since_s: float) -> None:
        self._core.fill_line(list(time_s), list(current_a), since_s)


_SUMS: Final = (
    "seconds", "away_s", "discharged_pct", "moved_pct", "gap_var_pct2",
    "is_started", "sum_v", "sum_drop_v", "window_s", "ticks",
)  # fmt: skip
"""Fields of `HealthState` that the core adds to."""


class _Hook:
    """What the core calls where a voltage does more to the health than add to its sums."""

    core: Any
    health: HealthEstimator
    is_other: Callable[[], bool]

    def count(self, *since: float) -> bool:
        """Take the charge before and in an unobserved interval."""
        with self._in_python():
            self.health.count(ChargeSinceUpdate(*since))
        return self.is_other()

    def tick(self, since: tuple[float, ...], passed_s: float, *tick: Any) -> bool:
        """Take charge and, where there is one, voltage at a tick of the model's rate."""
        with self._in_python():
            self.health.count(ChargeSinceUpdate(*since))
            if tick:
                self.health.use(VoltageTick(*tick), passed_s)
        return self.is_other()

    def correct(self, soc_pct: float, std_pct: float) -> bool:
        """Take a SoC that is known other than by voltage."""
        with self._in_python():
            self.health.correct(soc_pct, std_pct)
        return self.is_other()

    @contextmanager
    def _in_python(self) -> Iterator[None]:
        self.pull()
        yield
        self.push()

    def pull(self) -> None:
        """Copy the core's sums into the reference."""
        sums = self.core.get_health()
        for name in _SUMS:
            setattr(self.health.state, name, sums[name])
        waiting, details = iter(sums["waiting"]), iter(sums["sums"])
        self.health.resistance.state = ResistanceState(
            sums["block"],
            [[first, next(waiting)] for first in waiting],
            [[first, next(details), next(details), next(details)] for first in details],
        )

    def push(self) -> None:
        """Let the core continue from the sums of the reference."""
        health = self.health
        resistance = health.resistance.state
        soc_pct, gain, offset_a = health.propagated
        sums: dict[str, Any] = {name: getattr(health.state, name) for name in _SUMS}
        self.core.set_health(sums | {
            "block": resistance.block,
            "waiting": [number for pair in resistance.waiting for number in pair],
            "sums": [number for scale in resistance.sums for number in scale],
            "soc_pct": soc_pct, "gain": gain, "offset_a": offset_a,
            "pct_per_as": health.pct_per_as, "full_window_s": WINDOW_S,
            "full_block_s": SHORTEST_BLOCK_S, "memory_s": RESISTANCE_TIME_S,
        })  # fmt: skip


def _with_stride(rows: Sequence[Sequence[float]], stride: int) -> list[float]:
    """Return a matrix by rows of a length, filled up with zeros."""
    return [value for row in rows for value in (*row, *(0.0,) * (stride - len(row)))]
