"""`cangauge init`: from a capture or a live bus to a map and a configuration."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from cangauge._files import check_writable, write_texts_atomic
from cangauge._resources import shared_file
from cangauge.cli.config_options import BusOptionOption, ChannelOption, InterfaceOption
from cangauge.cli.options import JsonOption, within
from cangauge.cli.output import console, emit_json, note, print_table, progress_shown
from cangauge.errors import CangaugeError, InputError

if TYPE_CHECKING:
    import can

    from cangauge.extras.discovery.by_name import NamedSignal
    from cangauge.extras.discovery.pairs import Candidate
    from cangauge.extras.discovery.proposal import Proposal
    from cangauge.extras.discovery.search import Findings

ROLES: Final = {
    "current": "current",
    "voltage": "voltage",
    "soc": "soc_reference",
    "temperature": "temperature",
}
"""Roles by their names on the command line."""
NEEDED: Final = ("current", "voltage")
CLEARLY_NAMED: Final = 1.0
"""Distance in score of the first signal of a DBC that makes it clear: one matching word."""
LONGEST_PAIR_S: Final = 1.0
NOMINAL_CELL_V: Final = 3.7
"""Nominal voltage of an oxide cell [V]: tells how many cells a scale would mean."""


def init_command(  # noqa: PLR0917 - typer fills the arguments by name
    captures: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[CAPTURE]…", help="Captures of one car, of a drive.", show_default=False
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder for car.toml and the others."),
    ] = None,
    map_file: Annotated[
        Path | None, typer.Option("--map", metavar="FILE", help="Map file to write.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Configuration to write.")
    ] = None,
    dbc: Annotated[
        Path | None,
        typer.Option("--dbc", metavar="FILE", help="DBC of the car: signals by name and unit."),
    ] = None,
    choose: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE=N", help="Take candidate N for current, voltage, soc or temperature."
        ),
    ] = None,
    nominal_voltage: Annotated[
        float | None,
        typer.Option(
            metavar="V",
            help="Voltage of the pack, nominal or as a meter shows it [V]: decides its scale.",
            show_default=False,
        ),
    ] = None,
    presets: Annotated[
        bool, typer.Option("--presets/--no-presets", help="Look for known vehicles.")
    ] = True,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    bus_option: BusOptionOption = None,
    seconds: Annotated[
        float, typer.Option(metavar="S", help="Time to listen to a live bus [s].")
    ] = 60.0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Find the car's signals, prove them against each other, and write a map and a configuration.

    From captures, or from a live bus that it listens to. Known vehicles are recognised by ids and
    CRC; with --dbc, signals are found by name and unit; without either, by physics: current and
    voltage are the pair of fields that follows ΔU = −R·ΔI. Record while driving: a parked car
    has no current. Where the first of three candidates is not clearly ahead it asks, on a
    terminal; elsewhere it exits with 1, names the three, and --choose decides.

    Examples
    --------
    `cangauge init drive.log -o mycar`

    `cangauge init --interface socketcan --channel can0 --seconds 120 -o mycar`

    `cangauge init drive.log --dbc car.dbc --map car.toml --config run.toml`

    `cangauge init drive.log --choose current=2 -o mycar`
    """
    from cangauge.bus.open import bus_address, parse_bus_options

    picks = _picks(choose or [])
    within(seconds, 1.0, 86400.0, option="--seconds", unit="s")
    if nominal_voltage is not None:
        within(nominal_voltage, 10.0, 1500.0, option="--nominal-voltage", unit="V")
    targets = _Targets.of(output, map_file, config)
    targets.check(force=force)
    with tempfile.TemporaryDirectory(prefix="cangauge-init-") as folder:
        paths = list(captures or [])
        is_live = interface is not None or channel is not None
        if is_live and paths:
            raise InputError("given together with a capture", field="--interface", cure="omit one")
        if is_live:
            options = parse_bus_options(bus_option or [])
            address = bus_address(interface, channel, options)
            paths = [_listen(address, seconds, Path(folder) / "live.log")]
        if not paths and dbc is None:
            raise InputError(
                "nothing to look at",
                field="CAPTURE",
                cure="give a capture, --interface and --channel, or --dbc FILE",
            )
        found = _find(
            paths,
            dbc,
            picks,
            targets,
            presets=presets,
            quiet=json_output,
            nominal_v=nominal_voltage,
        )
        bus_options = parse_bus_options(bus_option or [])
        files = found.files(targets, interface, channel, bus_options)
        found.proof = _prove(files, targets, paths, Path(folder), found)
        if found.proof.get("sign", {}).get("sign") == -1 and found.method == "dbc":
            found.sign = -1
        if found.method == "dbc":  # the map says how its sign was found
            files = found.files(targets, interface, channel, bus_options)
            found.proof |= {"sign": found.proof.get("sign", {}) | {"in_map": found.sign}}
    targets.map.parent.mkdir(exist_ok=True)
    write_texts_atomic(files)
    if json_output:
        emit_json({**found.to_dict(), "files": [str(path) for path in files]})
        return
    _show(found)
    for path in files:
        note(f"wrote {path}")
    note(
        f"next: cangauge inspect DRIVE --map {targets.map}, then cangauge fit DRIVE … -o model.json"
    )


