"""Simulate a pack, a drive, the weather and the sensors: a log whose truth is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import require_number
from cangauge.extras.validation.twin.drive import draw_drive
from cangauge.extras.validation.twin.faults import Fault, parse_effect
from cangauge.extras.validation.twin.pack import TwinPack, draw_pack
from cangauge.extras.validation.twin.recording import (
    Recording,
    record_drive,
    rms,
    scale_to_gap,
)
from cangauge.logs.log import Log


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated log with its truth.

    Parameters
    ----------
    log : Log
        As recorded by the sensors; `soc_pct` is the assumed initial SoC, then the true SoC.
    recording : Recording
        The same log with the assumed initial SoC alone, and the truth at its rows.
    pack : TwinPack
    faults : tuple of Fault
    notes : tuple of str
        Faults whose physical limits prevent the requested gap.
    """

    log: Log
    recording: Recording
    pack: TwinPack
    faults: tuple[Fault, ...]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return pack, ranges of the signals, RMS gap [V] and the effects with their sizes."""
        log, pack, recording = self.log, self.pack, self.recording
        sensor_v = log.voltage_v - recording.expected_voltage_v - recording.gap_v
        return {
            "rows": len(log),
            "hours": log.duration_s / 3600.0,
            "pack": pack.name,
            "chemistry": pack.chemistry.name,
            "cells": pack.cells,
            "capacity_ah": pack.capacity_ah,
            "assumed_start_soc_pct": recording.assumed_start_pct,
            "true_soc_pct": [float(recording.true_soc_pct[0]), float(recording.true_soc_pct[-1])],
            "temperature_c": [float(log.temperature_c.min()), float(log.temperature_c.max())],
            "floor_sensor_v": rms(sensor_v),
            "gap_v": rms(recording.gap_v),
            "effects": [
                {
                    "effect": fault.id,
                    "parameter": fault.kind.parameter,
                    "value": fault.size,
                    "unit": fault.kind.unit,
                    "shape": fault.full_shape,
                }
                for fault in self.faults
            ],
        }


def simulate(
    effects: str | Sequence[str] = (),
    *,
    seed: int = 0,
    drive: int = 1,
    hours: float | None = None,
    ambient_c: float | None = None,
    start_soc_pct: float | None = None,
    end_soc_pct: float | None = None,
    discharge: bool = False,
    speed_ms: FloatArray | None = None,
    pack: str | None = None,
    chemistry: str | None = None,
    name: str = "log",
) -> Simulation:
    """Simulate a drive of a pack with known faults.

    The same arguments give the same log. What is not given is drawn from the seed.

    Parameters
    ----------
    effects : str or sequence of str
        Faults, as `ID`, `ID:parameter=value` or `ID:gap_v=V` for the size that opens this RMS gap.
        Without a size or a gap: a gap of 0.3 % of the nominal voltage.
    seed : int
        Selects the pack, and with `drive` the drive and the weather.
    drive : int
        Number of the drive, from 1.
    hours : float, optional
        Duration [h].
    ambient_c : float, optional
        Initial ambient temperature [°C].
    start_soc_pct, end_soc_pct : float, optional
        Initial SoC, and SoC at which the drive ends [%].
    discharge : bool
        Drive from full to empty, by default in 2.5 h: a log to identify a model on.
    speed_ms : array of shape (m,), optional
        Speed trace at 1 Hz [m/s], repeated as needed; of a driving schedule in CSV, the second
        column of `numpy.loadtxt(path, delimiter=",", skiprows=1)`.
    pack : {"leaf24", "leaf40", "car60", "car60lfp", "compact", "module12"}, optional
    chemistry : {"nmc", "lmo", "nca", "lfp"}, optional
    name : str
        Name of the log.

    Raises
    ------
    InputError
        For an unknown name or a value out of range.

    Examples
    --------
    >>> from cangauge import simulate
    >>> trip = simulate("current_offset:offset_a=4", seed=1, hours=0.2)
    >>> trip.faults[0].size
    4.0
    """
    require_number(seed, "seed")
    if discharge:
        hours = 2.5 if hours is None else hours
        start_soc_pct = 100.0 if start_soc_pct is None else start_soc_pct
        # `fit` takes 2 % and less as empty.
        end_soc_pct = 1.5 if end_soc_pct is None else end_soc_pct
    drawn = draw_pack(np.random.default_rng([seed, 1]), pack, chemistry)
    load = draw_drive(
        np.random.default_rng([seed, 4, drive]),
        drawn,
        hours=hours,
        ambient_c=ambient_c,
        start_soc_pct=start_soc_pct,
        end_soc_pct=end_soc_pct,
        speed_ms=speed_ms,
        discharge=discharge,
    )
    faults: list[Fault] = []
    notes: list[str] = []
    for number, text in enumerate([effects] if isinstance(effects, str) else effects):
        fault, gap_v = parse_effect(text, drawn, seed=seed + 7919 * number)
        if gap_v is not None:
            fault, reached_v = scale_to_gap(drawn, load, fault, gap_v)
            if not math.isclose(reached_v, gap_v, rel_tol=0.06):
                notes.append(
                    f"{fault.id}: on this drive its physical limits allow a gap of"
                    f" {reached_v:.3g} V, not {gap_v:.3g} V"
                )
        faults.append(fault)
    recording = record_drive(drawn, load, faults, name=name)
    soc_pct = np.append(recording.assumed_start_pct, recording.true_soc_pct[1:])
    log = replace(recording.log, soc_pct=soc_pct)
    return Simulation(log, recording, drawn, tuple(faults), tuple(notes))
