"""The estimator with its step in C, some hundred times as fast and within 1e-9 of Python's.

`Estimator` is the reference. `CompiledEstimator` hands each sample to the extension `_core`. The
core's memory and an `EstimatorState` hold the same; what is rare (health, power) is computed by the
reference, restored from that state. It is used wherever the extension was built at installation,
live and offline, unless `CANGAUGE_PURE_PYTHON` is set.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from cangauge._core_digest import sources_digest
from cangauge._logging import emit
from cangauge._typing import FloatArray
from cangauge.estimation import core_layout as layout
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.state import (
    SCALARS,
    BiasState,
    BlockState,
    ClockState,
    CounterState,
    DelayLineState,
    EstimatorMemory,
    EstimatorState,
    FilterState,
    HypothesesState,
)
from cangauge.model.delay_line import BLOCK, SPACING_S
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
    is_stale = (folder / "cangauge.h").is_file() and sources_digest(folder) != core.SOURCES
    if is_stale or any(
        getattr(layout, name.upper()).itemsize != size for name, size in core.SIZES.items()
    ):
        emit(
            _LOG,
            logging.WARNING,
            "core.stale",
            "the compiled core is not of these sources: continuing in Python; "
            "compile it by `python hatch_build.py`",
        )
        return None
    return core


_core: Final = _load(Path(__file__).parents[3])
_State = TypeVar("_State")
_LAG: Final = ("time_s", "input", "value")


def is_compiled() -> bool:
    """Return whether estimators are compiled ones."""
    return _core is not None and not os.environ.get("CANGAUGE_PURE_PYTHON")


def make_estimator(model: Model, settings: EstimatorSettings | None = None) -> Estimator:
    """Return an estimator, compiled where the extension is present and knows the model's effects.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings, optional
    """
    settings = settings or EstimatorSettings()
    if is_compiled():
        forms = layout.core_forms(model.online(settings.capacity_ah, settings.gap_s))
        if forms is not None:
            return CompiledEstimator(model, settings, forms)
    return Estimator(model, settings)


class CompiledEstimator(Estimator):
    """`Estimator` whose step is compiled; see `make_estimator`.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings
    forms : list of CoreForm
        The model's effects in the core.
    """

    core: ClassVar[str] = "compiled"

    def __init__(self, model: Model, settings: EstimatorSettings, forms: list[CoreForm]) -> None:
        super().__init__(model, settings)
        longest_s = self._online.delay_line.longest_s
        self._forms = forms
        self._is_over_soc = np.array([e.uses_soc for e, _ in self._online.extended.effects], bool)
        self._core: Any = _core.Core(
            layout.model_constants(model, self._online, forms, self.tests).tobytes(),
            layout.settings_constants(model, settings).tobytes(),
            int(2.0 * longest_s / SPACING_S) + 2 * BLOCK,
            BLOCK,
            SPACING_S,
            Estimate,
            tuple(Status),
            REASONS,
        )
        self._record = self._part("state", layout.STATE)[0]
        self._is_current = False

    def _part(self, name: str, of: np.dtype[Any]) -> NDArray[Any]:
        """Return the core's memory of a part; it lives as long as the core."""
        return np.frombuffer(self._core.memory(name), of)

    def update(self, sample: Sample) -> None:
        """Process one sample; see `Estimator.update`."""
        self.is_refused = not self._core.update(sample)
        self._is_current = False

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
        given = [np.ascontiguousarray(each, dtype=np.float64) for each in columns]
        rows = given[0].size
        found: list[NDArray[Any]] = [np.empty(rows) for _ in range(7)]
        found += [np.empty(rows, np.int64) for _ in range(2)]
        self._core.run((*given, *found))
        self._is_current = False
        return found

    @property
    def estimate(self) -> Estimate:
        """The estimate after the latest sample; see `Estimator.estimate`."""
        return cast("Estimate", self._core.estimate())

    @property
    def row(self) -> int:
        """Number of the row whose voltage was compared with the model last; −1 before any."""
        return int(self._record["memory"]["tick"])

    def uncounted_std_pct(self, seconds: float) -> float:
        """Return what the SoC's standard deviation lacks [%] when no sample came for a time [s]."""
        return float(self._core.uncounted_std_pct(seconds))

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Continue from a state of the same model; see `Estimator.restore`."""
        latest = super().restore(state, age_s)
        self._write()
        return latest

    def take_over(self, before: Estimator) -> None:
        """Continue from another estimator; see `Estimator.take_over`."""
        super().take_over(before)
        self._write()

    def snapshot(self) -> EstimatorState:
        """Return a copy of everything needed to continue as if not interrupted."""
        self._core.estimate()  # computes the latest one in the record
        record = self._record
        memory, latest = record["memory"], record["latest"]
        innovations = memory["innovation2"][: memory["innovations"]].tolist()
        line = self._part("line", layout.LINE)[0]
        places = (line["first"] + np.arange(line["count"])) % line["size"]
        currents = self._part("currents", layout.CURRENT)[places]
        lags = record["low_pass"][: len(self._online.lags)]
        effects = [self._effect_state(number) for number in range(len(self._forms))]
        return EstimatorState.model_construct(
            method=self.settings.method,
            capacity_ah=self.capacity_ah,
            clock=_read(ClockState, record["clock"]),
            counter=_read(CounterState, record["counter"]),
            line=DelayLineState(
                currents["time_s"].tolist(), currents["current_a"].tolist(), float(line["since_s"])
            ),
            online=[_numbers(lags, _LAG), *effects],
            block=self._block_state(),
            hypotheses=self._hypotheses_state(),
            memory=_read(EstimatorMemory, memory, innovations=innovations),
            estimate=[float(latest[name]) for name in Estimate._fields[:7]],
            reasons=int(latest["reasons"]),
        )

    def _refresh(self) -> None:
        """Restore the reference from the core, once a sample."""
        if self._is_current:
            return
        self._is_current = True
        record = self._record
        clock, load = record["clock"], record["load"][: self._online.load_coefficients.size]
        self._continue(self.snapshot(), float(clock["age_s"]) if clock["is_restored"] else None)
        self._online.resume(load.copy(), np.array(self._drives(record["drive"])))

    def _write(self) -> None:
        """Let the core continue from the reference."""
        record, state, age_s = self._record, super().snapshot(), self._clock.age_s
        self._is_current = False
        _set(record["clock"], vars(state.clock), age_s=age_s or 0.0, is_restored=age_s is not None)
        _set(record["counter"], vars(state.counter))
        squares = state.memory.innovations
        _set(record["memory"], vars(state.memory), innovations=len(squares))
        record["memory"]["innovation2"][: len(squares)] = squares
        _set(record["latest"], self._latest._asdict())
        record["is_pending"] = record["is_refused"] = False
        record["implausible"] = 0
        record["drive"] = 0.0
        self._write_block(state.block)
        for ekf, each in zip(record["filter"]["ekf"], state.hypotheses.filters, strict=False):
            n = len(each.x)
            ekf["x"][:n], ekf["evidence"] = each.x, each.evidence
            ekf["p"][: n * (n + 1) // 2] = np.array(each.p)[np.tril_indices(n)]
            ekf["b"], ekf["b_p"], ekf["b_v"][:n] = each.bias.b, each.bias.p, each.bias.v
        record["filter"]["hypotheses"] = len(state.hypotheses.filters)
        record["filter"]["prior_log_odds"] = state.hypotheses.prior_log_odds
        record["filter"]["decision"] = state.hypotheses.decision
        line, storage = self._part("line", layout.LINE)[0], self._part("currents", layout.CURRENT)
        count = min(len(state.line.time_s), storage.size)
        storage["time_s"][:count] = state.line.time_s[-count:]
        storage["current_a"][:count] = state.line.current_a[-count:]
        line["first"], line["count"], line["since_s"] = 0, count, state.line.since_s
        low_passed, *effects = state.online
        _set_lags(record["low_pass"], low_passed, 3)
        for number, numbers in enumerate(effects):
            self._write_effect(number, numbers)

    def _drives(self, of_effects: NDArray[Any]) -> list[float]:
        """Return drives as the reference has them: those beside the SoC in one sum, the others."""
        drives = of_effects[: self._is_over_soc.size]
        return [sum(drives[~self._is_over_soc].tolist()), *drives[self._is_over_soc].tolist()]

    def _block_state(self) -> BlockState:
        block, columns = self._record["block"], self._online.load_coefficients.size
        if not block["rows"]:
            return _read(BlockState, block, columns=0, sums=[])
        sums = [*block["sums"][: SCALARS + columns].tolist(), *self._drives(block["drive"])]
        return _read(BlockState, block, columns=columns, sums=sums)

    def _write_block(self, state: BlockState) -> None:
        block, used, over = self._record["block"], SCALARS + state.columns, self._is_over_soc
        for name in ("number", "rows", "is_broken"):
            block[name] = getattr(state, name)
        block["sums"] = block["drive"] = 0.0
        if state.sums:
            block["sums"][:used] = state.sums[:used]
            block["drive"][np.flatnonzero(over)] = state.sums[used + 1 :]
            block["drive"][np.flatnonzero(~over)[:1]] = state.sums[used]  # of all of them

    def _hypotheses_state(self) -> HypothesesState:
        record, n = self._record["filter"], 4 + self._online.functions.number
        row, column = np.indices((n, n))
        high, low = np.maximum(row, column), np.minimum(row, column)
        filters = [
            FilterState(
                ekf["x"][:n].tolist(),
                ekf["p"][high * (high + 1) // 2 + low].tolist(),
                float(ekf["evidence"]),
                BiasState(ekf["b"].tolist(), ekf["b_p"].tolist(), ekf["b_v"][:n].tolist()),
            )
            for ekf in record["ekf"][: record["hypotheses"]]
        ]
        return HypothesesState(filters, float(record["prior_log_odds"]), int(record["decision"]))

    def _effect_state(self, number: int) -> list[float]:
        """Return the state of an effect as its memory does."""
        kind = self._forms[number].kind
        if kind == "time_skew":
            skew = self._part("skew", layout.SKEW)[0]
            waiting, at = (
                skew["at"][np.arange(skew[oldest], skew["count"]) % skew["at"].size]
                for oldest in ("waiting", "first")
            )
            readings = [number for each in waiting.tolist() for number in each]
            currents = at["time_s"].tolist() + at["current_a"].tolist()
            return [float(len(waiting)), *readings, *currents]
        lags = self._record["effect"][number]["lag"]
        return _numbers(lags, _LAG[:1] if kind == "resistance_step" else _LAG)

    def _write_effect(self, number: int, state: Sequence[float]) -> None:
        kind = self._forms[number].kind
        if kind != "time_skew":
            lags = self._record["effect"][number]["lag"]
            _set_lags(lags, state, 1 if kind == "resistance_step" else 3)
            return
        skew, waiting = self._part("skew", layout.SKEW)[0], int(state[0])
        readings = np.array(state[1 : 1 + 4 * waiting]).reshape(waiting, 4)
        kept = np.array(state[1 + 4 * waiting :]).reshape(2, -1)
        count = skew["count"] = max(waiting, kept.shape[1])
        skew["waiting"], skew["first"] = count - waiting, count - kept.shape[1]
        at = skew["at"]
        at["time_s"][skew["first"] : count], at["current_a"][skew["first"] : count] = kept
        for column, name in enumerate(layout.SAMPLE.names or ()):
            at[name][skew["waiting"] : count] = readings[:, column]


def _read(of: type[_State], record: Any, **others: Any) -> _State:
    """Return a state from the fields of a record that have its names, and others."""
    names = (item.name for item in fields(cast("Any", of)) if item.name not in others)
    return of(**{name: record[name].tolist() for name in names}, **others)


def _set(record: Any, values: dict[str, Any], **others: Any) -> None:
    for name, value in (values | others).items():
        record[name] = value


def _numbers(lags: NDArray[Any], names: Sequence[str]) -> list[float]:
    return [float(lag[name]) for lag in lags if lag["is_started"] for name in names]


def _set_lags(lags: NDArray[Any], numbers: Sequence[float], each: int) -> None:
    """Set the lags of an effect from `each` numbers of those that have started."""
    lags["is_started"] = False
    for lag, first in zip(lags, range(0, len(numbers), each), strict=False):
        lag["is_started"] = True
        for name, value in zip(_LAG, numbers[first : first + each], strict=False):
            lag[name] = value
