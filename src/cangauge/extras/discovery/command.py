"""`cangauge init`: from a capture or a live bus to a map and a configuration."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from cangauge._files import check_writable, write_texts_atomic
from cangauge._resources import shared_file
from cangauge.cli.config_options import config_parameters, config_values
from cangauge.cli.declare import command, within
from cangauge.cli.output import console, emit_json, note, print_table, progress_shown
from cangauge.errors import CangaugeError, InputError

if TYPE_CHECKING:
    import can

    from cangauge.extras.discovery.by_name import NamedSignal
    from cangauge.extras.discovery.pairs import SignalCandidate
    from cangauge.extras.discovery.proposal import Level, Proposal
    from cangauge.extras.discovery.search import Findings

_ROLES: Final = {
    "current": "current",
    "voltage": "voltage",
    "soc": "soc_reference",
    "temperature": "temperature",
}
"""Roles by their names on the command line."""
_NEEDED: Final = ("current", "voltage")
_CLEARLY_NAMED: Final = 1.0
"""Distance in score of the first signal of a DBC that makes it clear: one matching word."""


@command(keys=lambda: config_parameters("interface", "channel", "bus_options"))
def init_command(
    captures: list[Path] | None = None,
    *,
    output: Path,
    dbc: Path | None = None,
    choose: list[str] | None = None,
    nominal_voltage: float | None = None,
    presets: bool = True,
    seconds: float = 60.0,
    force: bool = False,
    json_output: bool = False,
    **options: Any,
) -> None:
    """Find the car's signals, check them against each other, and write a map and a configuration.

    From captures, or from a live bus that it listens to. Known vehicles are recognised by ids and
    CRC; with --dbc, signals are found by name and unit; without either, by physics: current and
    voltage are the pair of fields that follows ΔU = −R·ΔI. Record while driving: a parked car
    has no current. Where the first of three candidates is not clearly ahead it asks, on a
    terminal; elsewhere it exits with 1, names the three, and --choose decides.

    Examples
    --------
    `cangauge init drive.log -o mycar`

    `cangauge init --interface socketcan --channel can0 --seconds 120 -o mycar`

    `cangauge init drive.log --dbc car.dbc -o mycar`

    `cangauge init drive.log --choose current=2 -o mycar`

    Parameters
    ----------
    captures : [CAPTURE]…
        Captures of one car, of a drive.
    output : -o, --output DIR
        Folder for car.toml and the others.
    dbc : FILE
        DBC of the car: signals by name and unit.
    choose : ROLE=N
        Take candidate N for current, voltage, soc or temperature.
    nominal_voltage : V (10 … 1500 V)
        Voltage of the pack, nominal or as a meter shows it: decides its scale.
    presets : --presets/--no-presets
        Look for known vehicles.
    seconds : S (1 … 86400 s)
        Time to listen to a live bus.
    force : --force
        Overwrite existing files.
    """
    from cangauge.bus.open import bus_address

    picks = _picks(choose or [])
    targets = _Targets(output / "car.toml", output / "run.toml", output / "car.dbc")
    targets.check(force=force)
    values = config_values(options)
    interface, channel, bus_options = (
        values[name] for name in ("interface", "channel", "bus_options")
    )
    with tempfile.TemporaryDirectory(prefix="cangauge-init-") as folder:
        paths = list(captures or [])
        is_live = interface is not None or channel is not None
        if is_live and paths:
            raise InputError("given together with a capture", field="--interface", cure="omit one")
        if is_live:
            address = bus_address(interface, channel, bus_options)
            paths = [_listen(address, seconds, Path(folder) / "live.log")]
        if not paths and dbc is None:
            cure = "give a capture, --interface and --channel, or --dbc FILE"
            raise InputError("nothing to look at", field="CAPTURE", cure=cure)
        asks = sys.stdin is not None and sys.stdin.isatty() and not json_output
        found = _find(paths, dbc, nominal_voltage, presets=presets)
        _choose(found, picks, targets, asks=asks, quiet=json_output)
        if asks:
            found = _ask_scales(found, paths)
        files = found.files(targets, interface, channel, bus_options)
        found.proof = _prove(files, targets, paths, Path(folder), found)
        if found.method == "dbc":  # the map says how its sign was found
            found.sign = -1 if found.proven_sign == -1 else 1
            files = found.files(targets, interface, channel, bus_options)
            found.proof |= {"sign": found.proof.get("sign", {}) | {"in_map": found.sign}}
            if paths:
                found.proof["current_a"] = sorted(found.sign * a for a in found.proof["current_a"])
    targets.map.parent.mkdir(exist_ok=True)
    write_texts_atomic(files)
    if json_output:
        emit_json({**found.to_dict(), "files": [str(path) for path in files]})
        return
    _show(found)
    _show_proof(found, paths)
    for path in files:
        note(f"wrote {path}")
    note(
        f"next: cangauge inspect DRIVE --map {targets.map}, then cangauge fit DRIVE …"
        f" --map {targets.map} -o {targets.config.parent / 'model.json'}"
    )


def _picks(given: Sequence[str]) -> dict[str, int]:
    """Return the number of the candidate by role, from 0."""
    picks = {}
    for text in given:
        role, _, number = text.partition("=")
        if role not in _ROLES or not number.isdecimal() or not 1 <= int(number) <= 9:
            cure = f"ROLE is {', '.join(_ROLES)}; N counts from 1: --choose current=2"
            raise InputError("not ROLE=N", field="--choose", value=text, cure=cure)
        picks[_ROLES[role]] = int(number) - 1
    return picks


@dataclass(frozen=True)
class _Targets:
    """Files to write."""

    map: Path
    config: Path
    dbc: Path

    def check(self, *, force: bool) -> None:
        """Raise InputError if a file exists, or cannot be written."""
        for path in (self.map, self.config, self.dbc):
            # Of os.path: False for a name that no file can have.
            if os.path.isfile(path) and not force:  # noqa: PTH113
                raise InputError("exists", source=path, cure="give --force to overwrite it")
        for path in (self.map, self.config):
            if os.path.isdir(path.parent):  # noqa: PTH112
                check_writable(path)
            elif not os.path.isdir(path.parent.parent):  # noqa: PTH112
                raise InputError("cannot create this folder", source=path.parent)


@dataclass
class _Found:
    """What was found, and how.

    `sign` is that of the current in the map, where a DBC names it: -1 where positive values charge.
    """

    method: str
    vehicle: str | None = None
    findings: Findings | None = None
    candidates: Mapping[str, Sequence[SignalCandidate | NamedSignal]] = field(default_factory=dict)
    chosen: dict[str, int] = field(default_factory=dict)
    dbc: Path | None = None
    nominal_v: float | None = None
    sign: int = 1
    proof: dict[str, Any] = field(default_factory=dict)
    known_scales: set[str] = field(default_factory=set)
    """Roles whose scale the user has stated."""

    @property
    def fields(self) -> dict[str, SignalCandidate]:
        """Chosen fields that were found by physics, by role."""
        if self.findings is None:
            return {}
        return {role: self.candidates[role][k] for role, k in self.chosen.items()}  # type: ignore[misc]

    @property
    def proven_sign(self) -> int:
        """What the captures show of the sign of current by the files: +1, -1, or 0 if nothing."""
        return int(self.proof.get("sign", {}).get("sign", 0))

    def levels(self, role: str) -> list[Level]:
        """Return what usual scales of a chosen field mean; empty where the scale is known."""
        from cangauge.extras.discovery.proposal import levels

        if role not in self.fields or role in self.known_scales:
            return []
        found = levels(role, self.fields[role], self.nominal_v)
        return found if len(found) > 1 else []

    def is_proven(self, role: str) -> bool:
        """Whether nothing that the data leave open changes the values of a chosen signal."""
        if role == "current":
            return self.findings is None and self.proven_sign != 0
        return not self.levels(role)

    def is_clear(self, role: str) -> bool:
        """Whether the first candidate is clearly ahead of the others."""
        if self.findings is not None:
            return self.findings.is_clear(role)
        scores = [candidate.score for candidate in self.candidates[role]]
        return len(scores) == 1 or scores[0] - scores[1] >= _CLEARLY_NAMED

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        volts, socs = self.levels("voltage"), self.levels("soc_reference")
        return {
            "method": self.method,
            "vehicle": self.vehicle,
            "chosen": {role: number + 1 for role, number in self.chosen.items()},
            "candidates": {
                role: [candidate.to_dict() for candidate in self.candidates.get(role, ())]
                for role in _ROLES.values()
            },
            "remarks": [] if self.findings is None else list(self.findings.remarks),
            "voltage_levels": [{"scale": each.scale, "voltage_v": each.value} for each in volts],
            "soc_levels": [{"scale": each.scale, "highest_pct": each.value} for each in socs],
            "proof": self.proof,
        }

    def files(
        self,
        targets: _Targets,
        interface: str | None,
        channel: str | None,
        bus_options: Mapping[str, object],
    ) -> dict[Path, str]:
        """Return the texts by file."""
        from cangauge.bus.vehicle import PRESETS
        from cangauge.extras.discovery import proposal

        texts = {}
        if self.vehicle is not None:
            preset = PRESETS[self.vehicle]
            texts[targets.dbc] = shared_file("dbc", preset.dbc).read_text("utf-8")
            about = (f"{preset.about}: recognised by its ids and CRC.",)
            found = proposal.of_preset(preset.mapping, targets.dbc.name, about)
        elif self.findings is not None:
            texts[targets.dbc] = proposal.dbc_text(self.fields)
            names = {role: [c.name for c in each] for role, each in self.candidates.items()}
            found = proposal.by_physics(
                self.fields, names, targets.dbc.name, self.nominal_v, self.findings.comments
            )
        else:
            found = self._by_name(targets)
        texts[targets.map] = proposal.map_text(found)
        lacks = self.vehicle is not None and PRESETS[self.vehicle].lacks_temperature
        vehicle = None if lacks else self.vehicle
        texts[targets.config] = proposal.config_text(
            vehicle, targets.map.name, interface, channel, bus_options
        )
        return texts

    @property
    def sign_line(self) -> str:
        """How the sign of the current was found, or what is left to do."""
        if not self.proven_sign:
            return "Sign of the current: not proven; `cangauge inspect DRIVE --map FILE` proves it."
        way = "positive values charge on this bus" if self.sign < 0 else "positive discharges"
        return f"Sign of the current: {way}; {self.proof['sign']['text']}."

    @property
    def assumes_temperature(self) -> bool:
        """Whether the map has a fixed temperature."""
        from cangauge.bus.vehicle import PRESETS

        if self.vehicle is not None:
            return PRESETS[self.vehicle].lacks_temperature
        return "temperature" not in self.chosen

    def _by_name(self, targets: _Targets) -> Proposal:
        from cangauge.extras.discovery.proposal import Assignment, Proposal

        roles = {}
        for role, number in self.chosen.items():
            signal: NamedSignal = self.candidates[role][number]  # type: ignore[assignment]
            sign = self.sign if role == "current" else 1
            seen = signal.range_text(sign)
            others = [other.name for other in self.candidates[role] if other is not signal]
            lines = [f"By name and unit: {f'{seen} in' if seen else 'not in'} the capture."]
            lines += [f"Else: {', '.join(others)}."] if others else []
            roles[role] = Assignment(signal.message, signal.signal, sign, tuple(lines))
        dbc = Path() if self.dbc is None else self.dbc.resolve()
        same = dbc.parent == targets.map.parent.resolve()
        comments = ("Signals found by their names and units in the DBC.", self.sign_line)
        name = dbc.name if same else str(dbc)
        return Proposal(dbc.stem, name, roles, comments, pair_within_s=0.1)


# --- Finding and choosing


def _listen(address: Any, seconds: float, path: Path) -> Path:
    """Record a live bus to a file."""
    import can

    from cangauge.bus.connection import BusConnection
    from cangauge.bus.open import open_bus

    frames = 0
    with (
        BusConnection(open_bus(address), str(address)) as port,
        can.CanutilsLogWriter(path) as writer,
        console.status(f"listening on {address}") as status,
    ):
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0.0:
            for message in port.receive_pending(min(left_s, 0.1)):
                message.channel = message.channel or "can0"
                writer.on_message_received(message)
                frames += 1
            status.update(f"listening on {address}: {left_s:.0f} s left, {frames} frames")
    if not frames:
        raise InputError("no frame came", source=str(address), cure="is the car awake?")
    return path


def _joined(paths: Sequence[Path]) -> Iterator[can.Message]:
    """Yield the frames of captures, one after the other in time."""
    from cangauge.bus.captures import open_capture
    from cangauge.extras.discovery.search import BETWEEN_S

    next_s: float | None = None
    for path in paths:
        shift_s: float | None = None
        for message in open_capture(path):
            if shift_s is None:
                shift_s = 0.0 if next_s is None else next_s - message.timestamp
            message.timestamp += shift_s
            yield message
            last_s = message.timestamp
        next_s = None if shift_s is None else last_s + BETWEEN_S


def _find(
    paths: Sequence[Path], dbc: Path | None, nominal_v: float | None, *, presets: bool
) -> _Found:
    from cangauge.bus.captures import open_capture
    from cangauge.extras.discovery.by_name import named_signals
    from cangauge.extras.discovery.search import search

    if dbc is not None:
        messages = chain.from_iterable(open_capture(path) for path in paths)
        return _Found("dbc", candidates=named_signals(dbc, messages), dbc=dbc)
    if presets and (known := _known(paths)) is not None:
        return _Found("preset", vehicle=known)
    status = console.status("reading frames")
    with status, progress_shown("cangauge.extras.discovery", status.update):
        findings = search(_joined(paths), nominal_v)
    candidates = {role: getattr(findings, role) for role in _ROLES.values()}
    return _Found("physics", findings=findings, candidates=candidates, nominal_v=nominal_v)


def _known(paths: Sequence[Path]) -> str | None:
    """Return the preset that matches all captures; None without."""
    from cangauge.inspect.capture import inspect_capture

    matching = [set(inspect_capture(path).matching) for path in paths]
    common = sorted(set.intersection(*matching)) if matching else []
    if len(common) > 1:
        note(f"several presets match ({', '.join(common)}): none is taken")
    return common[0] if len(common) == 1 else None


def _choose(
    found: _Found, picks: dict[str, int], targets: _Targets, *, asks: bool, quiet: bool
) -> None:
    """Choose a candidate for each role: the user's, the clear one, or by asking."""
    unclear = []
    for name, role in () if found.method == "preset" else _ROLES.items():
        count = len(found.candidates[role])
        if role in picks:
            if picks[role] >= count:
                value = f"{name}={picks[role] + 1}"
                raise InputError(f"there are {count} candidates", field="--choose", value=value)
            found.chosen[role] = picks[role]
        elif role not in _NEEDED:
            # Slow and plausible is not enough: the user chooses a temperature, or none.
            if count and (role != "temperature" or found.findings is None):
                found.chosen[role] = 0
        elif count and found.is_clear(role):
            found.chosen[role] = 0
        elif count and asks:
            _show_role(found, role)
            pick = int(typer.prompt(f"Which is the {role}?", type=int, default=1, err=True))
            if not 1 <= pick <= count:
                raise InputError("no such candidate", field=role, value=pick)
            found.chosen[role] = pick - 1
        else:
            unclear.append(role)
    if unclear:
        raise _unclear(found, unclear, targets, quiet=quiet)


