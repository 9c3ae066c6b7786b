"""Cases with a known cause, in memory: faults drawn for simulated packs and for recorded logs.

A simulated case belongs to a scenario: one pack with healthy training and reference drives. The
size of each fault is drawn as an RMS gap in multiples of a floor, the error of a model on healthy
logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.validation.twin.drive import Drive, draw_drive
from cangauge.extras.validation.twin.faults import Fault, FaultKind, fault_kind
from cangauge.extras.validation.twin.injection import inject, scale_injection, soc_of
from cangauge.extras.validation.twin.pack import Pack
from cangauge.extras.validation.twin.plant import Plant
from cangauge.extras.validation.twin.recording import Recording, record_drive, rms, simulate_truth
from cangauge.extras.validation.twin.scaling import ScaledFault, scale_to_gap
from cangauge.extras.validation.twin.simulation import PlantName, draw_plant
from cangauge.logs.log import Log

Climate = Literal["wide", "mild"]

_AMBIENT_C: Final[dict[str, tuple[float, float]]] = {"wide": (-10.0, 35.0), "mild": (10.0, 28.0)}
_GAP_IN_FLOORS: Final = (0.5, 5.0)
"""Range of the RMS gap of one fault, uniform in its logarithm."""
_REACHED: Final = 0.9
"""Fraction of the wanted gap at which no other drives are drawn [-]."""
_RECORDED_DRAWS: Final = 12
_NEARLY_FULL: Final = 0.8


@dataclass(frozen=True, eq=False)
class Scenario:
    """A pack with healthy logs: to identify a model on, and as references.

    Parameters
    ----------
    seed : int
    plant : Plant
    training, references : tuple of Recording
        The first training log runs from full to empty at a mild temperature.
    reference_drives : tuple of Drive
    climate : {"wide", "mild"}
        Range of the ambient temperature: −10–35 or 10–28 °C.
    """

    seed: int
    plant: Plant
    training: tuple[Recording, ...]
    references: tuple[Recording, ...]
    reference_drives: tuple[Drive, ...]
    climate: Climate

    @property
    def pack(self) -> Pack:
        """Size, thermal masses and sensors."""
        return self.plant.pack

    @property
    def sensor_floor_v(self) -> float:
        """RMS error of a perfect model on the references, by the sensors alone [V]."""
        healthy = self.references or self.training
        return rms(np.concatenate([recording.sensor_error_v for recording in healthy]))

    def draw_drives(
        self, rng: np.random.Generator, count: int, hours: float | None = None
    ) -> tuple[Drive, ...]:
        """Draw drives within the ambient temperatures of the references.

        At other temperatures the temperature dependence of the healthy pack would open a gap.
        """
        known = [float(drive.ambient_c[0]) for drive in self.reference_drives]
        low, high = (min(known), max(known)) if known else _AMBIENT_C[self.climate]
        if high - low <= 4.0:
            low, high = low - 2.0, high + 2.0
        return tuple(
            draw_drive(rng, self.pack, hours=hours, ambient_c=float(rng.uniform(low, high)))
            for _ in range(count)
        )


def draw_scenario(
    seed: int,
    *,
    kind: str | None = None,
    chemistry_name: str | None = None,
    n_reference: int = 3,
    n_training: int = 1,
    climate: Climate = "wide",
    plant_name: PlantName = "twin",
) -> Scenario:
    """Draw a pack with healthy logs.

    Parameters
    ----------
    seed : int
    kind, chemistry_name : str, optional
        As in `draw_pack`.
    n_reference : int
        Reference logs, their ambient temperatures spread over the climate.
    n_training : int
        Logs to identify the model on: the first from full to empty.
    climate : {"wide", "mild"}
    plant_name : {"twin", "equation", "published", "pybamm"}
        Model of the cells; `pybamm` needs the extra of that name.

    Raises
    ------
    InputError
        For a number or name out of range.
    """
    if n_training < 1 or n_reference < 0:
        raise InputError(
            "a scenario needs a training log, and no negative number of references",
            value=(n_training, n_reference),
        )
    if climate not in _AMBIENT_C:
        raise InputError("unknown climate", value=climate, cure="use wide or mild")
    rng = np.random.default_rng([seed, 1])
    plant = draw_plant(rng, kind, chemistry_name, plant_name)
    pack = plant.pack
    low, high = _AMBIENT_C[climate]
    training = [
        draw_drive(
            rng,
            pack,
            hours=float(rng.uniform(2.0, 2.8)),
            ambient_c=float(rng.uniform(18.0, 26.0)),
            start_soc=1.0,
            end_soc=0.02,
            discharge=True,
        )
    ]
    training += [
        draw_drive(rng, pack, ambient_c=float(rng.uniform(low, high)))
        for _ in range(n_training - 1)
    ]
    # One temperature from each of as many equal ranges, in random order.
    edges = np.linspace(low, high, n_reference + 1)
    ambient = rng.permutation(rng.uniform(edges[:-1], edges[1:]))
    references = tuple(draw_drive(rng, pack, ambient_c=float(degrees)) for degrees in ambient)
    return Scenario(
        seed=seed,
        plant=plant,
        training=tuple(
            record_drive(plant, drive, (), name=f"training_{number}")
            for number, drive in enumerate(training, start=1)
        ),
        references=tuple(
            record_drive(plant, drive, (), name=f"reference_{number}")
            for number, drive in enumerate(references, start=1)
        ),
        reference_drives=references,
        climate=climate,
    )


@dataclass(frozen=True)
class CaseOptions:
    """Options of simulated cases.

    Parameters
    ----------
    kind, chemistry_name : str, optional
        Of the pack; drawn by default.
    climate : {"wide", "mild"}
    plant_name : {"twin", "equation", "published", "pybamm"}
    n_logs : int
        Logs that share the faults.
    hours : float, optional
        Duration of each log [h]; by default 0.5–2.5.
    floor_v : float, optional
        Unit of the gap [V]; by default the sensor floor of the references.
    max_draws : int
        Draws of the drives until they show the faults in the wanted size.
    """

    kind: str | None = None
    chemistry_name: str | None = None
    climate: Climate = "wide"
    plant_name: PlantName = "twin"
    n_logs: int = 1
    hours: float | None = None
    floor_v: float | None = None
    max_draws: int = 12

    def draw_scenario(self, seed: int) -> Scenario:
        """Draw a pack with healthy logs."""
        return draw_scenario(
            seed,
            kind=self.kind,
            chemistry_name=self.chemistry_name,
            climate=self.climate,
            plant_name=self.plant_name,
        )


@dataclass(frozen=True, eq=False)
class DrawnCase:
    """Logs with known faults.

    Parameters
    ----------
    logs, healthy_logs : tuple of Log
        The same logs with and without the faults.
    faults : tuple of ScaledFault
    gap_v : float
        RMS gap that all faults together open over all logs [V].
    truth : dict
        Description for the scorer, as JSON.
    recordings : tuple of Recording
        Ground truth of the logs, of simulated cases.
    """

    logs: tuple[Log, ...]
    healthy_logs: tuple[Log, ...]
    faults: tuple[ScaledFault, ...]
    gap_v: float
    truth: dict[str, Any]
    recordings: tuple[Recording, ...] = ()


class FaultRequest(NamedTuple):
    """A fault to be scaled once the logs are known."""

    kind: FaultKind
    target_v: float
    sign: float
    seed: int

    def fault(self, *, shortest_s: float, fullest: float) -> Fault:
        """Return the fault of unit size; `fullest` is the highest initial SoC of the logs [-]."""
        sign = self.sign
        if self.kind.id == "initial_soc" and fullest > _NEARLY_FULL:
            sign = -1.0  # a full pack cannot be fuller
        if "at_s" not in self.kind.shape:
            return Fault(self.kind.id, sign, seed=self.seed)
        # A change within the shortest log, and so in all of them.
        part = 0.2 + 0.5 * float(np.random.default_rng(self.seed).random())
        return Fault(self.kind.id, sign, {"at_s": part * shortest_s}, self.seed)


def _draw_requests(
    effects: Sequence[str], floor_v: float, rng: np.random.Generator
) -> list[FaultRequest]:
    kinds = [fault_kind(effect) for effect in effects]
    low, high = np.log(_GAP_IN_FLOORS)
    targets = [float(floor_v * np.exp(rng.uniform(low, high))) for _ in kinds]
    signs = [-1.0 if kind.signed and rng.random() < 0.5 else 1.0 for kind in kinds]
    seeds = [int(rng.integers(2**31)) for _ in kinds]
    return list(map(FaultRequest, kinds, targets, signs, seeds))


def draw_case(
    seed: int,
    effects: Sequence[str],
    scenario: Scenario,
    options: CaseOptions,
) -> DrawnCase:
    """Draw a case on a simulated pack.

    If the drives cannot show an effect in the wanted size (no cold, no low SoC …), others are
    drawn; the best ones are kept.

    Parameters
    ----------
    seed : int
    effects : sequence of str
        Ids of the faults; empty for a healthy pack.
    scenario : Scenario
    options : CaseOptions

    Raises
    ------
    InputError
        For an unknown effect.
    """
    rng = np.random.default_rng([seed, 2])
    plant, pack = scenario.plant, scenario.pack
    floor_v = scenario.sensor_floor_v if options.floor_v is None else options.floor_v
    requests = _draw_requests(effects, floor_v, rng)
    attempts = []
    for _ in range(options.max_draws):
        drives = scenario.draw_drives(rng, options.n_logs, options.hours)
        healthy = [simulate_truth(plant, drive) for drive in drives]
        shortest_s = min(float(drive.time_s[-1]) for drive in drives)
        fullest = max(drive.start_soc for drive in drives)
        scaled = tuple(
            scale_to_gap(
                plant,
                drives,
                request.fault(shortest_s=shortest_s, fullest=fullest),
                request.target_v,
                healthy,
            )
            for request in requests
        )
        attempts.append((_reached(scaled), drives, scaled, healthy))
        if attempts[-1][0] >= _REACHED:
            break
    _, drives, scaled, healthy = max(attempts, key=lambda attempt: attempt[0])
    faults = [item.fault for item in scaled]
    recordings = tuple(
        record_drive(plant, drive, faults, name=f"log_{number}", healthy=clean)
        for number, (drive, clean) in enumerate(zip(drives, healthy, strict=True), start=1)
    )
    gap_v = rms(np.concatenate([recording.gap_v for recording in recordings]))
    truth = {
        "plant": plant.name,
        "seed": seed,
        "world_seed": scenario.seed,
        "effects": [fault.id for fault in faults],
        "faults": [_describe(item) for item in scaled],
        "gap_v": gap_v,
        "floor_sensor_v": scenario.sensor_floor_v,
        "gap_counted_in_v": floor_v,
        "redraws": len(attempts) - 1,
        "pack": {
            "kind": pack.name,
            "chemistry": pack.chemistry.name,
            "cells": pack.cells,
            "capacity_ah": pack.capacity_ah,
            "nominal_v": pack.nominal_v,
            "resistance_ohm": pack.resistance_ohm,
            "sensors": asdict(pack.sensors),
        },
        "logs": [
            {
                "name": recording.log.name,
                "hours": recording.log.duration_s / 3600.0,
                "ambient_c": float(drive.ambient_c[0]),
                "temperature_c": _extent(recording.log.temperature_c),
                "soc_pct": _extent(recording.true_soc_pct),
                "gap_v": rms(recording.gap_v),
                "floor_v": rms(recording.sensor_error_v),
            }
            for recording, drive in zip(recordings, drives, strict=True)
        ],
    }
    return DrawnCase(
        logs=tuple(recording.log for recording in recordings),
        healthy_logs=tuple(
            record_drive(plant, drive, (), healthy=clean).log
            for drive, clean in zip(drives, healthy, strict=True)
        ),
        faults=scaled,
        gap_v=gap_v,
        truth=truth,
        recordings=recordings,
    )


def draw_recorded_case(
    seed: int,
    effects: Sequence[str],
    held_out: Sequence[Log],
    pack: Pack,
    *,
    floor_v: float,
    n_logs: int,
    plant_name: str = "recorded",
) -> DrawnCase:
    """Draw a case on recorded logs: faults injected into some of them.

    Parameters
    ----------
    seed : int
    effects : sequence of str
        Ids of the faults; empty for logs as recorded.
    held_out : sequence of Log
        Healthy logs; other ones are drawn if the first cannot show the effect.
    pack : Pack
        From `fit_surrogate_pack`.
    floor_v : float
        Unit of the gap [V].
    n_logs : int
        Logs that share the faults.
    plant_name : str
        Name of the data set, for the truth.

    Raises
    ------
    InputError
        If there are fewer logs, or an effect is unknown.
    """
    if not 1 <= n_logs <= len(held_out):
        raise InputError(f"there are {len(held_out)} logs", field="n_logs", value=n_logs)
    rng = np.random.default_rng([seed, 3])
    requests = _draw_requests(effects, floor_v, rng)
    attempts: list[tuple[float, list[Log], tuple[ScaledFault, ...]]] = []
    for _ in range(_RECORDED_DRAWS):
        chosen = rng.choice(len(held_out), size=n_logs, replace=False)
        logs = [held_out[index] for index in np.sort(chosen)]
        fullest = max(float(soc_of(log, pack.capacity_ah)[0]) for log in logs)
        shortest_s = min(log.duration_s for log in logs)
        scaled = tuple(
            scale_injection(
                logs,
                request.fault(shortest_s=shortest_s, fullest=fullest),
                request.target_v,
                pack,
                seed=seed,
            )
            for request in requests
        )
        attempts.append((_reached(scaled), logs, scaled))
        if attempts[-1][0] >= _REACHED or n_logs == len(held_out):
            break
    _, logs, scaled = max(attempts, key=lambda attempt: attempt[0])
    faults = [item.fault for item in scaled]
    injected = [inject(log, faults, pack, seed=seed) for log in logs]
    gap_v = rms(np.concatenate([item.gap_v for item in injected]))
    truth = {
        "plant": plant_name,
        "seed": seed,
        "effects": [fault.id for fault in faults],
        "faults": [_describe(item) for item in scaled],
        "gap_v": gap_v,
        "floor_sensor_v": floor_v,
        "gap_counted_in_v": floor_v,
        "redraws": len(attempts) - 1,
        "logs": [
            {
                "name": log.name,
                "hours": log.duration_s / 3600.0,
                "temperature_c": _extent(log.temperature_c),
                "soc_pct": _extent(item.true_soc_pct),
                "gap_v": rms(item.gap_v),
            }
            for item, log in zip(injected, logs, strict=True)
        ],
    }
    return DrawnCase(tuple(item.log for item in injected), tuple(logs), scaled, gap_v, truth)


def _reached(scaled: Sequence[ScaledFault]) -> float:
    return min((item.reached_v / item.target_v for item in scaled), default=1.0)


def _describe(item: ScaledFault) -> dict[str, Any]:
    kind = item.fault.kind
    return {
        "id": kind.id,
        "family": kind.family,
        "parameter": kind.parameter,
        "unit": kind.unit,
        "size": item.fault.size,
        "comparable": kind.comparable,
        "shape": item.fault.full_shape(),
        "seed": item.fault.seed,
        "near": list(kind.resembles),
        "gap_v": item.reached_v,
        "gap_wanted_v": item.target_v,
        "limited": item.limited,
    }


def _extent(values: FloatArray) -> list[float]:
    return [float(np.min(values)), float(np.max(values))]