@dataclass(frozen=True)
class _Targets:
    """Files to write."""

    map: Path
    config: Path
    dbc: Path

    @classmethod
    def of(cls, folder: Path | None, map_file: Path | None, config: Path | None) -> _Targets:
        if folder is not None:
            if map_file is not None or config is not None:
                raise InputError("given together with -o", field="--map/--config", cure="omit one")
            return cls(folder / "car.toml", folder / "run.toml", folder / "car.dbc")
        if map_file is None or config is None:
            raise InputError(
                "no place for the files",
                field="-o",
                cure="give -o DIR, or --map FILE --config FILE",
            )
        return cls(map_file, config, map_file.parent / f"{map_file.stem or 'car'}.dbc")

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
    """What was found, and how."""

    method: str
    vehicle: str | None = None
    findings: Findings | None = None
    named: Mapping[str, Sequence[NamedSignal]] = field(default_factory=dict)
    chosen: dict[str, int] = field(default_factory=dict)
    dbc: Path | None = None
    nominal_v: float | None = None
    sign: int = 1
    """Sign of the current in the map, where the DBC names it: -1 where positive values charge."""
    proof: dict[str, Any] = field(default_factory=dict)

    def levels(self) -> list[tuple[float, float]]:
        """Return usual scales of the chosen voltage and the pack's voltage [V] by each.

        One pair where the scale is known: by a DBC, a preset or the nominal voltage.
        """
        from cangauge.extras.discovery.proposal import voltage_levels

        if self.findings is None or self.nominal_v is not None or "voltage" not in self.chosen:
            return []
        return voltage_levels(self.findings.voltage[self.chosen["voltage"]])

    def is_proven(self, role: str) -> bool:
        """Whether nothing that the data leave open changes the values of a chosen signal."""
        if role == "voltage":
            return len(self.levels()) < 2
        if role == "current":
            return self.findings is None and self.proof.get("sign", {}).get("sign", 0) != 0
        return True

    def candidates(self, role: str) -> Sequence[Candidate | NamedSignal]:
        """Return the candidates of a role."""
        if self.findings is not None:
            return tuple(getattr(self.findings, role))
        return tuple(self.named.get(role, ()))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "method": self.method,
            "vehicle": self.vehicle,
            "chosen": {role: number + 1 for role, number in self.chosen.items()},
            "candidates": {
                role: [each.to_dict() for each in self.candidates(role)] for role in ROLES.values()
            },
            "remarks": [] if self.findings is None else list(self.findings.remarks),
            "voltage_levels": [
                {"scale": scale, "voltage_v": volts} for scale, volts in self.levels()
            ],
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
        from cangauge.extras.discovery.pairs import Candidate
        from cangauge.extras.discovery.proposal import config_text, dbc_text, map_text, mapped

        texts = {}
        if self.vehicle is not None:
            preset = PRESETS[self.vehicle]
            texts[targets.dbc] = shared_file("dbc", preset.dbc).read_text("utf-8")
            comments = (f"{preset.about}: recognised by its ids and CRC.",)
            proposal = mapped(preset.mapping, targets.dbc.name, comments)
        elif self.findings is not None:
            chosen = {role: self.candidates(role)[number] for role, number in self.chosen.items()}
            fields = {role: each for role, each in chosen.items() if isinstance(each, Candidate)}
            texts[targets.dbc] = dbc_text(fields)
            proposal = _by_physics(fields, self.findings, targets.dbc.name, self.nominal_v)
        else:
            proposal = self._by_name(targets)
        texts[targets.map] = map_text(proposal)
        lacks = self.vehicle is not None and PRESETS[self.vehicle].lacks_temperature
        texts[targets.config] = config_text(
            vehicle=None if lacks else self.vehicle,
            map_name=targets.map.name,
            interface=interface,
            channel=channel,
            bus_options=bus_options,
        )
        return texts

    @property
    def sign_line(self) -> str:
        """How the sign of the current was found, or what is left to do."""
        sign = self.proof.get("sign", {})
        if sign.get("sign", 0) == 0:
            return "Sign of the current: not proven; `cangauge inspect DRIVE --map FILE` proves it."
        if self.sign < 0:
            return f"Sign of the current: positive values charge on this bus ({sign['text']})."
        return f"Sign of the current: positive discharges ({sign['text']})."

    def _by_name(self, targets: _Targets) -> Proposal:
        from cangauge.extras.discovery.proposal import Assignment, Proposal

        roles = {}
        for role, number in self.chosen.items():
            each = self.named[role][number]
            seen = "not in the capture"
            if each.low is not None:
                seen = f"{each.low:g} … {each.high:g} {each.unit} in the capture"
            others = [one.name for one in self.named[role] if one is not each]
            lines = [f"By name and unit: {seen}."]
            if others:
                lines.append(f"Else: {', '.join(others)}.")
            sign = self.sign if role == "current" else 1
            roles[role] = Assignment(each.message, each.signal, sign, tuple(lines))
        dbc = Path() if self.dbc is None else self.dbc.resolve()
        same = dbc.parent == targets.map.parent.resolve()
        return Proposal(
            name=dbc.stem,
            dbc=dbc.name if same else str(dbc),
            roles=roles,
            comments=("Signals found by their names and units in the DBC.", self.sign_line),
            pair_within_s=0.1,
        )  # fmt: skip


