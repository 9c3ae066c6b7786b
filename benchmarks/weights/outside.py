"""Faults that are no effect of the library, injected into recorded logs: the answer is "unknown".

As in the twin's `injection`, a fault of the pack adds the difference that it makes to a surrogate,
and a fault of a sensor changes the recorded signal itself.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cangauge._typing import BoolArray, FloatArray
from cangauge.extras.validation.twin.drive import Drive
from cangauge.extras.validation.twin.faults import HEALTHY, FaultKind
from cangauge.extras.validation.twin.injection import drive_of
from cangauge.extras.validation.twin.pack import TwinPack
from cangauge.extras.validation.twin.physics import Response, respond, simulate_truth
from cangauge.extras.validation.twin.recording import measured_temperature, stepped
from cangauge.logs.log import Log

_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
OUTSIDE = {name: FaultKind(name, **of) for name, of in _TABLE.items()}


def inject_outside(
    log: Log, pack: TwinPack, effect: str, size: float, seed: int
) -> tuple[Log, FloatArray]:
    """Return the log with a fault, and the gap that it opens [V]."""
    drive, shape = drive_of(log, pack.capacity_ah), OUTSIDE[effect].draw_shape(seed)
    clean = simulate_truth(pack, drive)
    elapsed_s = log.time_s - log.time_s[0]

    def at(signal: FloatArray) -> FloatArray:
        return np.interp(elapsed_s, drive.time_s, signal)

    current_a, voltage_v, temperature_c = log.current_a, log.voltage_v, log.temperature_c
    expected_v = voltage_v
    if effect in _CURRENT_SENSOR:
        read = _CURRENT_SENSOR[effect]
        seen = replace(drive, current_a=read(drive.current_a, size))
        believed = respond(pack, seen, HEALTHY, clean.core_c, clean.surface_c)
        expected_v = expected_v + at(believed.voltage_v - clean.voltage_v)
        current_a = read(current_a, size)
    elif effect == "temperature_stuck":
        measured = measured_temperature(pack, HEALTHY, drive, clean.surface_c)
        shift_k = size * (measured[0] - measured)
        believed = respond(pack, drive, HEALTHY, clean.core_c + shift_k, clean.surface_c)
        expected_v = expected_v + at(believed.voltage_v - clean.voltage_v)
        temperature_c = temperature_c + at(shift_k)
    elif effect == "voltage_nonlinearity":
        period_v = shape["period_share"] * pack.nominal_v
        phase = 2.0 * np.pi * voltage_v / period_v + shape["phase"]
        voltage_v = voltage_v + size * np.sin(phase)
    elif effect == "noise_bursts":
        noise = np.random.default_rng(seed + 1).normal(size=voltage_v.size)
        voltage_v = voltage_v + size * noise * is_active(elapsed_s, seed, **shape)
    elif effect == "stale_frames":
        active = is_active(elapsed_s, seed, on_s=size, **shape)
        rows = np.where(active, 0, np.arange(voltage_v.size))
        voltage_v = voltage_v[np.maximum.accumulate(rows)]
    else:
        active = is_active(drive.time_s, seed, **shape)
        voltage_v = voltage_v + at(_changed(pack, drive, clean, effect, size * active))
    sensors = pack.sensors
    changed = replace(
        log,
        current_a=stepped(current_a, sensors.current_step_a),
        voltage_v=stepped(voltage_v, sensors.voltage_step_v),
        temperature_c=stepped(temperature_c, sensors.temperature_step_k),
    )
    return changed, voltage_v - expected_v


def _changed(
    pack: TwinPack, drive: Drive, clean: Response, effect: str, size: FloatArray
) -> FloatArray:
    """Return the change of the pack's voltage by a fault of a size that changes [V], shape (n,)."""
    if effect == "string_dropout":  # a parallel string: overpotentials rise
        return -size * (clean.equilibrium_v - clean.voltage_v)
    if effect == "contact_flicker":
        return -size * drive.current_a
    loaded = replace(drive, current_a=drive.current_a + size)  # a parasitic load
    return simulate_truth(pack, loaded).voltage_v - clean.voltage_v


def is_active(time_s: FloatArray, seed: int, *, on_s: float, off_s: float) -> BoolArray:
    """Return where a fault that comes and goes is active, shape (n,); it starts inactive.

    Its phases last `on_s` and `off_s` on average.
    """
    pairs = int(2.0 * float(time_s[-1] - time_s[0]) / (on_s + off_s)) + 4
    # Drawn in pairs, so that another duration stretches the same sequence.
    lengths = np.random.default_rng(seed).exponential(1.0, (pairs, 2)) * (off_s, on_s)
    edges = time_s[0] + np.cumsum(lengths.ravel())
    return np.asarray(np.searchsorted(edges, time_s, side="right") % 2 == 1)


def _clipped(current_a: FloatArray, cut: float) -> FloatArray:
    limit = (1.0 - cut) * float(np.max(np.abs(current_a)))
    return np.clip(current_a, -limit, limit)


def _remanent(current_a: FloatArray, remanence_a: float) -> FloatArray:
    """Return a current with the magnetic remanence of its sensor: it follows within a reach."""
    reach = 0.25 * float(np.max(np.abs(current_a)))
    states = [0.0]
    for moved in np.diff(current_a).tolist():
        states.append(min(max(states[-1] + moved, -reach), reach))
    return current_a + remanence_a * np.array(states) / reach


_CURRENT_SENSOR: dict[str, Callable[[FloatArray, float], FloatArray]] = {
    "current_clipping": _clipped,
    "current_remanence": _remanent,
}
