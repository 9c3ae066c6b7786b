"""A field that may be a wanted signal: its scale and range, and the evidence for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from cangauge.extras.discovery.fields import Place, Stream

SIGNALS: Final = {
    "current": ("current_a", "A"),
    "voltage": ("voltage_v", "V"),
    "soc_reference": ("soc_pct", "%"),
    "temperature": ("temperature_c", "°C"),
}
"""Column of a log and unit by role; the column names the signal in a DBC that is written."""
VOLTAGE_SCALES: Final = {
    0.1: 0.0,
    0.5: -0.3,
    0.25: -0.3,
    0.01: -0.3,
    0.125: -1.2,
    0.05: -2.0,
    0.02: -2.0,
    1.0: -1.0,
    2.0: -3.0,
}
CURRENT_SCALES: Final = {
    0.1: 0.0,
    0.5: -0.3,
    0.25: -0.5,
    0.01: -0.5,
    0.05: -0.5,
    1.0: -1.0,
    0.025: -1.0,
    0.125: -1.2,
    0.02: -1.5,
}
"""Usual scales [V, A] and their log priors [nats], by their frequency in public DBC files."""
SOC_SCALES: Final = (0.1, 0.5, 0.01, 1.0, 0.05, 0.025, 0.02, 0.4)
"""Usual scales of a SoC [%]."""
NOMINAL_CELL_V: Final = 3.7
"""Nominal voltage of an oxide cell [V], to count the cells that a scale implies."""
MOST_A: Final = 1500.0
"""Largest current of a pack [A]: the fastest cars draw 1,500 A."""
LEAST_HOURS: Final = 1.0 / 20.0
"""Least capacity by the largest current [h]: no car is driven at more than 20 C."""
MOST_SAG: Final = 0.2
"""Largest share of its voltage by which a pack sags: inverters switch off below."""
SOC_AGREES: Final = 0.1
"""Largest relative difference of the capacities that SoC and charge have by two halves."""
MOVES: Final = 5
MOVE: Final = 0.1
"""Steps of a current without which nothing proves it, and their size as a share of its range."""
LARGEST_RATIO: Final = 2.0
"""Largest ratio of the resistances by two halves of a capture: a coincidence does not repeat."""


@dataclass(frozen=True)
class Level:
    """What a usual scale of a field would mean."""

    scale: float
    value: float
    """The pack's voltage in the middle of its range [V], or the largest SoC [%]."""
    text: str