def _by_physics(
    chosen: Mapping[str, Candidate], findings: Findings, dbc: str, nominal_v: float | None
) -> Proposal:
    from cangauge.extras.discovery.proposal import (
        SIGNALS,
        UNITS,
        Assignment,
        Proposal,
        message_name,
        scale_line,
    )

    roles = {}
    for role, each in chosen.items():
        unit = UNITS[role].replace("degC", "°C")
        lines = [f"{each.name}: {each.low:.5g} … {each.high:.5g} {unit}, {each.steps} steps."]
        if role in NEEDED:
            lines += [_physics_line(each), scale_line(role, each, nominal_v)]
        elif each.partner:
            lines.append(f"Falls with the charge (r = {each.correlation:.2f}): {each.partner}.")
        others = [one.name for one in getattr(findings, role) if one is not each]
        if others:
            lines.append(f"Else: {', '.join(others)}.")
        roles[role] = Assignment(message_name(each), SIGNALS[role], each.sign, tuple(lines))
    if "temperature" in roles:
        old = roles["temperature"]
        guess = "A guess by range and slowness alone: compare it with the car's display."
        roles["temperature"] = Assignment(old.message, old.signal, 1, (guess, *old.comments))
    hints = [f"{each.name} ({each.low:.3g} … {each.high:.3g} °C)" for each in findings.temperature]
    slowest = max(chosen[role].period_s for role in NEEDED)
    apart = chosen["current"].arbitration_id != chosen["voltage"].arbitration_id
    pair_s = min(max(0.020, 1.2 * slowest), LONGEST_PAIR_S) if apart else 0.020
    return Proposal(
        name="own car",
        dbc=dbc,
        roles=roles,
        comments=(
            f"Found by physics in {findings.duration_s:.0f} s of frames: {findings.fields} numbers"
            f" of {findings.streams} ids.",
            "The bits do not determine the factors: compare voltage and current with a",
            "meter or the car's display, and correct factor and offset in the DBC.",
            *findings.remarks,
            *([f"Slow and plausible as a temperature: {', '.join(hints)}."] if hints else []),
        ),
        pair_within_s=pair_s,
    )


def _physics_line(each: Candidate) -> str:
    if each.evidence < 1.0:
        return "By the look of its bits alone: no current steps that a voltage follows."
    one, two = each.halves_ohm
    return (
        f"ΔU = −R·ΔI with {each.partner}: R = {each.resistance_ohm:.3g} Ω, r = "
        f"{each.correlation:+.2f}; by halves of the capture {one:.3g} and {two:.3g} Ω."
    )


