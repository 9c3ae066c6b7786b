"""Defaults and names that help pages show, of modules that are slow to import.

`tests/cli/test_help_pages.py` holds each equal to the value that it repeats.
"""

from __future__ import annotations

from typing import Final

TEMPERATURE_SOURCES: Final = ("cell", "pack", "coolant", "room", "unknown")
VALID_STD_PCT: Final = 3.0
ALARM: Final = 0.05
LOCAL: Final = "local"
VEHICLE_PATTERN: Final = r"(?:vehicle=)?([^/]+)/[^/]+$"
FLEET_LOGS: Final = 3
FLEET_REFERENCES: Final = 30
