"""A pack with its clean days: what a user has before a fault, drawn from one seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from cangauge.errors import InputError
from cangauge.validation.twin.condition import HEALTHY
from cangauge.validation.twin.day import Day, draw_day
from cangauge.validation.twin.faults import Fault, apply_faults
from cangauge.validation.twin.pack import Pack, draw_pack
from cangauge.validation.twin.plant import Plant, TwinPlant, draw_equation_plant
from cangauge.validation.twin.simulate import (
    Recording,
    Truth,
    expected_voltage,
    record,
    simulate,
    true_soc_pct,
)

Climate = Literal["wide", "mild"]
PlantName = Literal["twin", "equation", "published", "pybamm"]
_CLIMATES: Final[dict[str, tuple[float, float]]] = {"wide": (-10.0, 35.0), "mild": (10.0, 28.0)}


@dataclass(frozen=True, eq=False)
class World:
    """A pack, clean days to identify it on, and clean reference days at other temperatures.

    Parameters
    ----------
    seed : int
    plant : Plant
    training, references : tuple of Recording
        The first training log runs from full to empty at a mild temperature.
    reference_days : tuple of Day
    climate : {"wide", "mild"}
        Range of the ambient temperature: −10–35 or 10–28 °C.
    """

    seed: int
    plant: Plant
    training: tuple[Recording, ...]
    references: tuple[Recording, ...]
    reference_days: tuple[Day, ...]
    climate: Climate

    @property
    def pack(self) -> Pack:
        """Size, thermal masses and sensors of the plant."""
        return self.plant.pack

    @property
    def floor_v(self) -> float:
        """RMS error of a perfect model on the references, from noise, steps and start [V]."""
        clean = self.references or self.training
        return rms(np.concatenate([recording.floor_v for recording in clean]))

    def draw_days(
        self,
        rng: np.random.Generator,
        count: int,
        hours: float | None = None,
        ambient_c: tuple[float, float] | None = None,
    ) -> tuple[Day, ...]:
        """Return days within the temperatures of the references.

        The pack's own law of temperature would otherwise be a gap that no reference shows.

        Parameters
        ----------
        rng : Generator
        count : int
        hours : float, optional
            Length of each [h].
        ambient_c : tuple of float, optional
            Another range of the ambient temperature [°C].
        """
        low, high = self._known_ambient() if ambient_c is None else ambient_c
        return tuple(
            draw_day(rng, self.pack, hours=hours, ambient_c=float(rng.uniform(low, high)))
            for _ in range(count)
        )

    def _known_ambient(self) -> tuple[float, float]:
        known = [float(day.ambient_c[0]) for day in self.reference_days]
        if not known:
            return _CLIMATES[self.climate]
        low, high = min(known), max(known)
        return (low, high) if high - low > 4.0 else (low - 2.0, high + 2.0)


def rms(values: NDArray[np.float64]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def draw_world(
    seed: int,
    *,
    kind: str | None = None,
    chemistry_name: str | None = None,
    n_reference: int = 3,
    n_training: int = 1,
    climate: Climate = "wide",
    plant_name: PlantName = "twin",
) -> World:
    """Return a pack with clean logs, all drawn from one seed.

    Parameters
    ----------
    seed : int
    kind : str, optional
        One of `pack.KINDS`.
    chemistry_name : {"nmc", "lmo", "nca", "lfp"}, optional
    n_reference : int
        Reference days, their temperatures spread over the climate.
    n_training : int
        Days to identify the model on: one from full to empty, further ones at random.
    climate : {"wide", "mild"}
    plant_name : {"twin", "equation", "published", "pybamm"}
        What simulates the cells; `pybamm` needs the extra of that name.

    Raises
    ------
    InputError
        If a number or name is out of range.
    """
    if n_training < 1 or n_reference < 0:
        raise InputError(
            "a world needs at least one training day and no negative number of references",
            value=(n_training, n_reference),
        )
    if climate not in _CLIMATES:
        raise InputError("no such climate", value=climate, cure="use wide or mild")
    rng = np.random.default_rng([seed, 1])
    plant = draw_plant(rng, kind, chemistry_name, plant_name)
    pack = plant.pack
    low, high = _CLIMATES[climate]
    training = [
        draw_day(
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
        draw_day(rng, pack, ambient_c=float(rng.uniform(low, high))) for _ in range(n_training - 1)
    ]
    # One temperature from each of as many equal ranges, in random order.
    edges = np.linspace(low, high, n_reference + 1)
    ambient = rng.permutation(rng.uniform(edges[:-1], edges[1:]))
    references = tuple(draw_day(rng, pack, ambient_c=float(degrees)) for degrees in ambient)
    return World(
        seed=seed,
        plant=plant,
        training=tuple(
            record_day(plant, day, (), name=f"training_{number}")
            for number, day in enumerate(training, start=1)
        ),
        references=tuple(
            record_day(plant, day, (), name=f"reference_{number}")
            for number, day in enumerate(references, start=1)
        ),
        reference_days=references,
        climate=climate,
    )


def draw_plant(
    rng: np.random.Generator,
    kind: str | None = None,
    chemistry_name: str | None = None,
    name: PlantName = "twin",
) -> Plant:
    """Return a pack and what simulates it (parameters as in `draw_world`).

    Raises
    ------
    InputError
        If a name is unknown, or PyBaMM is wanted and not installed.
    """
    pack = draw_pack(rng, kind, chemistry_name)
    if name == "twin":
        return TwinPlant(pack)
    if name in {"equation", "published"}:
        return draw_equation_plant(rng, pack, knows_core=name == "published")
    if name == "pybamm":
        # An extra, and slow to import.
        from cangauge.validation.twin.pybamm_plant import draw_pybamm_plant  # noqa: PLC0415

        return draw_pybamm_plant(rng, pack)
    raise InputError("no such plant", value=name, cure="use twin, equation, published or pybamm")


def record_day(
    plant: Plant,
    day: Day,
    faults: Sequence[Fault],
    *,
    name: str = "log",
    healthy: Truth | None = None,
) -> Recording:
    """Return what is recorded of a day with faults (or none).

    Parameters
    ----------
    plant : Plant
    day : Day
    faults : sequence of Fault
    name : str
        Of the log.
    healthy : Truth, optional
        The same day without faults, if it is known already.
    """
    condition = apply_faults(plant.pack, tuple(faults))
    clean = simulate(plant, day) if healthy is None else healthy
    truth = clean if condition is HEALTHY else simulate(plant, day, condition, clean)
    return record(
        plant.pack,
        day,
        truth,
        soc_pct=true_soc_pct(plant.pack, day, truth, condition),
        expected_v=expected_voltage(plant, day, truth, clean),
        name=name,
    )
