"""Temperatures of a pack: a core that makes the heat and a surface that loses it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from cangauge.twin.day import Day
from cangauge.twin.pack import Pack

FloatArray = NDArray[np.float64]

_STEP_S: Final = 5.0


def temperatures(
    pack: Pack, day: Day, heat_w: FloatArray, insulation: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return core and surface [°C], shape (n,) each.

    Two nodes, integrated by steps of 5 s (their shortest time constant is minutes):
    C_c·T_c' = heat − G·(T_c − T_s);  C_s·T_s' = G·(T_c − T_s) − H·(T_s − ambient) + conditioning.

    Parameters
    ----------
    pack : Pack
    day : Day
        Ambient temperature, conditioning and the temperature at the start.
    heat_w : array of shape (n,)
        Heat of the cells [W].
    insulation : float
        Extra thermal resistance between core and surface, over the clean one [-].
    """
    time_s = day.time_s
    every = max(1, round(_STEP_S / day.step_s))
    coarse = time_s[::every]
    step = every * day.step_s
    starts = np.arange(0, time_s.size, every)
    counts = np.diff(np.append(starts, time_s.size))
    heat = (np.add.reduceat(heat_w, starts) / counts).tolist()
    ambient = np.interp(coarse, time_s, day.ambient_c).tolist()
    between = pack.core_surface_w_k / (1.0 + insulation)
    core = surface = day.start_c
    cores, surfaces = [core], [surface]
    # Conditioning works until its target is met, from the side that it started on.
    sign = 1.0 if day.target_c >= day.start_c else -1.0
    for joule_w, outside in zip(heat[:-1], ambient[:-1], strict=True):
        flow = between * (core - surface)
        wanted = sign * (day.target_c - surface)
        conditioning = sign * day.conditioning_w * min(1.0, max(0.0, wanted / 2.0))
        loss = pack.surface_ambient_w_k * (surface - outside)
        core += step * (joule_w - flow) / pack.core_j_k
        surface += step * (flow - loss + conditioning) / pack.surface_j_k
        cores.append(core)
        surfaces.append(surface)
    return np.interp(time_s, coarse, cores), np.interp(time_s, coarse, surfaces)
