"""The linearisation point of a diagnosis: 1 Hz signals, and a ridge fit of the references.

Current > 0 discharges. All functions are pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter

from cangauge._typing import BoolArray, FloatArray
from cangauge.identify.rows import dequantize
from cangauge.logs.gaps import bridge_s
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import soc_at_first_row

KNOTS = np.array([-12, 0, 2, 4, 6, 8, 10, *range(15, 101, 5), 112], float)
"""SoC of the OCV's knots [%]: close where the curves of common chemistries bend."""

LAGS_S = (2.0, 8.0, 30.0, 120.0, 500.0, 2000.0)
"""Time constants of the shared RC elements [s]: a factor of four from the rate of the rows to half
an hour."""

DROP = 1 + len(LAGS_S)
"""Structure columns that are the drop over resistances: ohmic and RC."""

MEMORY_S = 7200.0
"""A gap counts as a rest of at most this [s]: every state of the engine has decayed by then."""


FAST = 3.0
"""Samples in a second from which a log shows where within the second its current changes."""

HELD_S = 10.0
"""Time that the current is held beyond the ends of a log [s]: more than any skew."""


@dataclass(frozen=True, eq=False)
class Trace:
    """1 Hz signals of one log, shape (n,) each, and its assumed start."""

    current_a: FloatArray
    """Positive = discharge [A]."""
    voltage_v: FloatArray
    temperature_c: FloatArray
    start_pct: float
    """Assumed SoC before the first row [%]."""
    measured: BoolArray
    """Seconds with at least one sample; the others are interpolated, or a rest in a gap."""
    capacity: float = 1.0
    """True capacity relative to the assumed one."""
    lost: float = 0.0
    """Part of the charging current that is not stored."""
    charge_as: tuple[FloatArray, FloatArray] | None = None
    """Times [s] and charge [As] of the samples of a log that has several in a second."""

    def later_current_a(self, seconds: float) -> FloatArray:
        """Return I(t + seconds), shape (n,), held at the ends of the log.

        Of a fast log the means over shifted seconds; a 1 Hz log is interpolated.
        """
        row = np.arange(len(self.current_a))
        if self.charge_as is None:
            return np.asarray(np.interp(row + seconds, row, self.current_a))
        time_s, charge_as = self.charge_as
        edge = np.arange(len(row) + 1)
        change = [np.diff(np.interp(edge + by, time_s, charge_as)) for by in (seconds, 0.0)]
        return np.asarray(self.current_a + change[0] - change[1])


def trace(log: Log, capacity_ah: float, start_pct: float | None = None) -> Trace:
    """Return the 1 Hz signals of a log: means over each second.

    Its start is `start_pct`, or counted from its first known SoC back to the first row.
    """
    log = dequantize(log)
    if start_pct is None:
        start_pct = soc_at_first_row(log, capacity_ah)
    if start_pct is None:
        raise ValueError("unknown SoC at the start")
    steps_s = np.diff(log.time_s)
    gap = steps_s > bridge_s(log.time_s)
    steps_s = np.where(gap, np.minimum(steps_s, MEMORY_S), steps_s)
    time_s = np.concatenate([[0.0], np.cumsum(steps_s)])
    second = np.floor(time_s + 1e-6).astype(np.intp)
    rows = np.arange(second[-1] + 1)
    counts = np.bincount(second)
    measured = counts > 0

    def mean(values: FloatArray) -> FloatArray:
        sums = np.bincount(second, weights=values)[measured]
        return np.asarray(np.interp(rows, rows[measured], sums / counts[measured]))

    current_a = mean(log.current_a)
    for k in np.flatnonzero(gap):
        current_a[second[k] + 1 : second[k + 1]] = 0.0
    volts, celsius = mean(log.voltage_v), mean(log.temperature_c)
    charge_as = None
    if len(log) >= FAST * measured.sum():
        held = np.concatenate([[-HELD_S], time_s, [time_s[-1] + HELD_S]])
        amperes = np.concatenate([log.current_a[:1], log.current_a, log.current_a[-1:]])
        steps = np.diff(held) * 0.5 * (amperes[1:] + amperes[:-1])
        charge_as = held, np.concatenate([[0.0], np.cumsum(steps)])
    return Trace(current_a, volts, celsius, start_pct, measured, charge_as=charge_as)


def lagged(values: FloatArray, tau_s: float) -> FloatArray:
    """Return a 1 Hz signal behind a first-order lag, at 0 before the first row, shape (n,)."""
    a = -np.expm1(-1.0 / tau_s)
    return np.asarray(lfilter([a], [1.0, a - 1.0], values))


def turned(current_a: FloatArray, travel_as: float) -> FloatArray:
    """Return one-state hysteresis, −1 … 1: it follows −sign(I) over a charge [As], shape (n,)."""
    charge = np.minimum(np.abs(current_a) / travel_as, 50.0)
    drive, moved = np.sign(current_a) * np.expm1(-charge), np.cumsum(charge)
    out, state, first, before = np.empty(len(current_a)), 0.0, 0, 0.0
    while first < len(out):  # closed form, in stretches that do not overflow
        after = int(np.searchsorted(moved, before + 500.0)) or 1
        grown = np.exp(moved[first:after] - before)
        out[first:after] = (state + np.cumsum(drive[first:after] * grown)) / grown
        state, first, before = float(out[after - 1]), after, float(moved[after - 1])
    return out