@dataclass(frozen=True, eq=False)
class SignalCandidate:
    """A field that may be the wanted signal.

    Parameters
    ----------
    role : str
        Key of `SIGNALS`.
    stream : Stream
        The frames that carry it.
    place : Place
    scale, offset : float
        value = scale × raw + offset, in A, V, % or °C.
    sign : int
        −1 where positive values charge.
    low, high : float
        Range of the values.
    steps, moves : int
        Number of changes in the capture, and of those by a share `MOVE` of the range.
    not_available : int or None
        Raw code in the capture that means "no value".
    score, evidence : float
        Log posterior and its part from the physics [nats].
    correlation, resistance_ohm : float
        With its partner; NaN where there is none.
    halves_ohm : tuple of float
        Resistance by the first and by the second half of the capture.
    partner : str
    capacity_ah : float
        Charge of 100 % of a SoC [Ah]; else NaN.
    others : tuple of Level
        Other readings of a voltage that fit the stated one as well.
    """

    HEAD: ClassVar = ("field", "scale", "range", "score", "evidence")

    role: str
    stream: Stream
    place: Place
    scale: float
    offset: float
    low: float
    high: float
    steps: int
    moves: int
    not_available: int | None
    score: float
    evidence: float = 0.0
    sign: int = 1
    correlation: float = math.nan
    resistance_ohm: float = math.nan
    halves_ohm: tuple[float, float] = (math.nan, math.nan)
    partner: str = ""
    capacity_ah: float = math.nan
    others: tuple[Level, ...] = ()

    @property
    def is_repeated(self) -> bool:
        """Whether both halves of the capture show alike resistances."""
        one, two = self.halves_ohm
        return max(one, two) <= LARGEST_RATIO * min(one, two)

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
    def period_s(self) -> float:
        """Median interval of its frames [s]."""
        return self.stream.period_s

    @property
    def bits(self) -> frozenset[tuple[int, bool, int]]:
        """Its bits, each with its id: a gateway repeats frames on other buses."""
        return self.stream.bits(self.place)

    @property
    def bits_text(self) -> str:
        """Bits as in a DBC, such as "7|11@0-"."""
        order, sign = int(not self.place.is_motorola), "-" if self.place.is_signed else "+"
        return f"{self.start}|{self.place.width}@{order}{sign}"

    @property
    def name(self) -> str:
        """Id and bits, such as "0x1DB 7|11@0-"."""
        name = f"{self.stream.name} {self.bits_text}"
        return name if self.stream.selector is None else f"{name} m{self.stream.selector.value}"

    @property
    def message(self) -> str:
        """Name of its message in a DBC that is written."""
        return f"FRAME_{self.stream.arbitration_id:X}"

    @property
    def signal(self) -> str:
        """Its name in a DBC that is written."""
        return SIGNALS[self.role][0]

    @property
    def range_text(self) -> str:
        """Range of its values, discharge positive."""
        return range_text(self.low, self.high, SIGNALS[self.role][1], self.sign)

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a table under `HEAD`."""
        return self.name, f"{self.scale:g}", self.range_text, f"{self.score:.1f}", self.facts

    def levels(self, nominal_v: float | None) -> list[Level]:
        """Return what usual scales mean, its own first; empty where nothing but its own may be.

        Bits and the relation to the current are the same by every scale. A stated nominal voltage
        decides that of the voltage, unless other bits of the field fit it as well.
        """
        found = []
        middle = (self.low + self.high) / 2.0 / self.scale
        if self.others:
            own_v = self.scale * middle
            text = f"{own_v:.3g} V at {self.scale:g} V a step of {self.place.width} bits"
            return [Level(self.scale, own_v, text), *self.others]
        if self.role == "voltage" and nominal_v is None:
            for scale in VOLTAGE_SCALES:
                volts = scale * middle
                text = f"{volts:.3g} V at {scale:g} V a step"
                text += f" (about {round(volts / NOMINAL_CELL_V)} cells)"
                if scale == self.scale or 30.0 < volts < 1000.0:
                    found.append(Level(scale, volts, text))
        if self.role == "soc_reference":
            for scale in SOC_SCALES:
                low, high = (end * scale / self.scale for end in (self.low, self.high))
                capacity_ah = self.capacity_ah * self.scale / scale
                text = f"{low:.3g} … {high:.3g} % at {scale:g} % a step ({capacity_ah:.0f} Ah)"
                if scale == self.scale or (high <= 100.0 and is_capacity(capacity_ah)):
                    found.append(Level(scale, high, text))
        found.sort(key=lambda level: (level.scale != self.scale, level.scale))
        return found if len(found) > 1 else []

    def comments(self, nominal_v: float | None) -> list[str]:
        """Return the lines that the map states of it: range, evidence, what decided its scale."""
        lines = [f"{self.name}: {self.range_text}, {self.steps} steps."]
        lines.append(f"{self.facts[0].upper()}{self.facts[1:]}.")
        factor = f"Factor {self.scale:g} is the"
        if self.role == "current":
            lines.append(f"{factor} usual one that gives a plausible R; others fit as well.")
            lines.append(f"No current at raw {round(-self.offset / self.scale)}.")
        elif self.role == "voltage" and nominal_v is not None:
            lines.append(f"{factor} one that fits the stated {nominal_v:g} V.")
        if others := "; ".join(level.text for level in self.levels(nominal_v)[1:]):
            lines.append(f"{factor} likeliest; the data fit as well: {others}.")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        of = self.stream
        return {
            "id": of.name,
            "bus": of.bus,
            "start": self.start,
            "length": self.place.width,
            "byte_order": "motorola" if self.place.is_motorola else "intel",
            "signed": self.place.is_signed,
            "scale": self.scale,
            "offset": self.offset,
            "sign": self.sign,
            "multiplexer_value": None if of.selector is None else of.selector.value,
            "range": [self.low, self.high],
            "steps": self.steps,
            "period_s": of.period_s,
            "score": self.score,
            "evidence": self.evidence,
            "correlation": self.correlation,
            "resistance_ohm": self.resistance_ohm,
            "halves_ohm": list(self.halves_ohm),
            "partner": self.partner,
        }


def range_text(low: float, high: float, unit: str, sign: int = 1) -> str:
    """Return a range of values of a sign."""
    ends = sorted((sign * low + 0.0, sign * high + 0.0))
    return f"{ends[0]:.5g} … {ends[1]:.5g} {unit}".replace("-", "−")


def is_capacity(capacity_ah: float) -> bool:
    """Return whether a pack may have this capacity: of a scooter to that of a truck."""
    return 2.0 < capacity_ah < 600.0
