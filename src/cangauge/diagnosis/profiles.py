"""Current profiles of tests that separate causes, within the limits of pack and user."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from cangauge._typing import FloatArray
from cangauge.diagnosis.problem import DiagnosisProblem
from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import discharged_ah
from cangauge.model.effects.base import WITHIN_C, Pack

MINUTES = 20.0
"""Duration of a test by default [min]."""

RARE = 0.02
"""Part of the references' rows whose current or SoC counts as unusual, on either side."""

SUSTAINED_C = 1.0
"""Largest current of minutes [C-rate]; the limits of the logs are those of seconds."""

HEAT_J_K_PER_KWH = 7000.0
"""Heat capacity of a pack: about 7 kg/kWh of about 1 kJ/(kg K) [J/(K kWh)]. A test is short, so
that heat flowing off is neglected."""

COLD_K = 5.0
"""A cold start begins at least this far below the usual temperature [K]."""

RESTING = "rest, until the delay line is filled"


@dataclass(frozen=True)
class Limits:
    """What a test may demand of pack and bench."""

    discharge_a: float
    """Largest discharging current [A]."""
    charge_a: float
    """Largest charging current, positive; 0 if the pack cannot be charged [A]."""
    soc_pct: tuple[float, float]
    """Lowest and highest SoC [%]."""
    temperature_c: tuple[float, float]
    """Lowest and highest temperature at the start [°C]."""
    minutes: float = MINUTES

    def __post_init__(self) -> None:
        for name, low, high in (
            ("current", -self.charge_a, self.discharge_a),
            ("soc", *self.soc_pct),
            ("temperature", *self.temperature_c),
        ):
            if not low <= high:
                raise InputError(
                    f"the lower limit of {name} is above the upper one",
                    field="--limits",
                    value=f"{name}={low:g}:{high:g}",
                )

    def require_room(self) -> None:
        """Raise InputError if no current at all is allowed, or less than 1 % SoC."""
        low, high = self.soc_pct
        if self.discharge_a <= 0.0 and self.charge_a <= 0.0:
            raise InputError("no current is allowed", field="--limits", value="current=0:0")
        if high - low < 1.0:
            raise InputError(
                "the SoC window is narrower than 1 %",
                field="--limits",
                value=f"soc={low:g}:{high:g}",
            )

    @classmethod
    def of(cls, problem: DiagnosisProblem) -> Limits:
        """Return what the references usually show: all but `RARE` of their rows on either side.

        Beyond that the error of the model is not known, so that a test there shows little. Without
        references it is what the diagnosed logs show.
        """
        sampled = problem.references or [matrix.sampled for matrix in problem.diagnosed]
        logs = [each.rows for each in sampled]
        usual = (RARE, 1.0 - RARE)
        current = np.concatenate([rows.delayed_current_a[:, 0] for rows in logs])
        soc = np.quantile(np.concatenate([rows.soc_pct for rows in logs]), usual)
        temperature = np.concatenate([rows.temperature_c for rows in logs])
        return cls(
            discharge_a=max(float(np.quantile(current, usual[1])), 0.0),
            charge_a=max(-float(np.quantile(current, usual[0])), 0.0),
            soc_pct=(float(soc[0]), float(soc[1])),
            temperature_c=(float(temperature.min()), float(temperature.max())),
        )

    def changed(self, given: str) -> Limits:
        """Return the limits with those of a text such as "current=-60:120,soc=20:90,minutes=30".

        Parameters
        ----------
        given : str
            `current=LOW:HIGH` [A, positive discharges], `soc=LOW:HIGH` [%], `temperature=LOW:HIGH`
            [°C], `minutes=N`; any of them.

        Raises
        ------
        InputError
            For another name, no number, a value out of range or a reversed range.
        """
        found = self
        for part in filter(None, given.split(",")):
            name, _, text = part.partition("=")
            kind = _LIMITS.get(name.strip())
            if kind is None:
                raise InputError(
                    "unknown limit", field="--limits", value=part,
                    cure=f"use {', '.join(_LIMITS)}",
                )  # fmt: skip
            found = kind.applied(found, _numbers(text, kind, part))
        return found


class _LimitKind(NamedTuple):
    within: tuple[float, float]
    numbers: int
    applied: Callable[[Limits, list[float]], Limits]


_LIMITS: Final = {
    "current": _LimitKind(
        (-1e5, 1e5), 2,
        lambda limits, v: replace(limits, charge_a=-min(v[0], 0.0), discharge_a=max(v[1], 0.0)),
    ),
    "soc": _LimitKind((0.0, 100.0), 2, lambda limits, v: replace(limits, soc_pct=(v[0], v[1]))),
    "temperature": _LimitKind(
        WITHIN_C, 2, lambda limits, v: replace(limits, temperature_c=(v[0], v[1]))
    ),
    "minutes": _LimitKind((10.0, 24 * 60.0), 1, lambda limits, v: replace(limits, minutes=v[0])),
}  # fmt: skip


