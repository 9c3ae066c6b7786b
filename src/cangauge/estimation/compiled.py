"""The estimator with its step in C, some hundred times as fast and within 1e-9 of Python's.

`Estimator` is the reference. `CompiledEstimator` hands each sample to the extension `_core`; what
is rare (health, power, states to save) reads the core's state into the reference. It is used
wherever the extension was built at installation, live and offline, unless `CANGAUGE_PURE_PYTHON` is
set.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
from numpy.typing import NDArray

from cangauge._core_digest import sources_digest
from cangauge._logging import emit
from cangauge._typing import FloatArray
from cangauge.estimation import core_layout as layout
from cangauge.estimation.cells import PackTick
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.estimation.state import (
    BiasState,
    BlockState,
    ClockState,
    CounterState,
    EstimatorMemory,
    EstimatorState,
    FilterState,
    HypothesesState,
)
from cangauge.model.delay_line import BLOCK, SPACING_S
from cangauge.model.effects.base import CoreForm
from cangauge.model.model_file import Model
from cangauge.types import REASONS, Estimate, Health, Power, Reason, Sample, Status

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
            _LOG, logging.WARNING, "core.stale",
            "the compiled core is not of these sources: continuing in Python; "
            "compile it by `python hatch_build.py`",
        )  # fmt: skip
        return None
    return core


_core: Final = _load(Path(__file__).parents[3])
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
        self._over_soc = [effect.uses_soc for effect, _ in self._online.extended.effects]
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
        self._is_pulled = False

    def _part(self, name: str, of: np.dtype[Any]) -> NDArray[Any]:
        """Return the core's memory of a part; it lives as long as the core."""
        return np.frombuffer(self._core.memory(name), of)

    def update(self, sample: Sample) -> None:
        """Process one sample; see `Estimator.update`."""
        self.is_refused = not self._core.update(sample)
        self._is_pulled = False

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
        self._is_pulled = False
        return found

    @property
    def estimate(self) -> Estimate:
        """The estimate after the latest sample; see `Estimator.estimate`."""
        return cast("Estimate", self._core.estimate())

    @property
    def health(self) -> Health:
        """Capacity, resistance and current offset, with standard deviations."""
        self._pull()
        return super().health

    def uncounted_std_pct(self, seconds: float) -> float:
        """Return what the SoC's standard deviation lacks [%] when no sample came for a time [s]."""
        return float(self._core.uncounted_std_pct(seconds))

    def pack_tick(self, sample: Sample) -> PackTick:
        """Return what is known of the pack after its latest sample, for its cells."""
        self._pull()
        return super().pack_tick(sample)

    def current_changes(self, time_s: float, stamps_s: Sequence[float]) -> list[float]:
        """Return the current at a sample's time less that at other stamps [A]; NaN for NaN."""
        now_a, at = self._core.current_at(0.0), self._core.current_at
        return [each if math.isnan(each) else now_a - at(time_s - each) for each in stamps_s]

    def power(self) -> Power:
        """Return the currents possible for 10 s and the energy left, after the latest sample."""
        self._pull()
        self._pull_model()
        return super().power()

    def snapshot(self) -> EstimatorState:
        """Return a copy of everything needed to continue as if not interrupted."""
        self._pull()
        self._pull_model()
        return super().snapshot()

    def restore(self, state: EstimatorState, age_s: float = 0.0) -> Estimate:
        """Continue from a state of the same model; see `Estimator.restore`."""
        with self._changed():
            return super().restore(state, age_s)

    def take_over(self, before: Estimator) -> None:
        """Continue from another estimator; see `Estimator.take_over`."""
        with self._changed():
            super().take_over(before)

    @contextmanager
    def _changed(self) -> Iterator[None]:
        """Let the reference change its own state, which the core then continues from."""
        yield
        self._push()

    def _pull(self) -> None:
        """Read the core's state, but for its voltage model, into the reference, once a sample."""
        if self._is_pulled:
            return
        self._is_pulled = True
        self._core.estimate()
        record, self._pending = self._record, None
        latest = _plain(record["latest"])
        latest |= {"status": Status(latest["status"]), "reasons": Reason(latest["reasons"])}
        self._latest = Estimate(**latest)
        clock, counter, block = (_plain(record[name]) for name in ("clock", "counter", "block"))
        age_s = clock.pop("age_s") if clock.pop("is_restored") else None
        clock.pop("age_s", None)
        self._clock.restore(ClockState(**clock), age_s)
        is_restored = counter.pop("is_restored")
        self._counter.restore(CounterState(**counter), is_restored=is_restored)
        used = 5 + len(self._online.load_coefficients)
        beside, over = self._split(block.pop("drive"))
        if block["rows"]:
            block["columns"], block["sums"] = used - 5, [*block["sums"][:used], beside, *over]
        else:
            block["sums"] = []
        self._block.restore(BlockState(**block))
        memory = _plain(record["memory"])
        memory["doubt"] = layout.DOUBTS[memory["doubt"]]
        memory["innovations"] = memory.pop("innovation2")[: memory["innovations"]]
        self._memory = EstimatorMemory(**memory)
        self.hypotheses.restore(self._hypotheses_state())
        beside_v, _ = self._split(record["drive"].tolist())
        drives = record["drive"][: len(self._forms)].tolist()
        self._online.resume(record["load"][: used - 5].copy(), beside_v, drives)

    def _split(self, drives: Sequence[float]) -> tuple[float, list[float]]:
        """Return the sum of the drives of effects beside the SoC, and those over it."""
        pairs = list(zip(self._over_soc, drives, strict=False))
        beside = sum(drive for is_over, drive in pairs if not is_over)
        return beside, [drive for is_over, drive in pairs if is_over]

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

    def _pull_model(self) -> None:
        """Read delay line, low-passed currents and effects into the reference's voltage model."""
        line, record = self._part("line", layout.LINE)[0], self._record
        places = (line["first"] + np.arange(line["count"])) % line["size"]
        currents = self._part("currents", layout.CURRENT)[places]
        self._online.delay_line.fill(
            currents["time_s"].tolist(), currents["current_a"].tolist(), float(line["since_s"])
        )
        lags = record["low_pass"][: len(self._online.lags)]
        states = [self._effect_state(number) for number in range(len(self._forms))]
        self._online.restore([_numbers(lags, _LAG), *states])

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

    def _push(self) -> None:
        """Let the core continue from the state of the reference."""
        record, memory = self._record, asdict(self._memory)
        age_s = self._clock.age_s
        clock = {"age_s": age_s or 0.0, "is_restored": age_s is not None}
        _set(record["clock"], asdict(self._clock.state) | clock)
        is_restored = {"is_restored": self._counter.is_restored}
        _set(record["counter"], asdict(self._counter.state) | is_restored)
        memory["doubt"] = layout.DOUBTS.index(memory["doubt"])
        squares = memory.pop("innovations")
        record["memory"]["innovation2"][: len(squares)] = squares
        _set(record["memory"], memory | {"innovations": len(squares)})
        block = asdict(self._block.snapshot())
        sums, columns = block.pop("sums"), block.pop("columns")
        record["block"]["sums"] = record["block"]["drive"] = record["drive"] = 0.0
        if sums:
            used, over = 5 + columns, np.array(self._over_soc, dtype=bool)
            record["block"]["sums"][:used] = sums[:used]
            record["block"]["drive"][np.flatnonzero(over)] = sums[used + 1 :]
            record["block"]["drive"][np.flatnonzero(~over)[:1]] = sums[used]
        _set(record["block"], block)
        _set(record["latest"], self._latest._asdict())
        record["is_pending"] = record["is_refused"] = False
        record["implausible"] = 0
        hypotheses = self.hypotheses.snapshot()
        for ekf, state in zip(record["filter"]["ekf"], hypotheses.filters, strict=False):
            n = len(state.x)
            ekf["x"][:n], ekf["evidence"] = state.x, state.evidence
            ekf["p"][: n * (n + 1) // 2] = np.array(state.p)[np.tril_indices(n)]
            ekf["b"], ekf["b_p"], ekf["b_v"][:n] = state.bias.b, state.bias.p, state.bias.v
        record["filter"]["hypotheses"] = len(hypotheses.filters)
        record["filter"]["prior_log_odds"] = hypotheses.prior_log_odds
        record["filter"]["decision"] = hypotheses.decision
        self._push_model()

    def _push_model(self) -> None:
        times, currents, since_s = self._online.delay_line.contents
        line, storage = self._part("line", layout.LINE)[0], self._part("currents", layout.CURRENT)
        count = min(len(times), storage.size)
        storage["time_s"][:count] = times[len(times) - count :]
        storage["current_a"][:count] = currents[len(times) - count :]
        line["first"], line["count"], line["since_s"] = 0, count, since_s
        low_passed, *effects = self._online.state()
        _set_lags(self._record["low_pass"], low_passed, 3)
        for number, state in enumerate(effects):
            kind = self._forms[number].kind
            if kind == "time_skew":
                skew, waiting = self._part("skew", layout.SKEW)[0], int(state[0])
                readings = np.array(state[1 : 1 + 4 * waiting]).reshape(waiting, 4)
                kept = np.array(state[1 + 4 * waiting :]).reshape(2, -1)
                count = skew["count"] = max(waiting, kept.shape[1])
                skew["waiting"], skew["first"] = count - waiting, count - kept.shape[1]
                at = skew["at"]
                at["time_s"][skew["first"] : count], at["current_a"][skew["first"] : count] = kept
                for column, name in enumerate(layout.SAMPLE.names or ()):
                    at[name][skew["waiting"] : count] = readings[:, column]
            else:
                lags = self._record["effect"][number]["lag"]
                _set_lags(lags, state, 1 if kind == "resistance_step" else 3)


def _plain(record: Any) -> dict[str, Any]:
    """Return the fields of a record as numbers and lists."""
    return {name: record[name].tolist() for name in record.dtype.names}


def _set(record: Any, values: dict[str, Any]) -> None:
    for name, value in values.items():
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
