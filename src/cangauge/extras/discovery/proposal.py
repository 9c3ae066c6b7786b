"""What `cangauge init` found, and the files that it writes: DBC, map and configuration."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from cangauge._text import printable
from cangauge.bus.vehicle import EXTENDED, PRESETS
from cangauge.extras.discovery.by_name import NamedSignal
from cangauge.extras.discovery.candidate import SIGNALS, Level, SignalCandidate

FALLBACK_C: Final = 20.0
"""Temperature of a map without one [°C]: the reference temperature of the voltage model."""
PAIR_S: Final = (0.020, 1.0)
"""Least and largest distance of paired current and voltage in a map [s]."""

Candidate = SignalCandidate | NamedSignal


@dataclass
class Proposal:
    """The signals of a car, and how they were found.

    Parameters
    ----------
    method : {"preset", "dbc", "physics"}
    candidates : dict of str to sequence
        By role, best first; of a preset none.
    clear : collection of str
        Roles whose first candidate is clearly ahead of the others.
    head, remarks : tuple of str
        What was looked at, for the head of the map; what the capture cannot show.
    vehicle : str, optional
        Name of the preset.
    dbc : Path, optional
        DBC whose signals are named.
    nominal_v : float, optional
        Voltage that the user states [V].
    chosen : dict of str to int
        Number of the candidate by role, from 0.
    has_steps : bool
        Whether a voltage of the captures follows a current.
    proof : dict
        What the captures show when they are decoded with the files.
    """

    method: Literal["preset", "dbc", "physics"]
    candidates: dict[str, Sequence[Candidate]] = field(default_factory=dict)
    clear: Collection[str] = ()
    head: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    vehicle: str | None = None
    dbc: Path | None = None
    nominal_v: float | None = None
    has_steps: bool = False
    chosen: dict[str, int] = field(default_factory=dict)
    proof: dict[str, Any] = field(default_factory=dict)

    @property
    def signals(self) -> dict[str, Candidate]:
        """Chosen candidates by role."""
        return {role: self.candidates[role][number] for role, number in self.chosen.items()}

    @property
    def fixed_c(self) -> float | None:
        """Temperature that the files assume [°C]; None where the bus has one."""
        if self.vehicle is not None:
            return FALLBACK_C if PRESETS[self.vehicle].lacks_temperature else None
        return None if "temperature" in self.chosen else FALLBACK_C

    @property
    def is_sign_proven(self) -> bool:
        """Whether the captures prove the sign of the current."""
        sign = self.proof.get("sign", {}).get("sign", 0)
        return sign > 0 or (sign < 0 and self.method != "physics")

    @property
    def answer(self) -> str:
        """The vehicle, or the signals found, in a phrase."""
        if self.vehicle is not None:
            return f"{PRESETS[self.vehicle].about} (--vehicle {self.vehicle})"
        found = [
            f"{role.removesuffix('_reference')} {signal.name}"
            + ("" if self.is_proven(role) and not self.levels(role) else " (?)")
            for role, signal in self.signals.items()
        ]
        way = "names" if self.method == "dbc" else "physics"
        return f"Found by {way}: {', '.join(found)}"

    def is_proven(self, role: str) -> bool:
        """Whether the captures leave nothing of a signal open but its scale."""
        if role == "current":
            return self.method != "physics" and self.is_sign_proven
        if role == "soc_reference":
            return bool(self.proof.get("soc", {}).get("agrees"))
        return True

    @property
    def sign_text(self) -> str:
        """What the captures show of the sign of a current that a preset or a DBC names."""
        if not self.is_sign_proven:
            return "Sign of the current: not proven; `cangauge inspect DRIVE` proves it."
        sign, text = self.proof["sign"]["sign"], self.proof["sign"]["text"]
        if self.method == "dbc":
            sign = self.signals["current"].sign
            way = "positive values charge on this bus" if sign < 0 else "positive discharges"
            return f"Sign of the current: {way}; {text}. The map has sign = {sign}."
        if sign > 0:
            return f"Sign of the current: as in the preset; {text}."
        return (
            f"warning: by this preset positive current charges ({text}): is it another car, or a"
            " converter that turns the sign? --no-presets searches by physics."
        )

    def levels(self, role: str) -> list[Level]:
        """Return what usual scales of a chosen field mean; empty where its scale is certain."""
        return self.signals[role].levels(self.nominal_v) if role in self.chosen else []

    def reading(self, folder: Path) -> str:
        """Return the options with which a command reads captures of this car."""
        if self.vehicle is None:
            return f"--map {folder / 'car.toml'}"
        fixed = "" if self.fixed_c is None else f" --temperature {self.fixed_c:g}"
        return f"--vehicle {self.vehicle}{fixed}"

    def texts(self, folder: Path, bus: Mapping[str, Any]) -> dict[str, str]:
        """Return the text of each file to write to a folder.

        `bus` has the `interface`, `channel` and `bus_options` of the configuration.
        """
        texts = {}
        if self.vehicle is None:
            fields = [each for each in self.signals.values() if isinstance(each, SignalCandidate)]
            if self.dbc is None:
                texts["car.dbc"] = _dbc_text(fields)
            texts["car.toml"] = "\n".join([*self._map_lines(folder), ""])
        texts["run.toml"] = "\n".join(self._config_lines(**bus))
        return texts

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        volts, socs = self.levels("voltage"), self.levels("soc_reference")
        return {
            "method": self.method,
            "vehicle": self.vehicle,
            "chosen": {role: number + 1 for role, number in self.chosen.items()},
            "candidates": {
                role: [each.to_dict() for each in self.candidates.get(role, ())] for role in SIGNALS
            },
            "remarks": list(self.remarks),
            "voltage_levels": [{"scale": each.scale, "voltage_v": each.value} for each in volts],
            "soc_levels": [{"scale": each.scale, "highest_pct": each.value} for each in socs],
            "proof": self.proof,
        }

    def _map_lines(self, folder: Path) -> Iterator[str]:
        dbc, head = "car.dbc", self.head
        if self.dbc is not None:
            own, head = self.dbc.resolve(), (*head, self.sign_text)
            dbc = own.name if own.parent == folder.resolve() else str(own)
            for role in ("soc_reference", "temperature"):
                if role not in self.chosen and (found := self.candidates[role]):
                    named = ", ".join(f"{each.name} ({each.range_text})" for each in found)
                    head = (*head, f"Not clear, so not used, {SIGNALS[role][0]}: {named}.")
        periods_s = [self.signals[role].period_s for role in ("current", "voltage")]
        pair_s = min(max(PAIR_S[0], 1.2 * max(periods_s)), PAIR_S[1])
        if math.isnan(sum(periods_s)):  # a DBC without a capture
            pair_s = 0.1
        yield from map(_comment, head)
        yield ""
        yield f"dbc = {_toml(dbc)}"
        yield (
            'temperature_source = "unknown"'
            "  # where the sensor is: cell, pack, coolant, room, unknown"
        )
        yield (
            f"pair_within_s = {pair_s:.3g}"
            "  # current and voltage at most this far apart make a sample [s]"
        )
        for role, signal in self.signals.items():
            yield ""
            yield from self._signal_lines(role, signal)
        if "temperature" not in self.chosen:
            yield ""
            yield (
                "# No temperature is known on this bus: a fixed one is assumed. Kt makes an error"
                " of some °C"
            )
            yield "# worth several % SoC: name a signal here when you find one."
            yield "[temperature]"
            yield f"fixed_c = {FALLBACK_C:g}"

    def _signal_lines(self, role: str, signal: Candidate) -> Iterator[str]:
        others = [each.name for each in self.candidates[role] if each is not signal]
        yield from map(_comment, signal.comments(self.nominal_v))
        if others:
            yield _comment(f"Else: {', '.join(others)}.")
        yield f"[{role}]"
        yield f"message = {_toml(signal.message)}"
        yield f"signal = {_toml(signal.signal)}"
        if role == "current":
            way = "positive current discharges" if signal.sign > 0 else "negative discharges"
            yield f"sign = {signal.sign}  # {way if self.is_sign_proven else 'not proven'}"
        if isinstance(signal, NamedSignal) and signal.is_wrapped:
            yield "signed = true  # the DBC reads negative values as large ones"
        if isinstance(signal, NamedSignal) and signal.not_available:
            yield f"not_available = {list(signal.not_available)}  # at an end of its codes"

    def _config_lines(
        self, interface: str | None, channel: str | None, bus_options: Mapping[str, object]
    ) -> Iterator[str]:
        """Yield the lines of a configuration of the service; without a bus, it is a comment."""
        use = "`cangauge run --config THIS_FILE`"
        yield f"# Configuration of {use}; `python -m cangauge.service.config` prints all keys."
        yield ""
        yield "# The voltage model of the pack: make it of your own drives, such as"
        yield f"# cangauge fit drive.log {self.reading(Path())} -o model.json"
        yield 'model = "model.json"'
        yield ""
        if self.vehicle is None:
            yield 'map = "car.toml"'
        else:
            yield f'vehicle = "{self.vehicle}"  # recognised by its ids and CRC'
            if self.fixed_c is not None:
                yield f"temperature = {self.fixed_c:g}  # assumed: not known on this bus [°C]"
        shown = "" if interface else "# "
        yield ""
        yield f"{shown}interface = {_toml(interface or 'socketcan')}"
        yield f"{shown}channel = {_toml(channel or 'can0')}"
        yield ""
        same = "`cangauge estimate` gives the same"
        yield f'# record = "drive.log"  # keep the received frames: {same}'
        yield '# state = "state.json"  # keep the SoC over restarts'
        yield ""
        if bus_options:
            yield "[bus_options]"
            yield from (f"{key} = {_toml(value)}" for key, value in bus_options.items())
            yield ""


def _toml(value: object) -> str:
    """Return a text, or a plain value, as TOML writes it."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _comment(text: str) -> str:
    """Return a text as a comment, on one line whatever names it holds."""
    return f"# {' '.join(printable(text).splitlines())}"


