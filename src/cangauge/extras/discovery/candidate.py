"""A signal that may have a role: its place and range, and what is said for and against it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from cangauge.extras.discovery.streams import Place, Stream

MOST_A: Final = 1500.0
"""Largest current of a pack [A]: the fastest cars draw 1,500 A."""
LEAST_HOURS: Final = 1.0 / 20.0
"""Least capacity by the largest current [h]: no car is driven at more than 20 C."""
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


def short_name(role: str) -> str:
    """Return a role as a user names it."""
    return role.removesuffix("_reference")


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
    name : str
        As it is shown: id and bits, or message and signal.
    message, signal, unit : str
        Names in the DBC, and its unit.
    score, evidence : float
        Larger is likelier, and its part from the physics: log posterior and log likelihood ratio
        [nats]; by names, matching words and the share of the voltage's changes by the current.
    against : tuple of str
        Why it may not have the role.
    low, high : float
        Range of the values in the capture; NaN without one.
    holds : tuple of float
        Range that the DBC gives it.
    period_s : float
        Median interval of its frames [s].
    sign : int
        −1 where positive values charge.
    is_wrapped : bool
        Whether the DBC reads a signed number as an unsigned one.
    not_available : tuple of int
        Raw codes in the capture that mean "no value".
    levels : tuple of Level
        Readings by usual scales, its own first; empty where its scale is certain.
    stream, place : Stream, Place, optional
        Frames and place of a signal that the physics found.
    bits : frozenset
        Its bits there, each with its id: a gateway repeats frames on other buses.
    scale, offset : float
        value = scale × raw + offset, in A, V, % or °C.
    steps, moves : int
        Number of changes in the capture, and of those by a tenth of the range.
    partner : str
        What it moves with.
    correlation, resistance_ohm : float
        With its partner; NaN where there is none.
    halves_ohm : tuple of float
        Resistance by the first and by the second half of the capture.
    """

    role: str = ""
    name: str
    message: str
    signal: str
    unit: str
    score: float = 0.0
    evidence: float = 0.0
    against: tuple[str, ...] = ()
    low: float = math.nan
    high: float = math.nan
    holds: tuple[float, float] = (math.nan, math.nan)
    period_s: float = math.nan
    sign: int = 1
    is_wrapped: bool = False
    not_available: tuple[int, ...] = ()
    levels: tuple[Level, ...] = ()
    stream: Stream | None = None
    place: Place | None = None
    bits: frozenset[tuple[int, bool, int]] = frozenset()
    scale: float = 1.0
    offset: float = 0.0
    steps: int = 0
    moves: int = 0
    partner: str = ""
    correlation: float = math.nan
    resistance_ohm: float = math.nan
    halves_ohm: tuple[float, float] = (math.nan, math.nan)

    @property
    def range_text(self) -> str:
        """Range of its values, discharge positive; "" without a capture."""
        if math.isnan(self.low):
            return ""
        return range_text(self.low, self.high, self.unit.replace("degC", "°C"), self.sign)

    @property
    def is_fit(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.against

    @property
    def is_repeated(self) -> bool:
        """Whether both halves of the capture show alike resistances: a coincidence does not."""
        return max(self.halves_ohm) <= 2.0 * min(self.halves_ohm)

    @property
    def facts(self) -> str:
        """What is said for it, in a phrase."""
        if self.place is None:
            share = (
                f"; voltage falls when current rises: {100.0 * self.evidence:.0f} % of its changes"
            )
            return f"by name and unit{share * (self.evidence > 0.0)}"
        if self.evidence < 1.0:
            return "smooth; nothing else proves it"
        r = f"correlation {abs(self.correlation):.2f}"
        if self.role == "soc_reference":
            return f"falls with the charge ({r}), {self.partner}"
        text = f"voltage falls when current rises: with {self.partner}, {r}"
        text += f", R {self.resistance_ohm:.2g} Ω"
        return text if self.is_repeated else f"{text}, but not in both halves of the capture"

    @property
    def head(self) -> tuple[str, ...]:
        """Headings of `cells`."""
        if self.place is None:
            return "signal, by name and unit", "range", "against it"
        return "field", "scale", "range", "score", "evidence"

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a table."""
        if self.place is None:
            seen = self.range_text or f"by DBC {range_text(*self.holds, self.unit)}"
            return f"{self.message}\n{self.signal}", seen, "; ".join(self.against)
        return self.name, f"{self.scale:g}", self.range_text, f"{self.score:.1f}", self.facts

    def comments(self) -> list[str]:
        """Return the lines that the map states of it: range, evidence, what decided its scale."""
        lines = [f"{self.name}: {self.range_text or 'in no capture'}; {self.facts}."]
        if others := "; ".join(level.text for level in self.levels[1:]):
            lines.append(f"Factor {self.scale:g} is the likeliest; the data fit as well: {others}.")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = ["message", "signal", "unit", "score", "evidence", "sign", "period_s"]
        found: dict[str, Any] = {
            "range": None if math.isnan(self.low) else [self.low, self.high],
            "against": [*self.against],
            "not_available": [*self.not_available],
        }
        if self.stream is not None and self.place is not None:
            names += ["scale", "offset", "steps", "partner", "correlation", "resistance_ohm"]
            found |= {
                "id": self.stream.name,
                "bus": self.stream.bus,
                "start": self.place.start(self.stream.length),
                "length": self.place.width,
                "byte_order": "motorola" if self.place.is_motorola else "intel",
                "signed": self.place.is_signed,
                "multiplexer_value": self.stream.selected,
                "halves_ohm": [*self.halves_ohm],
            }
        return found | {name: getattr(self, name) for name in names}


def range_text(low: float, high: float, unit: str, sign: int = 1) -> str:
    """Return a range of values of a sign."""
    ends = sorted((sign * low + 0.0, sign * high + 0.0))
    return f"{ends[0]:.5g} … {ends[1]:.5g} {unit}".replace("-", "−")