def _picks(given: Sequence[str]) -> dict[str, int]:
    """Return the number of the candidate by role, from 0."""
    picks = {}
    for text in given:
        role, _, number = text.partition("=")
        if role not in ROLES or not number.isdecimal() or not 1 <= int(number) <= 9:
            raise InputError(
                "not ROLE=N",
                field="--choose",
                value=text,
                cure=f"ROLE is {', '.join(ROLES)}; N counts from 1: --choose current=2",
            )
        picks[ROLES[role]] = int(number) - 1
    return picks


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

    end_s = None
    for path in paths:
        shift_s = None
        last_s = 0.0
        for message in open_capture(path):
            if shift_s is None:
                shift_s = 0.0 if end_s is None else end_s + BETWEEN_S - message.timestamp
            message.timestamp += shift_s
            last_s = message.timestamp
            yield message
        end_s = last_s


def _find(
    paths: Sequence[Path],
    dbc: Path | None,
    picks: dict[str, int],
    targets: _Targets,
    *,
    presets: bool,
    quiet: bool,
    nominal_v: float | None,
) -> _Found:
    from cangauge.bus.captures import open_capture
    from cangauge.extras.discovery.by_name import named_signals
    from cangauge.extras.discovery.search import search

    if dbc is not None:
        messages = chain.from_iterable(open_capture(path) for path in paths)
        found = _Found("dbc", named=named_signals(dbc, messages), dbc=dbc)
    else:
        if presets and (known := _known(paths)) is not None:
            return _Found("preset", vehicle=known)
        status = console.status("reading frames")
        with status, progress_shown("cangauge.extras.discovery", status.update):
            findings = search(_joined(paths), nominal_v)
            found = _Found("physics", findings=findings, nominal_v=nominal_v)
    _choose(found, picks, targets, quiet=quiet)
    if len(levels := found.levels()) > 1 and _asks(quiet=quiet):
        note(f"The bits do not tell the scale of the voltage: {_level_texts(levels)}.")
        volts = typer.prompt("Voltage of the pack [V]?", type=float, default=levels[0][1], err=True)
        within(volts, 10.0, 1500.0, option="--nominal-voltage", unit="V")
        return _find(paths, dbc, picks, targets, presets=presets, quiet=quiet, nominal_v=volts)
    return found


def _asks(*, quiet: bool) -> bool:
    """Whether a user at a terminal can be asked."""
    return sys.stdin is not None and sys.stdin.isatty() and not quiet


def _known(paths: Sequence[Path]) -> str | None:
    """Return the preset that matches all captures; None without."""
    from cangauge.inspect.capture import inspect_capture

    matching = [set(inspect_capture(path).matching) for path in paths]
    common = sorted(set.intersection(*matching)) if matching else []
    if len(common) > 1:
        note(f"several presets match ({', '.join(common)}): none is taken")
    return common[0] if len(common) == 1 else None


def _choose(  # noqa: C901 - one rule after the other
    found: _Found, picks: dict[str, int], targets: _Targets, *, quiet: bool
) -> None:
    """Choose a candidate for each role: the user's, the clear one, or by asking."""
    asks = _asks(quiet=quiet)
    unclear = []
    for name, role in ROLES.items():
        candidates = found.candidates(role)
        if role in picks:
            if picks[role] >= len(candidates):
                raise InputError(
                    f"there are {len(candidates)} candidates",
                    field="--choose",
                    value=f"{name}={picks[role] + 1}",
                )
            found.chosen[role] = picks[role]
        elif not candidates:
            if role in NEEDED:
                unclear.append(role)
        elif role == "temperature" and found.findings is not None:
            continue  # slow and plausible is not enough: the user chooses it, or none
        elif role not in NEEDED or _is_clear(found, role):
            found.chosen[role] = 0
        elif asks:
            _show_role(found, role)
            found.chosen[role] = (
                typer.prompt(f"Which is the {role}?", type=int, default=1, err=True) - 1
            )
            if not 0 <= found.chosen[role] < len(candidates):
                raise InputError("no such candidate", field=role, value=found.chosen[role] + 1)
        else:
            unclear.append(role)
    if not unclear:
        return
    if not quiet:
        _show(found)
    remarks = () if found.findings is None else found.findings.remarks
    lines = [
        f"{role}: {len(found.candidates(role))} candidates, none clearly ahead"
        + "".join(f"; {n}) {each.name}" for n, each in enumerate(found.candidates(role), 1))
        for role in unclear
    ]
    raise CangaugeError(
        f"{'; '.join([*lines, *remarks])}; nothing was written to {targets.map.parent}: choose by"
        f" {' '.join(f'--choose {role}=1' for role in unclear)}, or record a drive with current"
        " steps"
    )


