"""Parameters of effects and their physical bounds, relative to a pack's sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from cangauge.model.voltage_model import VoltageModel

Scale = Literal["one", "capacity", "voltage", "resistance"]

WITHIN_C: Final = (-60.0, 120.0)
"""Beyond these no temperature of a pack is believed [°C]; laws of temperature are held there."""

RESISTANCE_AT_LEAST = 0.002
"""Least resistance that bounds are relative to, in voltage over 1 C current (a Leaf has 0.018): a
model whose resistances happen to cancel must not shut every resistance effect out."""

LEEWAY = 10.0
"""Bounds that are relative to the pack are this much wider in a model that has effects: the pack's
sizes are read off its coefficients, and effects such as RC elements may have taken most of its
resistance from these. A wrong unit is still found."""


@dataclass(frozen=True)
class Pack:
    """Sizes that bounds are relative to, so that one library fits a cell and an 800 V pack."""

    voltage_v: float
    """Pseudo-OCV at half charge [V]."""
    capacity_ah: float
    resistance_ohm: float
    """Sum of the model's resistances, positive [Ω]."""
    cells: int
    """Cells in series, from `voltage_v` at about 3.7 V a cell."""
    temperature_c: float = 25.0
    """Middle of the temperatures that the model was identified on [°C]."""

    @classmethod
    def of(cls, model: VoltageModel, capacity_ah: float) -> Pack:
        """Return the sizes of the pack that a model describes."""
        volts = model.pseudo_ocv_at(50.0)[0]
        coldest, hottest = WITHIN_C
        return cls(
            voltage_v=volts,
            capacity_ah=capacity_ah,
            resistance_ohm=max(
                abs(sum(model.resistance_ohm)), RESISTANCE_AT_LEAST * volts / capacity_ah
            ),
            cells=max(1, round(volts / 3.7)),
            temperature_c=min(max(0.5 * sum(model.temperature_range_c), coldest), hottest),
        )


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Parameters
    ----------
    name, unit : str
    low, high : float
        Physical bounds, in units of `scale`.
    neutral : float, optional
        Value at which the effect does nothing, in units of `scale`; None for a shape that has no
        such value.
    scale : {"one", "capacity", "voltage", "resistance"}
        What the bounds are multiplied by to get the parameter's unit.
    grid : tuple of floats, optional
        Values to try for a shape (a time constant, a moment); amplitudes have none and enter the
        voltage nearly linearly.
    from_pack : {"temperature_c"}, optional
        A constant that is neither fitted nor tried: this of the pack's sizes when the effect is
        added, and kept from then on, whatever becomes of the model.
    elsewhere : tuple of float, optional
        What a diagnosis tries and a fit does not. Of a shape: further values. Of such a constant:
        what is added to it; a fit's coefficients, which move with the effect, take up the
        difference.
    formerly : float, optional
        What it was before it was a parameter, in units of `scale`: that of a file without it.
    is_moment : bool
        Of a shape: a time of the log at which the voltage jumps.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float | None = 0.0
    scale: Scale = "one"
    grid: tuple[float, ...] | None = None
    from_pack: Literal["temperature_c"] | None = None
    elsewhere: tuple[float, ...] = ()
    formerly: float | None = None
    is_moment: bool = False

    def factor(self, pack: Pack) -> float:
        """Return what turns bounds and grid into the parameter's unit for a pack."""
        sizes = {
            "one": 1.0,
            "capacity": pack.capacity_ah,
            "voltage": pack.voltage_v,
            "resistance": pack.resistance_ohm,
        }
        return sizes[self.scale]

    def bounds(self, pack: Pack, leeway: float = 1.0) -> tuple[float, float]:
        """Return the physical bounds in the parameter's unit.

        Those that are relative to the pack are `leeway` times wider (`LEEWAY`).
        """
        factor = self.factor(pack)
        low, high = self.low * factor, self.high * factor
        if self.scale != "one":
            low, high = (low * leeway if low < 0.0 else low / leeway), high * leeway
        return low, high

    def trials(self, pack: Pack) -> tuple[float, ...]:
        """Return the values to try for a shape, in the parameter's unit; none for an amplitude."""
        factor = self.factor(pack)
        return tuple(value * factor for value in self.grid or ())
