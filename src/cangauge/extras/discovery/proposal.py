"""What `cangauge init` found, and the files that it writes: DBC, map and configuration."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from can.interfaces.socketcan.constants import CAN_EFF_FLAG

from cangauge._text import printable
from cangauge.bus.vehicle import PRESETS
from cangauge.extras.discovery.candidate import ROLES, Candidate, Level, short_name

FALLBACK_C: Final = 20.0
"""Temperature of a map without one [°C]: the reference temperature of the voltage model."""


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
    has_steps : bool
        Whether a voltage of the captures follows a current.
    chosen : dict of str to int
        Number of the candidate by role, from 0.
    proof : dict
        What the captures show when they are decoded with the files.
    """

    method: Literal["preset", "dbc", "physics"]
    candidates: dict[str, list[Candidate]] = field(default_factory=dict)
    clear: Collection[str] = ()
    head: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    vehicle: str | None = None
    dbc: Path | None = None
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
        lacks = "temperature" not in self.chosen
        if self.vehicle is not None:
            lacks = PRESETS[self.vehicle].lacks_temperature
        return FALLBACK_C if lacks else None

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
            f"{short_name(role)} {signal.name}{' (?)' * self.is_open(role)}"
            for role, signal in self.signals.items()
        ]
        way = "names" if self.method == "dbc" else "physics"
        return f"Found by {way}: {', '.join(found)}"

    def is_open(self, role: str) -> bool:
        """Whether the captures leave something of a chosen signal open."""
        is_proven = True
        if role == "current":
            is_proven = self.method != "physics" and self.is_sign_proven
        elif role == "soc_reference":
            is_proven = bool(self.proof.get("soc", {}).get("agrees"))
        return bool(self.levels(role)) or not is_proven

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

    def levels(self, role: str) -> tuple[Level, ...]:
        """Return what usual scales of a chosen field mean; empty where its scale is certain."""
        return self.signals[role].levels if role in self.chosen else ()

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
        texts = {"run.toml": self._config(**bus)}
        if self.vehicle is None:
            maps = {} if self.dbc is not None else {"car.dbc": _dbc_text([*self.signals.values()])}
            texts = {**maps, "car.toml": "\n".join([*self._map_lines(folder), ""]), **texts}
        return texts

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        volts, socs = self.levels("voltage"), self.levels("soc_reference")
        return {
            "method": self.method,
            "vehicle": self.vehicle,
            "chosen": {role: number + 1 for role, number in self.chosen.items()},
            "candidates": {
                role: [each.to_dict() for each in self.candidates.get(role, ())] for role in ROLES
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
            if role not in self.chosen and (found := self.candidates.get(role)):
                named = ", ".join(f"{each.name} ({each.range_text})" for each in found)
                head = (*head, f"Not clear, so not used, {ROLES[role].column}: {named}.")
        period_s = max(self.signals[role].period_s for role in ("current", "voltage"))
        # A DBC without a capture has no periods.
        pair_s = 0.1 if math.isnan(period_s) else min(max(0.02, 1.2 * period_s), 1.0)
        yield from map(_comment, head)
        yield f"""
dbc = {_toml(dbc)}
temperature_source = "unknown"  # where the sensor is: cell, pack, coolant, room, unknown
pair_within_s = {pair_s:.3g}  # current and voltage at most this far apart make a sample [s]"""
        for role, signal in self.signals.items():
            yield ""
            yield from self._signal_lines(role, signal)
        if "temperature" not in self.chosen:
            yield f"""
# No temperature is known on this bus: a fixed one is assumed. Kt makes an error of some °C
# worth several % SoC: name a signal here when you find one.
[temperature]
fixed_c = {FALLBACK_C:g}"""

    def _signal_lines(self, role: str, signal: Candidate) -> Iterator[str]:
        others = [each.name for each in self.candidates[role] if each is not signal]
        yield from map(_comment, signal.comments())
        if others:
            yield _comment(f"Else: {', '.join(others)}.")
        yield f"[{role}]"
        yield f"message = {_toml(signal.message)}"
        yield f"signal = {_toml(signal.signal)}"
        if role == "current":
            way = "positive current discharges" if signal.sign > 0 else "negative discharges"
            yield f"sign = {signal.sign}  # {way if self.is_sign_proven else 'not proven'}"
        if signal.is_wrapped:
            yield "signed = true  # the DBC reads negative values as large ones"
        if signal.not_available and self.dbc is not None:
            yield f"not_available = {list(signal.not_available)}  # at an end of its codes"

    def _config(
        self, interface: str | None, channel: str | None, bus_options: Mapping[str, object]
    ) -> str:
        """Return a configuration of the service; without a bus, it is a comment."""
        car = 'map = "car.toml"'
        if self.vehicle is not None:
            car = f'vehicle = "{self.vehicle}"  # recognised by its ids and CRC'
            if self.fixed_c is not None:
                car += f"\ntemperature = {self.fixed_c:g}  # assumed: not known on this bus [°C]"
        shown = "" if interface else "# "
        options = [f"{key} = {_toml(value)}\n" for key, value in bus_options.items()]
        if options:
            options = ["[bus_options]\n", *options, "\n"]
        return f"""\
# Configuration of `cangauge run --config THIS_FILE`; \
`python -m cangauge.service.config` prints all keys.

# The voltage model of the pack: make it of your own drives, such as
# cangauge fit drive.log {self.reading(Path())} -o model.json
model = "model.json"

{car}

{shown}interface = {_toml(interface or "socketcan")}
{shown}channel = {_toml(channel or "can0")}

# record = "drive.log"  # keep the received frames: `cangauge estimate` gives the same
# state = "state.json"  # keep the SoC over restarts

{"".join(options)}"""


def _toml(value: object) -> str:
    """Return a text, or a plain value, as TOML writes it."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _comment(text: str) -> str:
    """Return a text as a comment, on one line whatever names it holds."""
    return f"# {' '.join(printable(text).splitlines())}"


def _dbc_text(chosen: Sequence[Candidate]) -> str:
    """Return a DBC with the chosen fields."""
    messages: dict[str, list[str]] = {}
    values, cycles = [], []
    for each in chosen:
        of, place = each.stream, each.place
        if of is None or place is None:
            continue
        key = of.arbitration_id | (CAN_EFF_FLAG if of.is_extended else 0)
        head = f"BO_ {key} {each.message}: {of.length} Vehicle"
        mark = ""
        if (selector := of.selector) is not None:
            mark = f" m{of.selected}"
            bits = selector.text(of.length)
            head += f'\n SG_ selector M : {bits} (1,0) [0|0] "" Vehicle'
        if head not in messages:
            period_ms = max(round(1e3 * of.period_s), 1)
            cycles.append(f'BA_ "GenMsgCycleTime" BO_ {key} {period_ms};')
        messages.setdefault(head, []).append(
            f" SG_ {each.signal}{mark} : {place.text(of.length)}"
            f" ({each.scale:.10g},{each.offset + 0.0:.10g}) [0|0]"
            f' "{each.unit.replace("°", "deg")}" Vehicle'
        )
        values += [
            f'VAL_ {key} {each.signal} {code} "not available" ;' for code in each.not_available
        ]
    lines = ['VERSION "1"\n\nNS_ :\n\nBS_:\n\nBU_: Vehicle\n']
    for head, signals in messages.items():
        lines += [head, *signals, ""]
    lines += ['BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    return "\n".join([*lines, *cycles, "", *values, ""])
