"""Time skew between current and voltage: the time stamps of the current are `skew_s` late."""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from cangauge.model.effects.base import (
    CoreForm,
    Effect,
    OnlineEffect,
    Pack,
    Parameter,
    Reading,
    Signals,
    Values,
)
from cangauge.model.voltage_model import VoltageModel


class TimeSkew(Effect):
    """The current that belongs to a voltage is found `skew_s` later in the log.

    The current is interpolated, never the voltage: averaging neighbouring voltages would reduce
    their noise and look like an improvement. Online, with a positive skew, a voltage is held until
    its current arrives, so estimates are `skew_s` late. The last rows of a log, whose current never
    arrives, use the last current offline and are withheld online.
    """

    id = "time_skew"
    family = "timing"
    is_structure: ClassVar[bool] = True
    parameters = (
        Parameter(
            "skew_s",
            "s",
            -4.0,
            4.0,
            grid=(-4.0, -3.0, -2.0, -1.5, -1.0, -0.7, -0.5, -0.35, -0.2, -0.1, 0.0,
                  0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0),
        ),
    )  # fmt: skip
    signature = "∝ R·dI/dt: spikes of either sign at every change of load"
    equation = "I(t) = I_measured(t + skew)"
    source = "definition"
    secant_points = (-0.9, -0.6, -0.35, -0.2, -0.1, 0.1, 0.2, 0.35, 0.6, 0.9)
    separated_by = (
        "a log at 10 Hz or faster: a skew gives spikes of both signs and the same area at both"
        " ends of a pulse, fast_polarization a tail after each"
    )

    def correct(self, signals: Signals, values: Values, pack: Pack) -> Signals:
        skew_s = values["skew_s"]
        if skew_s == 0.0:
            return signals
        shifted = signals.history.shifted(skew_s)
        return replace(signals, current_a=shifted.current_a, cached_history=shifted)

    def online(self, values: Values, model: VoltageModel, pack: Pack) -> OnlineEffect:
        return _TimeSkewOnline(values["skew_s"]) if values["skew_s"] != 0.0 else OnlineEffect()


class _TimeSkewOnline(OnlineEffect):
    def __init__(self, skew_s: float) -> None:
        self._skew_s = skew_s
        self._waiting: deque[Reading] = deque()
        self._times: list[float] = []
        self._currents: list[float] = []

    def core_form(self) -> CoreForm:
        return CoreForm("time_skew", (self._skew_s,))

    def correct(self, reading: Reading) -> Sequence[Reading]:
        self._times.append(reading.time_s)
        self._currents.append(reading.current_a)
        self._waiting.append(reading)
        ready = []
        while self._waiting and self._waiting[0].time_s + self._skew_s <= reading.time_s:
            first = self._waiting.popleft()
            ready.append(first._replace(current_a=self._current_at(first.time_s + self._skew_s)))
        self._drop_stale(reading.time_s)
        return ready

    def _current_at(self, time_s: float) -> float:
        right = bisect_right(self._times, time_s)
        if right == 0:
            return self._currents[0]
        if right == len(self._times):
            return self._currents[-1]
        t0, t1 = self._times[right - 1], self._times[right]
        c0, c1 = self._currents[right - 1], self._currents[right]
        return c0 + (c1 - c0) * (time_s - t0) / (t1 - t0)

    def _drop_stale(self, now_s: float) -> None:
        upcoming = self._waiting[0].time_s if self._waiting else now_s
        stale = bisect_right(self._times, upcoming + self._skew_s) - 1
        if stale > 64:
            del self._times[:stale]
            del self._currents[:stale]

    def state(self) -> list[float]:
        flat = [value for reading in self._waiting for value in reading]
        return [float(len(self._waiting)), *flat, *self._times, *self._currents]

    def restore(self, state: Sequence[float], latest_s: float) -> None:
        waiting = int(state[0]) if state else -1
        first = 1 + 4 * waiting
        kept, odd = divmod(len(state) - first, 2)
        if waiting < 0 or kept < 0 or odd:
            raise ValueError("not the waiting readings followed by times and as many currents")
        readings = [Reading(*state[k : k + 4]) for k in range(1, first, 4)]
        times, currents = list(state[first : first + kept]), list(state[first + kept :])
        stamps = [reading.time_s for reading in readings]
        if not all(map(math.isfinite, [*times, *currents, *stamps])):
            raise ValueError("not finite")
        if any(b <= a for kind in (times, stamps) for a, b in itertools.pairwise(kind)):
            raise ValueError("times must increase")
        if times and not times[-1] <= latest_s:
            raise ValueError("later than the latest sample")
        # The waiting readings are the latest samples, and the kept times end with the same ones.
        both = min(waiting, kept)
        if stamps[waiting - both :] != times[kept - both :] or (waiting and not kept):
            raise ValueError("the waiting readings do not match the times")
        self._waiting, self._times, self._currents = deque(readings), times, currents