def _numbers(text: str, kind: _LimitKind, part: str) -> list[float]:
    low, high = kind.within
    try:
        values = [float(each) for each in text.split(":")]
    except ValueError:
        values = []
    if len(values) != kind.numbers or not all(low <= value <= high for value in values):
        shape = "LOW:HIGH" if kind.numbers == 2 else "a number"
        raise InputError(f"needs {shape} within {low:g} … {high:g}", field="--limits", value=part)
    if values[0] > values[-1]:
        raise InputError(
            "the lower limit is above the upper one", field="--limits", value=part,
            cure=f"give {part.partition('=')[0]}={values[-1]:g}:{values[0]:g}",
        )  # fmt: skip
    return values


class Step(NamedTuple):
    """A constant current."""

    seconds: float
    current_a: float
    comment: str


@dataclass(frozen=True, eq=False)
class Profile:
    """A test to run: current, with SoC and temperature at its start; n seconds."""

    name: str
    start_soc_pct: float
    start_c: float
    current_a: FloatArray
    """Positive = discharge, each second, shape (n,) [A]."""
    temperature_c: FloatArray
    """Expected from the pack's heat, shape (n,) [°C]."""
    soc_pct: FloatArray
    """Shape (n,) [%]."""
    comments: tuple[tuple[int, str], ...]
    """Second and what starts then."""

    @property
    def time_s(self) -> FloatArray:
        """Time since the start, shape (n,) [s]."""
        return np.arange(self.current_a.size, dtype=np.float64)

    def to_csv(self) -> str:
        """Return the profile as CSV: `time_s, current_a, comment`, a row each second."""
        comments = dict(self.comments)
        start = f"{self.name}; start at {self.start_soc_pct:.0f} % SoC and {self.start_c:.0f} °C;"
        start += " positive current discharges"
        comments[0] = f"{start}; {comments[0]}" if 0 in comments else start
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("time_s", "current_a", "comment"))
        for second, current in enumerate(self.current_a.tolist()):
            writer.writerow((second, f"{current:.2f}", comments.get(second, "")))
        return file.getvalue()

    def log(self, voltage_v: float) -> Log:
        """Return the profile as a log with a constant voltage."""
        soc = np.full(self.current_a.size, np.nan)
        soc[0] = self.start_soc_pct
        return Log(
            time_s=self.time_s,
            current_a=self.current_a,
            voltage_v=np.full(self.current_a.size, voltage_v),
            temperature_c=self.temperature_c,
            soc_pct=soc,
            name=self.name,
        )


_Steps = Sequence[Step]
_Build = Callable[[Limits, float, float], _Steps]


def _rest(_limits: Limits, _capacity_ah: float, seconds: float) -> _Steps:
    return [Step(seconds, 0.0, "rest")]


def _ladder(limits: Limits) -> _Steps:
    pulses = []
    for part in (0.25, 0.5, 1.0):
        for current in (part * limits.discharge_a, -part * limits.charge_a):
            pulses += [Step(20.0, current, "pulse"), Step(20.0, 0.0, "rest")]
    return pulses


def _two_levels(limits: Limits, capacity_ah: float, seconds: float) -> _Steps:
    ladder = _ladder(limits)
    moving = max(seconds - 2.0 * sum(step.seconds for step in ladder), 60.0)
    current = min(limits.discharge_a, SUSTAINED_C * capacity_ah)
    return [*ladder, Step(moving, current, "discharge to the second level"), *ladder]


def _constant(limits: Limits, capacity_ah: float, seconds: float) -> _Steps:
    return [Step(seconds, min(capacity_ah / 3.0, limits.discharge_a), "constant discharge")]


def _regeneration(limits: Limits, capacity_ah: float, _seconds: float) -> _Steps:
    base = min(capacity_ah / 3.0, limits.discharge_a)
    return [
        Step(40.0, base, "discharge"),
        Step(10.0, -limits.charge_a, "charging pulse"),
        Step(10.0, 0.0, "rest"),
    ]


def _warm_up(limits: Limits, _capacity_ah: float, _seconds: float) -> _Steps:
    current = min(limits.discharge_a, limits.charge_a)
    return [Step(10.0, current, "heating pulse"), Step(10.0, -current, "heating pulse")]


def _drive(limits: Limits, _capacity_ah: float, _seconds: float) -> _Steps:
    return [
        Step(seconds, share * (limits.discharge_a if share > 0.0 else limits.charge_a), "drive")
        for seconds, share in _DRIVE
    ]


