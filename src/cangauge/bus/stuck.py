"""A signal that stands still while another one proves that it should move.

Current and voltage of a pack move together: U falls by R1·I at once. A voltage whose code does
not change at all while the current swings to and fro, again and again, by so much that R1·ΔI is
many steps of the voltage, is stuck; and the other way round. Nothing is called stuck

- at rest, where neither moves;
- in a charge at constant current, where the voltage creeps one way: swings are counted, to and
  fro, not drift;
- for a voltage meter's noise beside a current of exactly 0: a swing of the voltage must be many
  times the model's own error.

Temperature has no such partner: coarse and slow, it stands still for hours in a healthy car. It
is called stuck only after a time that the user states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

SWINGS: Final = 4
"""Turning points that the other signal must show."""
FRAMES: Final = 10
"""Values that must have stood still."""
STEPS: Final = 8.0
"""Steps of the standing signal that a swing must be worth."""
ERRORS: Final = 8.0
"""Standard deviations of the fast voltage error that a swing of the voltage must be worth."""
SWING_C_RATE: Final = 0.1
"""A swing of the current must be worth this at least [1/h]: 5 A at 50 Ah."""
UNKNOWN_STEP: Final = 0.0025
"""Step of a voltage that never moved yet, relative to its value."""


@dataclass(frozen=True, slots=True)
class Pack:
    """What the model knows of a pack that helps to judge its signals.

    Parameters
    ----------
    resistance_ohm : float
        What the voltage falls by at once, positive [Ω].
    error_std_v : float
        Fast error of the voltage [V].
    capacity_ah : float
        [Ah].
    usual_v : float
        Voltage at half charge [V].
    """

    resistance_ohm: float
    error_std_v: float
    capacity_ah: float
    usual_v: float


class Still:
    """How long one signal has stood still.

    Parameters
    ----------
    step : float
        Its step as the frame has it [A, V]; the smallest move seen, where that is larger.

    Attributes
    ----------
    since_s : float
        Since when [s].
    values : int
        Values since then.
    """

    __slots__ = ("_frame_step", "_seen_step", "_value", "since_s", "values")

    def __init__(self, step: float) -> None:
        self._frame_step = step
        self._seen_step = math.inf
        self._value = math.nan
        self.since_s = math.nan
        self.values = 0

    def take(self, value: float, time_s: float) -> bool:
        """Take a value; return whether it moved (or time ran backwards)."""
        if value == self._value and time_s >= self.since_s:
            self.values += 1
            return False
        move = abs(value - self._value)
        if 0.0 < move < self._seen_step:
            self._seen_step = move
        self._value, self.since_s, self.values = value, time_s, 1
        return True

    def step(self, unknown: float) -> float:
        """Return its step [A, V]; `unknown` relative to its value where it never moved."""
        if math.isinf(self._seen_step):
            return max(self._frame_step, unknown * abs(self._value))
        return max(self._frame_step, self._seen_step)


class Swings:
    """Counts turning points at least `size` apart (zigzag)."""

    __slots__ = ("_high", "_low", "_rises", "count")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self._low, self._high = math.inf, -math.inf
        self._rises = 0
        self.count = 0

    def take(self, value: float, size: float) -> None:
        """Take a value."""
        # Of every value, so no `min` and `max`: they would cost more than all the rest.
        if value < self._low:  # noqa: PLR1730
            self._low = value
        if value > self._high:  # noqa: PLR1730
            self._high = value
        if self._rises <= 0 and value - self._low >= size:
            self._turn(1, value)
        elif self._rises >= 0 and self._high - value >= size:
            self._turn(-1, value)

    def _turn(self, rises: int, value: float) -> None:
        self.count += 1
        self._rises = rises
        self._low = self._high = value


class StuckPair:
    """Watches current and voltage for one that stands still while the other swings.

    Parameters
    ----------
    pack : Pack
    current_step_a, voltage_step_v : float
        Steps of the signals in their frames [A], [V]; 0 for floats.
    current_after_s, voltage_after_s : float
        Standing still for so long is suspicious [s].
    """

    def __init__(
        self,
        pack: Pack,
        *,
        current_step_a: float,
        voltage_step_v: float,
        current_after_s: float,
        voltage_after_s: float,
    ) -> None:
        self._pack = pack
        self._after_s = (current_after_s, voltage_after_s)
        self._current, self._voltage = Still(current_step_a), Still(voltage_step_v)
        # What the other one did while this one stood still.
        self._voltage_swings, self._current_swings = Swings(), Swings()
        self._size_current_swings()
        self._size_voltage_swings()

    def current(self, current_a: float, time_s: float) -> bool:
        """Take a current [A]; return whether the current is stuck."""
        if self._current.take(current_a, time_s):
            self._voltage_swings.reset()
            self._size_voltage_swings()
        self._current_swings.take(current_a, self._current_swing_a)
        return _stuck(self._current, self._voltage_swings, self._after_s[0], time_s)

    def voltage(self, voltage_v: float, time_s: float) -> bool:
        """Take a voltage [V]; return whether the voltage is stuck."""
        if self._voltage.take(voltage_v, time_s):
            self._current_swings.reset()
            self._size_current_swings()
        self._voltage_swings.take(voltage_v, self._voltage_swing_v)
        return _stuck(self._voltage, self._current_swings, self._after_s[1], time_s)

    def _size_current_swings(self) -> None:
        """Say what counts as a swing of the current [A], beside the voltage as it moves now."""
        pack = self._pack
        self._current_swing_a = math.inf
        if math.isfinite(pack.resistance_ohm) and pack.resistance_ohm > 0.0:
            swing_v = STEPS * self._voltage.step(UNKNOWN_STEP)
            self._current_swing_a = max(
                swing_v / pack.resistance_ohm, SWING_C_RATE * pack.capacity_ah
            )

    def _size_voltage_swings(self) -> None:
        """Say what counts as a swing of the voltage [V], beside the current as it moves now."""
        pack = self._pack
        swing_a = max(STEPS * self._current.step(0.0), SWING_C_RATE * pack.capacity_ah)
        size_v = max(swing_a * pack.resistance_ohm, ERRORS * pack.error_std_v)
        self._voltage_swing_v = size_v if size_v > 0.0 else math.inf


def _stuck(still: Still, swings: Swings, after_s: float, time_s: float) -> bool:
    return swings.count >= SWINGS and still.values >= FRAMES and time_s - still.since_s >= after_s