def _dbc_text(chosen: Sequence[SignalCandidate]) -> str:
    """Return a DBC with the chosen fields."""
    lines = ['VERSION "1"', "", "NS_ :", "", "BS_:", "", "BU_: Vehicle", ""]
    by_id: dict[int, list[SignalCandidate]] = {}
    for each in chosen:
        key = each.stream.arbitration_id | (EXTENDED if each.stream.is_extended else 0)
        by_id.setdefault(key, []).append(each)
    values, cycles = [], []
    for key, own in by_id.items():
        lines.append(f"BO_ {key} {own[0].message}: {own[0].stream.length} Vehicle")
        selector = next((each.stream.selector for each in own if each.stream.selector), None)
        if selector is not None:
            start = 8 * (selector.first // 8) + 7 - selector.first % 8
            lines.append(f' SG_ selector M : {start}|{selector.width}@0+ (1,0) [0|0] "" Vehicle')
        for each in own:
            mark = "" if each.stream.selector is None else f" m{each.stream.selector.value}"
            unit = SIGNALS[each.role][1].replace("°", "deg")
            lines.append(
                f" SG_ {each.signal}{mark} : {each.bits_text}"
                f' ({each.scale:.10g},{each.offset + 0.0:.10g}) [0|0] "{unit}" Vehicle'
            )
            if each.not_available is not None:
                values.append(f'VAL_ {key} {each.signal} {each.not_available} "not available" ;')
        lines.append("")
        period_ms = max(round(1e3 * own[0].stream.period_s), 1)
        cycles.append(f'BA_ "GenMsgCycleTime" BO_ {key} {period_ms};')
    lines += ['BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    return "\n".join([*lines, *cycles, "", *values, ""])