def _unclear(
    found: _Found, roles: Sequence[str], targets: _Targets, *, quiet: bool
) -> CangaugeError:
    """Return the error of roles without a clear candidate, after tables of them if not `quiet`."""
    lines = [f"no {' and no '.join(roles)} is clearly ahead of the others"]
    if found.findings is not None and found.nominal_v is None:
        lines.append("the scale of the voltage is open (--nominal-voltage V decides it)")
    if not quiet:
        _show(found)
    for role in roles if quiet else ():
        names = [f"{n}) {c.name}" for n, c in enumerate(found.candidates[role], 1)]
        lines.append(f"{role}: {', '.join(names)}")
    return CangaugeError(
        f"{'; '.join(lines)}; nothing was written to {targets.map.parent}: choose by"
        f" {' '.join(f'--choose {role}=1' for role in roles)}, or record a drive with current steps"
    )


def _ask_scales(found: _Found, paths: Sequence[Path]) -> _Found:
    """Return what was found with the scales of voltage and SoC that the user states."""
    if levels := found.levels("voltage"):
        note(_open_scale("voltage", levels))
        volts = typer.prompt(
            "Voltage of the pack [V]?", type=float, default=levels[0].value, err=True
        )
        within(volts, 10.0, 1500.0, option="--nominal-voltage", unit="V")
        again = _find(paths, None, volts, presets=False)
        found = replace(again, chosen=found.chosen)
    if levels := found.levels("soc_reference"):
        note(_open_scale("SoC", levels))
        question = "Highest SoC that the car showed in these captures [%]?"
        highest = typer.prompt(question, type=float, default=levels[0].value, err=True)
        nearest = min(levels, key=lambda level: abs(level.value - highest))
        old = found.fields["soc_reference"]
        new = old.rescaled(nearest.scale)
        of_role = [new if c is old else c for c in found.candidates["soc_reference"]]
        found.candidates = {**found.candidates, "soc_reference": of_role}
        found.known_scales.add("soc_reference")
    return found