def _is_clear(found: _Found, role: str) -> bool:
    if found.findings is not None:
        return found.findings.is_clear(role)
    scores = [each.score for each in found.candidates(role)]
    return len(scores) == 1 or scores[0] - scores[1] >= CLEARLY_NAMED


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
    if len(volts):
        log = Log(  # the sign needs no temperature
            samples.time_s[good], samples.current_a[good], volts, np.zeros(len(volts)),
            soc_pct=samples.soc_pct[good],
        )  # fmt: skip
        finding = sign_of_current(log)
        proof["sign"] = {
            "sign": finding.sign, "confidence": finding.confidence, "text": finding.strongest.text,
        }  # fmt: skip
    return proof


def _show(found: _Found) -> None:
    from cangauge.bus.vehicle import PRESETS

    if found.vehicle is not None:
        about = PRESETS[found.vehicle].about
        print_table("Known vehicle", ["preset", "<about"], [[found.vehicle, about]])
    for role in ROLES.values():
        if found.candidates(role):
            _show_role(found, role)
    if found.findings is not None:
        for remark in found.findings.remarks:
            note(f"note: {remark}")
    if found.proof.get("samples"):
        amps, volts = found.proof["current_a"], found.proof["voltage_v"]
        shown = "no voltage" if volts is None else f"{volts[0]:g} … {volts[1]:g} V"
        note(f"decoded: {found.proof['samples']} samples, {amps[0]:g} … {amps[1]:g} A, {shown}")
    if found.findings is None:
        note(_sign_note(found))
    if len(levels := found.levels()) > 1:
        note(
            f"note: the bits do not tell the scale of the voltage: {_level_texts(levels)}."
            " Give --nominal-voltage V (type plate, or a meter)."
        )


def _sign_note(found: _Found) -> str:
    sign = found.proof.get("sign", {})
    if found.method == "preset" and sign.get("sign") == -1:
        return (
            f"warning: by this preset positive current charges ({sign['text']}): is it another car,"
            " or a converter that turns the sign? Set sign under [current] of the map."
        )
    if sign.get("sign", 0) == 0:
        return f"warning: {found.sign_line[0].lower()}{found.sign_line[1:]}"
    return f"{found.sign_line} The map has sign = {found.sign}."


def _level_texts(levels: Sequence[tuple[float, float]]) -> str:
    return ", ".join(
        f"{volts:.0f} V at {scale:g} V a step (about {round(volts / NOMINAL_CELL_V)} cells)"
        for scale, volts in levels
    )


def _show_role(found: _Found, role: str) -> None:
    from cangauge.extras.discovery.pairs import Candidate
    from cangauge.extras.discovery.proposal import UNITS

    rows = []
    for number, each in enumerate(found.candidates(role), 1):
        taken = "✓" if found.is_proven(role) else "?"
        mark = f"{number} {taken}" if found.chosen.get(role) == number - 1 else str(number)
        if isinstance(each, Candidate):
            rows.append([
                mark, each.name, f"{each.scale:g}",
                f"{each.low:.5g} … {each.high:.5g} {UNITS[role]}",
                str(each.steps), f"{each.score:.1f}", _facts(each),
            ])  # fmt: skip
        else:
            seen = "" if each.low is None else f"{each.low:.5g} … {each.high:.5g} {each.unit}"
            rows.append([mark, each.name, "", seen, "", f"{each.score:.1f}", "by name and unit"])
    head = ["", "<field", "scale", "range", "steps", "score", "<evidence"]
    print_table(role.replace("_reference", ""), head, rows)


def _facts(each: Candidate) -> str:
    if each.evidence <= 0.0:
        return "the look of its bits"
    if each.resistance_ohm != each.resistance_ohm:
        return f"r {each.correlation:+.2f} with the charge, {each.partner}"
    return (
        f"r {each.correlation:+.2f} with {each.partner}, R {each.resistance_ohm:.3g} Ω"
        f" ({each.halves_ohm[0]:.2g}, {each.halves_ohm[1]:.2g} by halves)"
    )
