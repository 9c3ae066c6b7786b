"""Faults that no diagnosis is expected to know by name: for tests of its "unknown"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from cangauge.twin.condition import Condition, Switching
from cangauge.twin.fault_kind import OUTSIDE, FaultKind, Shape, Span
from cangauge.twin.pack import Pack


def _switching(name: str) -> Callable[[Condition, Pack, float, Shape, int], Condition]:
    def apply(c: Condition, _pack: Pack, size: float, shape: Shape, seed: int) -> Condition:
        change: dict[str, Any] = {name: Switching(size, shape["on_s"], shape["off_s"], seed)}
        return replace(c, **change)

    return apply


def _stale(c: Condition, _pack: Pack, size: float, shape: Shape, seed: int) -> Condition:
    return replace(c, stale=Switching(1.0, size, shape["off_s"], seed))


def _ripple(c: Condition, pack: Pack, size: float, shape: Shape, _seed: int) -> Condition:
    period = shape["period_share"] * pack.nominal_v
    return replace(c, ripple_v=size, ripple_period_v=period, ripple_phase=shape["phase"])


UNNAMED: Final[tuple[FaultKind, ...]] = (
    FaultKind(
        "voltage_nonlinearity", OUTSIDE, "ripple_v", "V",
        lambda p: (2e-4 * p.nominal_v, 0.02 * p.nominal_v), _ripple,
        shape={"period_share": Span(0.02, 0.05), "phase": Span(0.0, 6.28)},
        says="the voltage sensor bends to and fro by x V as its reading rises",
    ),
    FaultKind(
        "current_clipping", OUTSIDE, "cut", "-", lambda _p: (0.1, 0.9),
        lambda c, _p, x, _s, _r: replace(c, clip_share=1.0 - x),
        near=("current_gain",),
        says="the current sensor saturates at 1 − x of the largest current",
    ),
    FaultKind(
        "current_remanence", OUTSIDE, "remanence_a", "A",
        lambda p: (1e-3 * p.one_c_a, 0.25 * p.one_c_a),
        lambda c, _p, x, _s, _r: replace(c, remanence_a=x),
        near=("current_offset",),
        says="the current sensor keeps x A of the way that the current last went",
    ),
    FaultKind(
        "string_dropout", OUTSIDE, "rise", "-", lambda _p: (0.02, 3.0), _switching("string_loss"),
        shape={"on_s": Span(60.0, 400.0), "off_s": Span(150.0, 900.0)},
        near=("resistance_step",),
        says="a parallel string comes and goes: all losses rise by x meanwhile",
    ),
    FaultKind(
        "parasitic_switching", OUTSIDE, "load_a", "A",
        lambda p: (2e-3 * p.one_c_a, 0.3 * p.one_c_a), _switching("hidden_load"),
        shape={"on_s": Span(60.0, 500.0), "off_s": Span(100.0, 700.0)},
        near=("current_offset",),
        says="a load of x A before the current sensor switches on and off",
    ),
    FaultKind(
        "noise_bursts", OUTSIDE, "noise_v", "V",
        lambda p: (2e-4 * p.nominal_v, 0.04 * p.nominal_v), _switching("bursts"),
        shape={"on_s": Span(2.0, 40.0), "off_s": Span(20.0, 120.0)},
        says="bursts of noise of x V on the voltage",
    ),
    FaultKind(
        "contact_flicker", OUTSIDE, "contact_ohm", "Ω",
        lambda p: (0.02 * p.resistance_ohm, 3.0 * p.resistance_ohm), _switching("flicker"),
        shape={"on_s": Span(2.0, 25.0), "off_s": Span(8.0, 60.0)},
        near=("resistance_step",),
        says="a contact flickers: x Ω more for some seconds, again and again",
    ),
    FaultKind(
        "stale_frames", OUTSIDE, "hold_s", "s", lambda _p: (0.5, 200.0), _stale,
        shape={"off_s": Span(15.0, 90.0)},
        near=("time_skew",),
        says="the voltage repeats its last value for x s, again and again",
    ),
    FaultKind(
        "temperature_stuck", OUTSIDE, "hold", "-", lambda _p: (0.1, 1.0),
        lambda c, _p, x, _s, _r: replace(c, temperature_hold=x),
        near=("temperature_lag",),
        says="the temperature sensor follows by 1 − x only",
    ),
)  # fmt: skip
