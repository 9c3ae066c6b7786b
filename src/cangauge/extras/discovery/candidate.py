"""A signal that may have a role: its scale and range, and the evidence for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Final, NamedTuple

from cangauge.extras.discovery.fields import Place, Stream

MOST_A: Final = 1500.0
"""Largest current of a pack [A]: the fastest cars draw 1,500 A."""
LEAST_HOURS: Final = 1.0 / 20.0
"""Least capacity by the largest current [h]: no car is driven at more than 20 C."""
MOST_SAG: Final = 0.2
"""Largest share of its voltage by which a pack sags: inverters switch off below."""
CAPACITY_AH: Final = (2.0, 600.0)
"""Capacities of packs [Ah]: of a scooter to that of a truck."""
SOC_AGREES: Final = 0.1
"""Largest relative difference of the capacities that SoC and charge have by two halves."""
MOVES: Final = 5
MOVE: Final = 0.1
"""Steps of a current without which nothing proves it, and their size as a share of its range."""
LARGEST_RATIO: Final = 2.0
"""Largest ratio of the resistances by two halves of a capture: a coincidence does not repeat."""
SHOWN: Final = 3
"""Candidates of a role that are shown."""


class Role(NamedTuple):
    """Column of a log, unit, plausible median of its distinct values, and words of its names."""

    column: str
    unit: str
    within: tuple[float, float]
    words: str


ROLES: Final = {
    "current": Role(
        "current_a",
        "A",
        (-MOST_A, MOST_A),
        "current curr cur crnt amp amps ampere strom i ibat ibatt",
    ),
    "voltage": Role(
        "voltage_v",
        "V",
        (30.0, 1000.0),
        "voltage volt volts vlt vol spannung u v ubat ubatt vbat vbatt",
    ),
    "soc_reference": Role("soc_pct", "%", (0.0, 100.0), "soc stateofcharge ladezustand"),
    "temperature": Role("temperature_c", "°C", (-30.0, 60.0), "temperature temperatur temp temps"),
}


class Level(NamedTuple):
    """What a usual scale of a field would mean: middle of a voltage [V], or highest SoC [%]."""

    scale: float
    value: float
    text: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Candidate:
    """A signal that may have a role.

    Parameters
    ----------
    role : str
        Key of `ROLES`.
    message, signal, unit : str
        Names in the DBC, and its unit.
    low, high : float
        Range of the values in the capture; NaN without one.
    period_s : float
        Median interval of its frames [s].
    sign : int
        −1 where positive values charge.
    score, evidence : float
        Larger is likelier; and its part from the physics.
    levels : tuple of Level
        Readings by usual scales, its own first; empty where its scale is certain.
    """

    HEAD: ClassVar[tuple[str, ...]]

    role: str = ""
    message: str
    signal: str
    unit: str
    low: float = math.nan
    high: float = math.nan
    period_s: float = math.nan
    sign: int = 1
    score: float = 0.0
    evidence: float = 0.0
    levels: tuple[Level, ...] = ()

    @property
    def range_text(self) -> str:
        """Range of its values, discharge positive; "" without a capture."""
        if math.isnan(self.low):
            return ""
        return range_text(self.low, self.high, self.unit.replace("degC", "°C"), self.sign)


@dataclass(frozen=True, eq=False, kw_only=True)
class SignalCandidate(Candidate):
    """A field that may be the wanted signal; scores are log posteriors [nats].

    Parameters
    ----------
    stream : Stream
        The frames that carry it.
    place : Place
    scale, offset : float
        value = scale × raw + offset, in A, V, % or °C.
    steps, moves : int
        Number of changes in the capture, and of those by a share `MOVE` of the range.
    not_available : int or None
        Raw code in the capture that means "no value".
    correlation, resistance_ohm : float
        With its partner; NaN where there is none.
    halves_ohm : tuple of float
        Resistance by the first and by the second half of the capture.
    partner : str
    capacity_ah : float
        Charge of 100 % of a SoC [Ah]; else NaN.
    """

    HEAD: ClassVar = ("field", "scale", "range", "score", "evidence")

    stream: Stream
    place: Place
    scale: float
    offset: float
    steps: int
    moves: int
    not_available: int | None
    correlation: float = math.nan
    resistance_ohm: float = math.nan
    halves_ohm: tuple[float, float] = (math.nan, math.nan)
    partner: str = ""
    capacity_ah: float = math.nan

    @property
    def is_repeated(self) -> bool:
        """Whether both halves of the capture show alike resistances."""
        return max(self.halves_ohm) <= LARGEST_RATIO * min(self.halves_ohm)

    @property
    def facts(self) -> str:
        """The evidence in a phrase."""
        if self.evidence < 1.0:
            return "smooth; nothing else proves it"
        r = abs(self.correlation)
        if self.role == "soc_reference":
            return f"falls with the charge (correlation {r:.2f}), {self.partner}"
        text = f"voltage falls when current rises: with {self.partner}, correlation {r:.2f}"
        text += f", R {self.resistance_ohm:.2g} Ω"
        return text if self.is_repeated else f"{text}, but not in both halves of the capture"

    @property
    def start(self) -> int:
        """Start bit as in a DBC."""
        return self.place.start(self.stream.length)

    @property
    def bits(self) -> frozenset[tuple[int, bool, int]]:
        """Its bits, each with its id: a gateway repeats frames on other buses."""
        return self.stream.bits(self.place)

    @property
    def name(self) -> str:
        """Id and bits."""
        return field_name(self.stream, self.place)

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a table under `HEAD`."""
        return self.name, f"{self.scale:g}", self.range_text, f"{self.score:.1f}", self.facts

    def comments(self) -> list[str]:
        """Return the lines that the map states of it: range, evidence, what decided its scale."""
        lines = [f"{self.name}: {self.range_text}, {self.steps} steps."]
        lines.append(f"{self.facts[0].upper()}{self.facts[1:]}.")
        factor = f"Factor {self.scale:g} is the"
        if self.role == "current":
            lines.append(f"{factor} usual one that gives a plausible R; others fit as well.")
            lines.append(f"No current at raw {round(-self.offset / self.scale)}.")
        if others := "; ".join(level.text for level in self.levels[1:]):
            lines.append(f"{factor} likeliest; the data fit as well: {others}.")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        of = self.stream
        names = ["scale", "offset", "sign", "steps", "period_s", "score", "evidence", "partner"]
        names += ["correlation", "resistance_ohm"]
        return {
            "id": of.name,
            "bus": of.bus,
            "start": self.start,
            "length": self.place.width,
            "byte_order": "motorola" if self.place.is_motorola else "intel",
            "signed": self.place.is_signed,
            "multiplexer_value": None if of.selector is None else of.selector.value,
            "range": [self.low, self.high],
            "halves_ohm": [*self.halves_ohm],
            **{name: getattr(self, name) for name in names},
        }


def field_name(stream: Stream, place: Place) -> str:
    """Return id and bits as in a DBC, such as "0x1DB 7|11@0-"."""
    name = f"{stream.name} {place.text(stream.length)}"
    return name if stream.selector is None else f"{name} m{stream.selector.value}"


def range_text(low: float, high: float, unit: str, sign: int = 1) -> str:
    """Return a range of values of a sign."""
    ends = sorted((sign * low + 0.0, sign * high + 0.0))
    return f"{ends[0]:.5g} … {ends[1]:.5g} {unit}".replace("-", "−")


def is_capacity(capacity_ah: float) -> bool:
    """Return whether a pack may have this capacity."""
    least_ah, most_ah = CAPACITY_AH
    return least_ah < capacity_ah < most_ah
