"""Time skew between current and voltage: the time stamps of the current are `skew_s` late."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cangauge.model.effects.base import (
    CoreForm,
    Effect,
    Memories,
    Pack,
    Parameter,
    Signals,
    Values,
)
from cangauge.model.first_order import Memory
from cangauge.model.voltage_model import VoltageModel

STALE = 64
"""Currents that are not needed any more are dropped from this number on."""


class TimeSkew(Effect):
    """The current that belongs to a voltage is found `skew_s` later in the log.

    The current is interpolated, never the voltage: averaging neighbouring voltages would reduce
    their noise and look like an improvement. Online, with a positive skew, a voltage is held until
    its current arrives, so estimates are `skew_s` late. The last rows of a whole log, whose current
    never arrives, use the last current.
    """

    id = "time_skew"
    family = "timing"
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
    separated_by = (
        "a log at 10 Hz or faster: a skew gives spikes of both signs and the same area at both"
        " ends of a pulse, fast_polarization a tail after each"
    )

    def memory(self, values: Values, pack: Pack) -> Memories:
        return (_Waiting(values["skew_s"]),) if values["skew_s"] else ()

    def correct(self, signals: Signals, values: Values, pack: Pack, memory: Memories) -> Signals:
        return memory[0].step(signals) if memory else signals

    def core_form(self, values: Values, model: VoltageModel, pack: Pack) -> CoreForm:
        skew_s = values["skew_s"]
        return CoreForm("time_skew", (skew_s,)) if skew_s else CoreForm("no_effect")


class _Waiting(Memory):
    """Rows that wait for their current, and the currents that later rows need."""

    def __init__(self, skew_s: float) -> None:
        self._skew_s = skew_s
        self._waiting = np.empty((4, 0))
        self._currents = np.empty((2, 0))

    def step(self, signals: Signals) -> Signals:
        """Append rows and return those whose current has come."""
        self._waiting = np.concatenate([self._waiting, np.stack(signals)], axis=1)
        self._currents = np.concatenate([self._currents, np.stack(signals[:2])], axis=1)
        times, currents = self._currents
        at_s = self._waiting[0] + self._skew_s
        ready = at_s.size if self.whole else int(np.searchsorted(at_s, times[-1], side="right"))
        time_s, _, voltage_v, temperature_c = self._waiting[:, :ready]
        skewed = np.interp(at_s[:ready], times, currents)
        self._waiting = self._waiting[:, ready:]
        upcoming_s = self._waiting[0, 0] if self._waiting.size else times[-1]
        stale = int(np.searchsorted(times, upcoming_s + self._skew_s, side="right")) - 1
        if stale > STALE:
            self._currents = self._currents[:, stale:]
        return Signals(time_s, skewed, voltage_v, temperature_c)

    def state(self) -> list[float]:
        waiting = self._waiting.T.ravel().tolist()
        return [float(self._waiting.shape[1]), *waiting, *self._currents.ravel().tolist()]

    def restore(self, state: Sequence[float]) -> None:
        waiting = int(state[0]) if state else -1
        first = 1 + 4 * waiting
        kept, odd = divmod(len(state) - first, 2)
        if waiting < 0 or kept < 0 or odd:
            raise ValueError("not the waiting readings followed by times and as many currents")
        times = state[first : first + kept]
        stamps = state[1:first:4]
        if not all(map(math.isfinite, [*state[first:], *stamps])):
            raise ValueError("not finite")
        if any(np.any(np.diff(kind) <= 0.0) for kind in (times, stamps)):
            raise ValueError("times must increase")
        # The waiting readings are the latest samples, and the kept times end with the same ones.
        both = min(waiting, kept)
        if list(stamps[waiting - both :]) != list(times[kept - both :]) or (waiting and not kept):
            raise ValueError("the waiting readings do not match the times")
        self._waiting = np.array(state[1:first]).reshape(waiting, 4).T
        self._currents = np.array(state[first:]).reshape(2, kept)