def _prove(
    files: Mapping[Path, str],
    targets: _Targets,
    paths: Sequence[Path],
    folder: Path,
    found: _Found,
) -> dict[str, Any]:
    """Decode the captures by the files before they are saved; return what came out.

    Raises
    ------
    InputError
        If the files do not decode the captures.
    """
    from cangauge.bus.vehicle import Vehicle

    for path, text in files.items():
        (folder / path.name).write_text(text, encoding="utf-8")
    if found.dbc is not None:
        shutil.copy(found.dbc, folder / found.dbc.name)
    car = Vehicle.load(map=folder / targets.map.name)
    if not paths:
        return {}
    import numpy as np

    from cangauge.bus.recording import capture_samples
    from cangauge.logs.log import Log
    from cangauge.logs.sign import sign_of_current

    samples = capture_samples(paths[0], car)
    if len(samples) < 2:
        raise InputError(
            "current and voltage found do not make samples: their frames are too far apart",
            source=paths[0],
            cure="choose others by --choose",
        )
    good = np.isfinite(samples.voltage_v)
    good &= np.diff(samples.time_s, prepend=-np.inf) > 0.0
    volts = samples.voltage_v[good]
    proof: dict[str, Any] = {
        "samples": len(samples),
        "current_a": [float(samples.current_a.min()), float(samples.current_a.max())],
        "voltage_v": [float(volts.min()), float(volts.max())] if len(volts) else None,
    }
    if len(volts):  # the sign needs no temperature
        rows = (samples.time_s[good], samples.current_a[good], volts, np.zeros(len(volts)))
        finding = sign_of_current(Log(*rows, soc_pct=samples.soc_pct[good]))
        text, confidence = finding.strongest.text, finding.confidence
        proof["sign"] = {"sign": finding.sign, "confidence": confidence, "text": text}
    return proof


