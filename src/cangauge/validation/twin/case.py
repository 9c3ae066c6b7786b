"""The files of a case: logs with neutral names in one folder, the truth apart and sealed.

Cases of the withheld check on a simulated plant: the cause is drawn, hidden and sealed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge._io import write_text_atomic
from cangauge._typing import FloatArray
from cangauge.logs.canonical import write_log, write_table
from cangauge.logs.log import Log
from cangauge.validation.twin.day import Day
from cangauge.validation.twin.faults import Fault, FaultKind, fault_kind, fault_kinds
from cangauge.validation.twin.scaling import Scaled, scale_to_gap
from cangauge.validation.twin.simulate import Recording, simulate
from cangauge.validation.twin.world import Climate, PlantName, World, draw_world, record_day, rms

# --- The files of a case: logs with neutral names in one folder, the truth apart and sealed

SCHEMA: Final = 1


@dataclass(frozen=True)
class Case:
    """Where the files of a case are. Nothing here tells the cause.

    Parameters
    ----------
    name : str
    training, references, logs : tuple of Path
        Canonical logs; `soc_pct` holds the assumed start only.
    capacity_ah : float
        Capacity that the gauge assumes.
    truth : Path
        The sealed file with the cause; for the scorer alone.
    truth_sha256 : str
        Of that file, to be shown before the diagnosis starts.
    """

    name: str
    training: tuple[Path, ...]
    references: tuple[Path, ...]
    logs: tuple[Path, ...]
    capacity_ah: float
    truth: Path
    truth_sha256: str


@dataclass(frozen=True, eq=False)
class CaseLogs:
    """The logs that a diagnosis gets to see."""

    training: Sequence[Log]
    references: Sequence[Log]
    logs: Sequence[Log]
    capacity_ah: float


def write_case_files(
    shown: CaseLogs,
    truth: Mapping[str, Any],
    hidden: Sequence[Mapping[str, FloatArray]],
    *,
    folder: Path,
    sealed: Path,
    name: str,
) -> Case:
    """Write a case.

    Parameters
    ----------
    shown : CaseLogs
    truth : mapping
        For `sealed/NAME.json`; its `logs` gets the name and SHA-256 of each hidden table.
    hidden : sequence of mapping of str to array
        Columns of `sealed/NAME_log_1.parquet` …, one table a diagnosed log.
    folder : Path
        Gets `NAME/training_1.parquet` …, `reference_1.parquet` …, `log_1.parquet` …, `case.json`.
    sealed : Path
    name : str

    Raises
    ------
    InputError
        If a folder cannot be written.
    """
    place = folder / name
    for path in (place, sealed):
        path.mkdir(parents=True, exist_ok=True)
    files = {
        group: _write_logs(place, group, logs)
        for group, logs in (
            ("training", shown.training),
            ("reference", shown.references),
            ("log", shown.logs),
        )
    }
    listing = {
        "schema": SCHEMA,
        "name": name,
        "capacity_ah": shown.capacity_ah,
        "training": [path.name for path in files["training"]],
        "references": [path.name for path in files["reference"]],
        "logs": [path.name for path in files["log"]],
    }
    write_text_atomic(place / "case.json", json.dumps(listing, indent=1) + "\n")
    about_logs = []
    for number, (about, columns) in enumerate(zip(truth["logs"], hidden, strict=True), start=1):
        path = sealed / f"{name}_log_{number}.parquet"
        write_table(columns, path)
        about_logs.append({**about, "file": path.name, "sha256": _sha256(path)})
    sealed_file = sealed / f"{name}.json"
    whole = {"schema": SCHEMA, "name": name, **truth, "logs": about_logs}
    write_text_atomic(sealed_file, json.dumps(whole, indent=1) + "\n")
    return Case(
        name=name,
        training=files["training"],
        references=files["reference"],
        logs=files["log"],
        capacity_ah=shown.capacity_ah,
        truth=sealed_file,
        truth_sha256=_sha256(sealed_file),
    )


def fault_truth(item: Scaled) -> dict[str, Any]:
    """Return what the truth file says of one fault."""
    kind = item.fault.kind
    return {
        "id": kind.id,
        "family": kind.family,
        "parameter": kind.parameter,
        "unit": kind.unit,
        "size": item.fault.size,
        "comparable": kind.physical,
        "shape": item.fault.full_shape(),
        "seed": item.fault.seed,
        "near": list(kind.near),
        "gap_v": item.reached_v,
        "gap_wanted_v": item.wanted_v,
        "limited": item.limited,
    }


def extent(values: FloatArray) -> list[float]:
    """Return the least and the largest value."""
    return [float(np.min(values)), float(np.max(values))]


def _write_logs(place: Path, group: str, logs: Sequence[Log]) -> tuple[Path, ...]:
    paths = tuple(place / f"{group}_{number}.parquet" for number in range(1, len(logs) + 1))
    for path, log in zip(paths, logs, strict=True):
        write_log(log, path)
    return paths


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


# --- Cases of the withheld check on a simulated plant: the cause is drawn, hidden and sealed

ANY: Final = "any"
"""In place of an effect: one of the named ones at random."""
OUTSIDE: Final = "outside"
"""In place of an effect: one that no diagnosis is expected to know, at random."""
GAP_IN_FLOORS: Final = (0.5, 5.0)
_GOOD_ENOUGH: Final = 0.9
_NEARLY_FULL: Final = 0.8


@dataclass(frozen=True)
class CaseOptions:
    """What a case is like, apart from its seed and its effects.

    Parameters
    ----------
    n_reference, n_training, n_logs : int
        How many clean reference days, training days, and logs that share the effects.
    kind, chemistry_name : str, optional
        Of the pack; at random without.
    climate : {"wide", "mild"}
        Ambient temperature from −10–35 or 10–28 °C.
    plant_name : {"twin", "equation", "published", "pybamm"}
        What simulates the cells.
    gap_in_floors : tuple of float
        Range of the gap of one effect, in floors, drawn evenly in its logarithm.
    floor_v : float, optional
        The floor to count in [V]; without, the sensors' own on the references.
    hours : float, optional
        Length of each diagnosed log [h]; drawn from 0.5–2.5 without.
    ambient_c : tuple of float, optional
        Range of the ambient temperature of the diagnosed logs [°C]; without, within that of the
        references. Beyond it the pack's own law of temperature opens a gap, fault or not.
    draws : int
        So many times days are drawn until they can show an effect in the wanted size.
    """

    n_reference: int = 3
    n_training: int = 1
    n_logs: int = 1
    kind: str | None = None
    chemistry_name: str | None = None
    climate: Climate = "wide"
    plant_name: PlantName = "twin"
    gap_in_floors: tuple[float, float] = GAP_IN_FLOORS
    floor_v: float | None = None
    hours: float | None = None
    ambient_c: tuple[float, float] | None = None
    draws: int = 12

    def draw_world(self, seed: int) -> World:
        """Return a pack with its clean days."""
        return draw_world(
            seed,
            kind=self.kind,
            chemistry_name=self.chemistry_name,
            n_reference=self.n_reference,
            n_training=self.n_training,
            climate=self.climate,
            plant_name=self.plant_name,
        )


DEFAULT: Final = CaseOptions()


@dataclass(frozen=True, eq=False)
class Drawn:
    """A case before it is written."""

    seed: int
    world: World
    scaled: tuple[Scaled, ...]
    days: tuple[Day, ...]
    logs: tuple[Recording, ...]
    redraws: int
    floor_v: float

    @property
    def gap_v(self) -> float:
        """RMS gap that all faults together open over all logs [V]."""
        return rms(np.concatenate([recording.gap_v for recording in self.logs]))


def make_case(
    seed: int,
    effects: str | Sequence[str] | None,
    folder: Path,
    sealed: Path,
    *,
    options: CaseOptions = DEFAULT,
    world: World | None = None,
    name: str | None = None,
) -> Case:
    """Draw a case and write it: logs with neutral names in `folder`, the truth in `sealed`.

    Parameters
    ----------
    seed : int
        Of everything that is not given.
    effects : str, sequence of str or None
        Ids of the faults, `any`, `outside`, or None for a healthy pack.
    folder, sealed : Path
        See `case_files.write_case_files`.
    options : CaseOptions
    world : World, optional
        Pack and clean days, to be shared by several cases; drawn from the seed without.
    name : str, optional
        Of the case; `case_SEED` without.

    Raises
    ------
    InputError
        If an effect is unknown, or a folder cannot be written.
    """
    drawn = draw_case(seed, effects, options=options, world=world)
    return write_case(drawn, folder, sealed, name or f"case_{seed:06d}")


def draw_case(
    seed: int,
    effects: str | Sequence[str] | None,
    *,
    options: CaseOptions = DEFAULT,
    world: World | None = None,
) -> Drawn:
    """Draw a case without writing it (parameters as in `make_case`).

    When the days drawn cannot show an effect in the wanted size (no cold, no low charge …),
    other days are drawn; the best are kept.
    """
    world = options.draw_world(seed) if world is None else world
    rng = np.random.default_rng([seed, 2])
    kinds = draw_kinds(effects, rng)
    floor_v = world.floor_v if options.floor_v is None else options.floor_v
    low, high = np.log(options.gap_in_floors)
    wanted = [float(floor_v * np.exp(rng.uniform(low, high))) for _ in kinds]
    signs = [-1.0 if kind.signed and rng.random() < 0.5 else 1.0 for kind in kinds]
    seeds = [int(rng.integers(2**31)) for _ in kinds]
    attempts = []
    for _ in range(options.draws):
        days = world.draw_days(rng, options.n_logs, options.hours, options.ambient_c)
        healthy = [simulate(world.plant, day) for day in days]
        faults = [
            shaped_fault(
                kind,
                sign,
                fault_seed,
                shortest_s=min(float(day.time_s[-1]) for day in days),
                fullest=max(day.start_soc for day in days),
            )
            for kind, sign, fault_seed in zip(kinds, signs, seeds, strict=True)
        ]
        scaled = tuple(
            scale_to_gap(world.plant, days, fault, volts, healthy)
            for fault, volts in zip(faults, wanted, strict=True)
        )
        reached = min((item.reached_v / item.wanted_v for item in scaled), default=1.0)
        attempts.append((reached, days, scaled, healthy))
        if reached >= _GOOD_ENOUGH:
            break
    _, days, scaled, healthy = max(attempts, key=lambda attempt: attempt[0])
    logs = tuple(
        record_day(
            world.plant,
            day,
            [item.fault for item in scaled],
            name=f"log_{number}",
            healthy=clean,
        )
        for number, (day, clean) in enumerate(zip(days, healthy, strict=True), start=1)
    )
    return Drawn(seed, world, scaled, days, logs, len(attempts) - 1, floor_v)


def write_case(drawn: Drawn, folder: Path, sealed: Path, name: str) -> Case:
    """Write a case that was drawn (parameters as in `make_case`)."""
    world = drawn.world
    shown = CaseLogs(
        training=[recording.log for recording in world.training],
        references=[recording.log for recording in world.references],
        logs=[recording.log for recording in drawn.logs],
        capacity_ah=world.pack.capacity_ah,
    )
    hidden = [
        {
            "time_s": recording.log.time_s,
            "true_soc_pct": recording.true_soc_pct,
            "true_voltage_v": recording.true_voltage_v,
            "expected_voltage_v": recording.expected_voltage_v,
            "gap_v": recording.gap_v,
            "floor_v": recording.floor_v,
        }
        for recording in drawn.logs
    ]
    return write_case_files(shown, _truth(drawn), hidden, folder=folder, sealed=sealed, name=name)


def draw_kinds(
    effects: str | Sequence[str] | None, rng: np.random.Generator
) -> tuple[FaultKind, ...]:
    """Return the kinds that were asked for, `any` and `outside` at random.

    Raises
    ------
    InputError
        If there is no such effect.
    """
    if effects is None:
        return ()
    if isinstance(effects, str):
        if effects in {ANY, OUTSIDE}:
            choices = fault_kinds(outside=effects == OUTSIDE)
            return (choices[int(rng.integers(len(choices)))],)
        return (fault_kind(effects),)
    return tuple(fault_kind(effect) for effect in effects)


def shaped_fault(
    kind: FaultKind, sign: float, seed: int, *, shortest_s: float, fullest: float
) -> Fault:
    """Return a fault of unit size whose shape fits the logs that will share it.

    Parameters
    ----------
    kind : FaultKind
    sign : float
    seed : int
    shortest_s : float
        Length of the shortest log [s]: what happens at a moment must happen in all.
    fullest : float
        Highest start SoC of the logs [-].
    """
    if kind.id == "initial_soc" and fullest > _NEARLY_FULL:
        sign = -1.0  # no pack is fuller than full
    if "at_s" not in kind.shape:
        return Fault(kind.id, sign, seed=seed)
    part = 0.2 + 0.5 * float(np.random.default_rng(seed).random())
    return Fault(kind.id, sign, {"at_s": part * shortest_s}, seed)


def _truth(drawn: Drawn) -> dict[str, Any]:
    world, pack = drawn.world, drawn.world.pack
    return {
        "plant": world.plant.name,
        "seed": drawn.seed,
        "world_seed": world.seed,
        "effects": [item.fault.id for item in drawn.scaled],
        "faults": [fault_truth(item) for item in drawn.scaled],
        "gap_v": drawn.gap_v,
        "floor_sensor_v": world.floor_v,
        "gap_counted_in_v": drawn.floor_v,
        "redraws": drawn.redraws,
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
                "ambient_c": float(day.ambient_c[0]),
                "temperature_c": extent(recording.log.temperature_c),
                "soc_pct": extent(recording.true_soc_pct),
                "gap_v": rms(recording.gap_v),
                "floor_v": rms(recording.floor_v),
            }
            for recording, day in zip(drawn.logs, drawn.days, strict=True)
        ],
    }