def hats(soc_pct: FloatArray) -> FloatArray:
    """Return the piecewise linear basis of the OCV, shape (n, knots)."""
    soc = np.clip(soc_pct, KNOTS[0], KNOTS[-1] - 1e-9)
    k = np.searchsorted(KNOTS, soc, "right") - 1
    part = (soc - KNOTS[k]) / (KNOTS[k + 1] - KNOTS[k])
    basis, rows = np.zeros((len(soc), len(KNOTS))), np.arange(len(soc))
    basis[rows, k], basis[rows, k + 1] = 1.0 - part, part
    return basis


@dataclass(frozen=True, eq=False)
class PackFit:
    """Linearisation point: the pack's sizes, and a ridge fit of the references."""

    capacity_ah: float
    volts: float
    """Usual voltage [V]."""
    mean_c: float
    """Mean temperature of the references [°C]."""
    theta: FloatArray = field(default_factory=lambda: np.zeros(0))
    """OCV at the knots [V] and coefficients of `structure`."""
    curve: PchipInterpolator = field(default_factory=lambda: PchipInterpolator(KNOTS, KNOTS))
    """OCV over SoC, made to rise."""

    @property
    def ohm(self) -> float:
        """Usual resistance [Ω]: 2 % of the voltage at 1 C."""
        return 0.02 * self.volts / self.capacity_ah

    def moved(self, change: NDArray[np.floating]) -> PackFit:
        """Return the fit with other coefficients; `change` is added to θ."""
        theta = np.asarray(change + (self.theta if self.theta.size else 0.0), dtype=np.float64)
        n = len(KNOTS)
        least_v = 1e-4 * self.volts * np.arange(n) / n
        rising = np.maximum.accumulate(theta[:n] + least_v)
        return replace(self, theta=theta, curve=PchipInterpolator(KNOTS, rising))

    def soc(self, log: Trace) -> FloatArray:
        """Return the counted SoC [%], shape (n,)."""
        stored_a = log.current_a - log.lost * np.minimum(log.current_a, 0.0)
        counted = np.cumsum(stored_a) / 36.0 / (self.capacity_ah * log.capacity)
        return np.asarray(log.start_pct - counted)

    def ocv(self, soc_pct: FloatArray) -> FloatArray:
        """Return the OCV of the ridge fit, made to rise [V]."""
        return np.asarray(self.curve(np.clip(soc_pct, KNOTS[0], KNOTS[-1])))

    def structure(self, i: FloatArray, s: FloatArray, c: FloatArray) -> FloatArray:
        """Return the structure besides the OCV, shape (n, 22): drops, temperature, bends, memory.

        Of current i [A], SoC s [%], temperature c [°C].
        """
        q, t = self.capacity_ah, (c - self.mean_c) / 10.0
        heat, low = lagged(i * i, 900.0) / q**2, np.clip(s, -5.0, 100.0)
        return np.column_stack([
            -i, *[-lagged(i, tau) for tau in LAGS_S],
            10.0 * t, i * t, i * t * t,
            -i * np.exp(-low / 10.0), -i * (s - 50.0) / 50.0, -np.abs(i),
            *[-q * np.arcsinh(i / (x * q)) for x in (0.1, 0.5)],
            *[turned(i, x * q * 3600.0) for x in (0.03, 0.15)],
            10.0 * t * (s - 50.0) / 50.0, 10.0 * t * np.cos(s / 50.0 * np.pi),
            heat, i * heat, np.exp(-low / 4.0),
        ])  # fmt: skip

    def precision(self, size: float = 1.0, rough: float = 1.0) -> FloatArray:
        """Return the prior precision of θ about zero: a smooth curve, structure of physical size.

        `size` scales the structure beside the ohmic resistance, `rough` the curvature of the OCV.
        """
        r, u, n = self.ohm, self.volts, len(KNOTS)
        std = np.array([
            3 * r, *[r] * len(LAGS_S), 4e-4 * u, 0.6 * r, 0.3 * r, r, 0.3 * r, 0.1 * r, 0.3 * r,
            0.3 * r, 0.003 * u, 0.003 * u, 3e-4 * u, 3e-4 * u, 0.004 * u, 0.1 * r, 0.05 * u,
        ])  # fmt: skip
        std[DROP:] *= size
        std[1:DROP] *= max(size, 0.3)
        out = np.diag(np.concatenate([np.full(n, (3.0 * u) ** -2), std**-2.0]))
        for k in range(1, n - 1):
            a, b = KNOTS[k] - KNOTS[k - 1], KNOTS[k + 1] - KNOTS[k]
            bend = np.zeros(n)
            bend[k - 1 : k + 2] = 2 / (a * (a + b)), -2 / (a * b), 2 / (b * (a + b))
            usual = u * rough * (2e-3 if KNOTS[k] < 12 else 6e-5 if KNOTS[k] < 96 else 2e-4)
            out[:n, :n] += np.outer(bend, bend) / usual**2 * (a + b) / 10.0
        return np.asarray(out)


def fit_pack(references: Sequence[Trace], capacity_ah: float) -> PackFit:
    """Return the ridge fit of curve and structure to the references."""
    u = float(np.median(np.concatenate([log.voltage_v for log in references])))
    c = float(np.mean(np.concatenate([log.temperature_c for log in references])))
    pack = PackFit(capacity_ah, u, c)
    a, b = pack.precision(), 0.0
    weight = 1.0 / (0.003 * u) / 30.0**0.5  # an error of 0.3 % that lasts half a minute
    for log in references:
        s = pack.soc(log)
        x = np.column_stack([hats(s), pack.structure(log.current_a, s, log.temperature_c)])
        x = x[log.measured] * weight
        a, b = a + x.T @ x, b + x.T @ (log.voltage_v[log.measured] * weight)
    return pack.moved(np.linalg.solve(a, b))