# --- What is shown


def _show(found: _Found) -> None:
    from cangauge.bus.vehicle import PRESETS

    if found.vehicle is not None:
        about = PRESETS[found.vehicle].about
        print_table("Known vehicle", ["preset", "about"], [[found.vehicle, about]])
    for role in _ROLES.values():
        if found.candidates.get(role):
            _show_role(found, role)
    for remark in () if found.findings is None else found.findings.remarks:
        note(f"note: {remark}")


def _show_proof(found: _Found, paths: Sequence[Path]) -> None:
    from cangauge.extras.discovery.pairs import range_text
    from cangauge.extras.discovery.proposal import FALLBACK_C

    if found.proof.get("samples"):
        amps, volts = found.proof["current_a"], found.proof["voltage_v"]
        of = f" of {paths[0].name}" if len(paths) > 1 else ""
        shown = "no voltage" if volts is None else range_text(volts[0], volts[1], "V")
        shown = f"{range_text(amps[0], amps[1], 'A')}, {shown}"
        note(f"decoded: {found.proof['samples']} samples{of}, {shown}")
    if found.findings is None:
        note(_sign_note(found))
    if found.assumes_temperature:
        note(
            f"note: no temperature was found or chosen: the map assumes {FALLBACK_C:g} °C"
            " (fixed_c); some °C of error are worth several % SoC"
        )
    if levels := found.levels("voltage"):
        cure = "Give --nominal-voltage V (type plate, or a meter)."
        note(f"note: {_open_scale('voltage', levels)} {cure}")
    if levels := found.levels("soc_reference"):
        cure = "Compare it with the car's display, and correct the factor in the DBC."
        note(f"note: {_open_scale('SoC', levels)} {cure}")


