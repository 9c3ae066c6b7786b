"""The vehicles that `--vehicle` knows by name."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from cangauge.bus.mapping import MessageMap, SignalMap, TemperatureMap, VehicleMap

_LEAF_MESSAGES: Final = {
    "BATTERY_1DB": MessageMap(protection="leaf", period_s=0.010),
    "BATTERY_55B": MessageMap(protection="leaf", period_s=0.100),
}
_LEAF_CURRENT: Final = SignalMap(message="BATTERY_1DB", signal="current_a", sign=-1)
_LEAF_VOLTAGE: Final = SignalMap(message="BATTERY_1DB", signal="voltage_v")
_LEAF_SOC: Final = SignalMap(message="BATTERY_55B", signal="soc_pct")
_LEAF_TEMPERATURE: Final = TemperatureMap(
    message="BATTERY_5C0", signal="temperature_average_c", timeout_s=10.0
)


@dataclass(frozen=True, slots=True)
class Preset:
    """A known vehicle.

    Parameters
    ----------
    dbc : str
        File in `dbc/`.
    mapping : VehicleMap
    about : str
        One line for help texts.
    periods_s : dict of int to float
        Periods by which captures of this vehicle are told from those of its relatives [s].
    lacks_temperature : bool
        Whether it puts no pack temperature on the bus that is known.
    """

    dbc: str
    mapping: VehicleMap
    about: str
    periods_s: dict[int, float] = field(default_factory=dict)

    @property
    def lacks_temperature(self) -> bool:
        """Whether it puts no pack temperature on the bus that is known."""
        return self.mapping.temperature is None


PRESETS: Final[dict[str, Preset]] = {
    "generic": Preset(
        dbc="generic_pack.dbc",
        about="a pack without a car: what replay sends by default",
        mapping=VehicleMap(
            name="generic pack",
            current=SignalMap(message="PACK_CURRENT", signal="current_a"),
            voltage=SignalMap(message="PACK_VOLTAGE", signal="voltage_v"),
            temperature=TemperatureMap(message="PACK_TEMPERATURE", signal="temperature_c"),
            soc_reference=SignalMap(message="PACK_SOC", signal="soc_pct"),
            messages={
                name: MessageMap(protection="generic")
                for name in ("PACK_CURRENT", "PACK_VOLTAGE", "PACK_TEMPERATURE", "PACK_SOC")
            },
        ),
    ),
    "leaf_ze0": Preset(
        dbc="nissan_leaf.dbc",
        about="Nissan Leaf 24 kWh, 2011-12",
        mapping=VehicleMap(
            name="Nissan Leaf ZE0",
            current=_LEAF_CURRENT,
            voltage=_LEAF_VOLTAGE,
            temperature=_LEAF_TEMPERATURE,
            soc_reference=_LEAF_SOC,
            temperature_source="pack",
            messages=_LEAF_MESSAGES,
        ),
        periods_s={0x5BC: 0.500},
    ),
    "leaf_aze0": Preset(
        dbc="nissan_leaf.dbc",
        about="Nissan Leaf 24/30 kWh, 2013-17; e-NV200; 40 kWh pack in such a car",
        mapping=VehicleMap(
            name="Nissan Leaf AZE0",
            current=_LEAF_CURRENT,
            voltage=_LEAF_VOLTAGE,
            temperature=_LEAF_TEMPERATURE,
            soc_reference=_LEAF_SOC,
            temperature_source="pack",
            messages=_LEAF_MESSAGES,
        ),
        periods_s={0x5BC: 0.100},
    ),
    "leaf_ze1": Preset(
        dbc="nissan_leaf.dbc",
        about="Nissan Leaf 40/62 kWh, from 2018; needs --temperature",
        mapping=VehicleMap(
            name="Nissan Leaf ZE1",
            current=_LEAF_CURRENT,
            voltage=_LEAF_VOLTAGE,
            soc_reference=_LEAF_SOC,
            messages=_LEAF_MESSAGES,
        ),
        periods_s={0x5BC: 0.100},
    ),
}
"""By the name that `--vehicle` takes."""