_DRIVE: Final = (
    (10, 0.6), (30, 0.2), (8, -0.5), (15, 0.02), (8, 0.9), (45, 0.3), (12, -0.8), (20, 0.02),
    (12, 0.7), (60, 0.25), (15, -0.3), (20, 0.1), (10, 1.0), (80, 0.4), (14, -1.0), (25, 0.02),
)  # fmt: skip
"""Seconds and part of the largest current: accelerating, cruising, braking, standing."""


class _Kind(NamedTuple):
    build: _Build
    repeats: bool = False
    """Whether the steps are repeated until the end."""
    is_cold: bool = False
    needs_charging: bool = False


LIBRARY_OF_TESTS: Final = {
    "rest": _Kind(_rest),
    "pulse ladder at two SoC levels": _Kind(_two_levels),
    "constant discharge at C/3": _Kind(_constant),
    "regeneration pulses": _Kind(_regeneration, repeats=True, needs_charging=True),
    "warm-up by alternating pulses": _Kind(_warm_up, repeats=True, needs_charging=True),
    "cold start and drive": _Kind(_drive, repeats=True, is_cold=True),
    "drive": _Kind(_drive, repeats=True),
}  # fmt: skip
"""Name → how its current is made."""


def library_of_tests(limits: Limits, pack: Pack, *, usual_c: float, lead_s: float) -> list[Profile]:
    """Return the tests that the limits allow: each from a high and a low SoC.

    Parameters
    ----------
    limits : Limits
    pack : Pack
        For its capacity and its heat.
    usual_c : float
        Temperature at the start of all tests but the cold one [°C].
    lead_s : float
        Rest at the beginning [s]: the model's delay line needs as long before it predicts.

    Raises
    ------
    InputError
        If the limits allow no current at all, or the SoC window is narrower than 1 %.
    """
    limits.require_room()
    low, high = limits.soc_pct
    coldest, hottest = limits.temperature_c
    usual_c = float(np.clip(usual_c, coldest, hottest))
    found = []
    for name, kind in LIBRARY_OF_TESTS.items():
        if kind.needs_charging and limits.charge_a <= 0.0:
            continue
        if kind.is_cold and coldest > usual_c - COLD_K:
            continue
        start_c = coldest if kind.is_cold else usual_c
        seconds = 60.0 * limits.minutes - lead_s
        steps = kind.build(limits, pack.capacity_ah, seconds)
        repeated = itertools.cycle(steps) if kind.repeats else iter(steps)
        current, comments = _sampled([Step(lead_s, 0.0, RESTING)], repeated, limits.minutes)
        used = 100.0 * float(discharged_ah(np.arange(float(current.size)), current).max())
        lowest = min(low + used / pack.capacity_ah, high)
        starts = sorted({high, lowest}, reverse=True)
        wanted = _Wanted(name, current, tuple(comments), start_c)
        found += [wanted.within(limits, pack, start_pct) for start_pct in starts]
    return found


def _sampled(
    lead: Sequence[Step], steps: Iterator[Step], minutes: float
) -> tuple[FloatArray, list[tuple[int, str]]]:
    """Return the current of each second, and the comment where it changes."""
    size = round(60.0 * minutes) + 1
    current, comments, at = np.zeros(size), [], 0
    for step in itertools.chain(lead, steps):
        if at >= size:
            break
        end = at + round(step.seconds)
        current[at:end] = step.current_a
        comments.append((at, step.comment))
        at = end
    return current, comments


class _Wanted(NamedTuple):
    """A test before its SoC window is known."""

    name: str
    current_a: FloatArray
    comments: tuple[tuple[int, str], ...]
    start_c: float

    def within(self, limits: Limits, pack: Pack, start_pct: float) -> Profile:
        """Return the profile from an SoC; its current rests where the SoC window ends."""
        current, soc = self.current_a.copy(), np.empty(self.current_a.size)
        now, (low, high) = start_pct, limits.soc_pct
        for second, wanted_a in enumerate(self.current_a.tolist()):
            soc[second] = now
            if (wanted_a > 0.0 and now <= low) or (wanted_a < 0.0 and now >= high):
                current[second] = 0.0
            now -= 100.0 * current[second] / 3600.0 / pack.capacity_ah
        heat_j_k = HEAT_J_K_PER_KWH * pack.voltage_v * pack.capacity_ah / 1000.0
        joules = np.cumsum(current**2 * pack.resistance_ohm)
        temperature_c = self.start_c + joules / heat_j_k
        return Profile(
            self.name, start_pct, self.start_c, current, temperature_c, soc, self.comments
        )
