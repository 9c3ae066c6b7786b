"""Defaults and names that help pages show, of modules that are slow to import.

`tests/cli/test_help_pages.py` holds each equal to the value that it repeats.
"""

from __future__ import annotations

from typing import Final

TEMPERATURE_SOURCES: Final = ("cell", "pack", "coolant", "room", "unknown")
VALID_STD_PCT: Final = 1.5
ALARM: Final = 0.05
LOCAL: Final = "local"
VEHICLE_PATTERN: Final = r"(?:vehicle=)?([^/]+)/[^/]+$"
FLEET_LOGS: Final = 3
FLEET_REFERENCES: Final = 30
PACKS: Final = (
    "i3_dev",
    "car1_dev",
    "lg_hg2_dev",
    "i3",
    "i3_winter",
    "car1",
    "lg_hg2",
    "lg_hg2_cold",
    "lg_hg2_from_25c",
    "leaf_module",
    "a123_lfp",
)
CASES: Final = (
    "withheld",
    "given",
    "start 20 % low",
    "start 20 % high",
    "+2 A",
    "-2 A",
    "capacity +10 %",
    "capacity -10 %",
    "voltage +0.5 %",
    "charges, capacity +10 %",
    "charges, capacity -10 %",
    "weak cell of 6",
    "weak cell of 96",
    "another pack's model",
)
