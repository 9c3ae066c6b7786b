"""Simulated logs of the published equation, with a known truth, for tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cangauge._typing import FloatArray
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log
from cangauge.model.curve import Curve
from cangauge.model.delay_line import delayed_currents
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from cangauge.model.voltage_model import DELAYS_S, Loads, Ranges, VoltageModel


def drive_current(time_s: np.ndarray, mean_a: float, seed: int) -> np.ndarray:
    """A drive-like current [A]: pulses of some seconds around a mean, with regeneration."""
    rng = np.random.default_rng(seed)
    edges = np.cumsum(rng.uniform(2.0, 15.0, int(time_s[-1] / 4.0) + 10))
    levels = mean_a + rng.normal(0.0, 25.0, edges.size + 1)
    return levels[np.searchsorted(edges, time_s)]


def synthetic_log(
    *,
    hours: float = 2.5,
    rate_hz: float = 1.0,
    start_pct: float = 100.0,
    end_pct: float = 1.0,
    noise_v: float = 0.0,
    seed: int = 1,
    model: VoltageModel | None = None,
    capacity_ah: float = CAPACITY_AH,
    name: str = "synthetic",
) -> Log:
    """A log whose voltage is the published equation plus white noise; SoC is exact."""
    model = model or leaf_2012_model()
    time_s = np.arange(0.0, hours * 3600.0, 1.0 / rate_hz)
    mean_a = (start_pct - end_pct) / 100.0 * capacity_ah / hours
    current_a = drive_current(time_s, mean_a, seed)
    current_a += mean_a - discharged_ah(time_s, current_a)[-1] / hours
    soc_pct = start_pct - 100.0 * discharged_ah(time_s, current_a) / capacity_ah
    rng = np.random.default_rng(seed + 1000)
    temperature_c = 23.0 + 2.0 * np.sin(time_s / 700.0) + 0.5 * np.sin(time_s / 130.0)
    voltage_v = (
        voltage_of(
            model,
            soc_pct,
            temperature_c,
            delayed_currents(time_s, current_a, model.loads.delays_s, time_s),
        )
        + rng.normal(0.0, 1.0, time_s.size) * noise_v
    )
    return Log(time_s, current_a, voltage_v, temperature_c, soc_pct, name=name,
               temperature_source="room")  # fmt: skip


def voltage_of(
    model: VoltageModel, soc_pct: ArrayLike, temperature_c: ArrayLike, currents_a: ArrayLike
) -> FloatArray:
    """The voltage of a model: its pseudo-OCV, and its load columns times their coefficients."""
    columns = model.load_columns(temperature_c, np.asarray(currents_a, dtype=np.float64))
    return model.pseudo_ocv(soc_pct) + columns @ model.load_coefficients


RANGES = Ranges(soc_pct=(0.0, 100.0), temperature_c=(-40.0, 80.0), current_a=(-1e3, 1e3))


def voltage_model(
    curve: Curve,
    kt_v_per_k: float,
    resistance_ohm: Sequence[float],
    *,
    temperature_c: tuple[float, float] = RANGES.temperature_c,
    **loads: Any,
) -> VoltageModel:
    """A voltage model of a curve and loads, for all SoC."""
    known = RANGES.model_copy(update={"temperature_c": temperature_c})
    usual = {"t_ref_c": 20.0, "delays_s": DELAYS_S, "low_pass_s": (), "arrhenius": None}
    given = {"kt_v_per_k": kt_v_per_k, "resistance_ohm": resistance_ohm, **loads}
    return VoltageModel(curve, Loads(**(usual | given)), known)


def within_c(model: VoltageModel, low_c: float, high_c: float) -> VoltageModel:
    """The same model, identified within other temperatures [°C]."""
    return replace(model, range=model.range.model_copy(update={"temperature_c": (low_c, high_c)}))
