"""Protection and checks that a service's configuration states, before those of the car's mapping.

What changes the numbers of a car for good belongs into its map file, which `estimate` reads, too;
these are for a car that is known by name, or for a bus with a quirk of its own::

    [messages.BATTERY_1DB]
    protection = "leaf"

    [checks.voltage]
    lowest = 240
    highest = 410
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

from cangauge.bus.mapping import CheckMap, MessageMap, RuleMap, VehicleMap


@dataclass(frozen=True, slots=True)
class Overrides:
    """What goes before a mapping.

    Parameters
    ----------
    source : str
        Where it comes from, for messages.
    messages : mapping of str to MessageMap
        By name or id; what one leaves out is the mapping's.
    rules : mapping of str to RuleMap
    checks : mapping of str to CheckMap
        By role: "current", "voltage", "temperature", "soc_reference".
    """

    source: str = ""
    messages: Mapping[str, MessageMap] = field(default_factory=lambda: MappingProxyType({}))
    rules: Mapping[str, RuleMap] = field(default_factory=lambda: MappingProxyType({}))
    checks: Mapping[str, CheckMap] = field(default_factory=lambda: MappingProxyType({}))

    def stated_messages(
        self, mapping: VehicleMap, source: str, key_of: Callable[[str], int]
    ) -> dict[int, tuple[MessageMap, str]]:
        """Return what both state, by the messages' keys, and where the word on it was spoken.

        Another protection drops the mapping's figures for its own one; the period stays.
        """
        stated = {key_of(name): (each, source) for name, each in mapping.messages.items()}
        for name, each in self.messages.items():
            key = key_of(name)
            before = stated[key][0] if key in stated else MessageMap()
            if each.protection is not None:
                before = MessageMap(period_s=before.period_s)
            given = {name: getattr(each, name) for name in each.model_fields_set}
            stated[key] = (before.model_copy(update=given), self.source)
        return stated


NO_OVERRIDES: Final = Overrides()