def _open_scale(quantity: str, levels: Sequence[Level]) -> str:
    texts = ", ".join(level.text for level in levels)
    return f"The bits do not tell the scale of the {quantity}: {texts}."


def _sign_note(found: _Found) -> str:
    if found.method == "preset" and found.proven_sign == -1:
        return (
            f"warning: by this preset positive current charges ({found.proof['sign']['text']}): is"
            " it another car, or a converter that turns the sign? Set sign under [current] of the"
            " map."
        )
    if not found.proven_sign:
        return f"warning: {found.sign_line[0].lower()}{found.sign_line[1:]}"
    return f"{found.sign_line} The map has sign = {found.sign}."


def _show_role(found: _Found, role: str) -> None:
    from cangauge.extras.discovery.pairs import SignalCandidate, range_text
    from cangauge.extras.discovery.proposal import UNITS

    rows = []
    title, head = (
        role.replace("_reference", ""),
        ["", "field", "scale", "range", "score", "evidence"],
    )
    if found.findings is None:
        title, head = f"{title}, by name and unit", ["", "signal", "range"]
    for number, candidate in enumerate(found.candidates[role], 1):
        taken = "✓" if found.is_proven(role) else "?"
        mark = f"{number} {taken}" if found.chosen.get(role) == number - 1 else str(number)
        if isinstance(candidate, SignalCandidate):
            ends = range_text(candidate.low, candidate.high, UNITS[role], candidate.sign)
            scale, score = f"{candidate.scale:g}", f"{candidate.score:.1f}"
            rows.append([mark, candidate.name, scale, ends, score, candidate.facts])
        else:
            ends = candidate.range_text(found.sign if role == "current" else 1)
            rows.append([mark, f"{candidate.message}\n{candidate.signal}", ends])
    print_table(title, head, rows)
