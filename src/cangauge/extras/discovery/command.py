"""`cangauge init`: from a capture or a live bus to a map and a configuration."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cangauge._files import check_writable, write_texts_atomic
from cangauge.cli.declare import command
from cangauge.cli.options import config_parameters, config_values
from cangauge.cli.output import finish, note, print_table, progress
from cangauge.errors import CangaugeError, InputError

if TYPE_CHECKING:
    import can

    from cangauge.extras.discovery.by_name import NamedSignal
    from cangauge.extras.discovery.candidate import Level, SignalCandidate

    Candidate = SignalCandidate | NamedSignal

_ROLES: Final = {
    "current": "current",
    "voltage": "voltage",
    "soc": "soc_reference",
    "temperature": "temperature",
}
"""Roles by their names on the command line."""
_NEEDED: Final = ("current", "voltage")


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
    has no current. Where the first of three candidates is not clearly ahead, it exits with 1 and
    names the three; --choose decides.

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
        Folder for run.toml and the others.
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
    picks = _picks(choose or [])
    _check(output, force=force)
    values = config_values(options)
    bus = {name: values[name] for name in ("interface", "channel", "bus_options")}
    with tempfile.TemporaryDirectory(prefix="cangauge-init-") as folder:
        paths = list(captures or [])
        if bus["interface"] is not None or bus["channel"] is not None:
            if paths:
                problem, cure = "given together with a capture", "omit one"
                raise InputError(problem, field="--interface", cure=cure)
            paths = [_listen(bus, seconds, Path(folder) / "live.log")]
        if not paths and dbc is None:
            cure = "give a capture, --interface and --channel, or --dbc FILE"
            raise InputError("nothing to look at", field="CAPTURE", cure=cure)
        found = _find(paths, dbc, nominal_voltage, presets=presets)
        _choose(found, picks, output, quiet=json_output)
        _prove(found, paths[:1], output, Path(folder), bus)
    texts = found.texts(output, bus)
    output.mkdir(exist_ok=True)
    write_texts_atomic({output / name: text for name, text in texts.items()})
    files = [str(output / name) for name in texts]

    def show() -> None:
        _show(found)
        _show_proof(found)
        for path in files:
            note(f"wrote {path}")
        reading = found.reading(output)
        note(
            f"next: cangauge inspect DRIVE {reading}, then cangauge fit DRIVE … {reading}"
            f" -o {output / 'model.json'}"
        )

    finish({**found.to_dict(), "files": files}, show, as_json=json_output)


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


def _check(output: Path, *, force: bool) -> None:
    """Raise InputError if a file exists in the folder, or cannot be written."""
    try:
        is_folder, has_parent = output.is_dir(), output.parent.is_dir()
    except OSError as error:  # too long a name
        raise InputError("cannot create this folder", source=output) from error
    for name in ("car.toml", "run.toml", "car.dbc"):
        if (output / name).is_file() and not force:
            cure = "give --force to overwrite it"
            raise InputError("exists", source=output / name, cure=cure)
    if is_folder:
        check_writable(output / "car.toml")
    elif not has_parent:
        raise InputError("cannot create this folder", source=output)


@dataclass
class _Found:
    """What was found, and how.

    Parameters
    ----------
    method : str
        "preset", "dbc" or "physics".
    candidates : mapping of str to sequence
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
    proof : dict
        What the captures show when they are decoded with the files.
    """

    method: str
    candidates: dict[str, Sequence[Candidate]] = field(default_factory=dict)
    clear: Collection[str] = ()
    head: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    vehicle: str | None = None
    dbc: Path | None = None
    nominal_v: float | None = None
    chosen: dict[str, int] = field(default_factory=dict)
    proof: dict[str, Any] = field(default_factory=dict)

    @property
    def signals(self) -> dict[str, Candidate]:
        """Chosen candidates by role."""
        return {role: self.candidates[role][number] for role, number in self.chosen.items()}

    @property
    def fixed_c(self) -> float | None:
        """Temperature that the files assume [°C]; None where the bus has one."""
        from cangauge.bus.vehicle import PRESETS
        from cangauge.extras.discovery.proposal import FALLBACK_C

        if self.vehicle is not None:
            return FALLBACK_C if PRESETS[self.vehicle].lacks_temperature else None
        return None if "temperature" in self.chosen else FALLBACK_C

    @property
    def is_sign_proven(self) -> bool:
        """Whether the captures prove the sign of a named current."""
        return self.method != "physics" and bool(self.proof.get("sign", {}).get("sign"))

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
        """Return the text of each file to write to a folder."""
        from cangauge.extras.discovery import proposal

        texts, lines = {}, ['map = "car.toml"']
        if self.vehicle is not None:
            lines = [f'vehicle = "{self.vehicle}"  # recognised by its ids and CRC']
            if self.fixed_c is not None:
                lines.append(
                    f"temperature = {self.fixed_c:g}  # assumed: not known on this bus [°C]"
                )
        else:
            dbc, head, pair_s = "car.dbc", self.head, 0.1
            if self.dbc is None:
                texts[dbc] = proposal.dbc_text(self.signals.values())  # type: ignore[arg-type]
                slowest_s = max(self.signals[role].stream.period_s for role in _NEEDED)  # type: ignore[union-attr]
                pair_s = min(max(0.020, 1.2 * slowest_s), 1.0)
            else:
                own, head = self.dbc.resolve(), (*head, self.sign_text)
                dbc = own.name if own.parent == folder.resolve() else str(own)
            comments = {}
            for role, signal in self.signals.items():
                others = [each.name for each in self.candidates[role] if each is not signal]
                comments[role] = signal.comments(self.nominal_v)
                comments[role] += [f"Else: {', '.join(others)}."] if others else []
            texts["car.toml"] = proposal.map_text(dbc, head, self.signals, comments, pair_s)
        reading = self.reading(Path())
        texts["run.toml"] = proposal.config_text(lines, **bus, reading=reading)
        return texts

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
            "remarks": list(self.remarks),
            "voltage_levels": [{"scale": each.scale, "voltage_v": each.value} for each in volts],
            "soc_levels": [{"scale": each.scale, "highest_pct": each.value} for each in socs],
            "proof": self.proof,
        }


# --- Finding and choosing


def _listen(bus: Mapping[str, Any], seconds: float, path: Path) -> Path:
    """Record a live bus to a file."""
    import can

    from cangauge.bus.connection import BusConnection
    from cangauge.bus.open import bus_address, open_bus

    address = bus_address(bus["interface"], bus["channel"], bus["bus_options"])
    frames = 0
    with (
        BusConnection(open_bus(address), str(address)) as port,
        can.CanutilsLogWriter(path) as writer,
        progress() as show,
    ):
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0.0:
            for message in port.receive_pending(min(left_s, 0.1)):
                message.channel = message.channel or "can0"
                writer.on_message_received(message)
                frames += 1
            show(f"listening on {address}: {left_s:.0f} s left, {frames} frames")
    if not frames:
        raise InputError("no frame came", source=str(address), cure="is the car awake?")
    return path


def _joined(paths: Sequence[Path]) -> Iterator[can.Message]:
    """Yield the frames of captures, one after the other in time."""
    from cangauge.bus.captures import open_capture
    from cangauge.extras.discovery.search import BETWEEN_S

    last_s: float | None = None
    for path in paths:
        shift_s: float | None = None
        for message in open_capture(path):
            if shift_s is None:
                shift_s = 0.0 if last_s is None else last_s + BETWEEN_S - message.timestamp
            message.timestamp += shift_s
            last_s = message.timestamp
            yield message


def _find(
    paths: Sequence[Path], dbc: Path | None, nominal_v: float | None, *, presets: bool
) -> _Found:
    from cangauge.bus.captures import open_capture
    from cangauge.extras.discovery.by_name import is_clear, named_signals
    from cangauge.extras.discovery.search import search

    if dbc is not None:
        messages = chain.from_iterable(open_capture(path) for path in paths)
        named = named_signals(dbc, messages)
        clear = [role for role in _NEEDED if is_clear(named[role])]
        head = ("Signals found by their names and units in the DBC.",)
        return _Found("dbc", {**named}, clear, head, dbc=dbc)
    if presets and (known := _known(paths)) is not None:
        return _Found("preset", vehicle=known)
    with progress("cangauge.extras.discovery") as show:
        show("reading frames")
        found = search(_joined(paths), nominal_v)
    candidates = {role: getattr(found, role) for role in _ROLES.values()}
    clear = [role for role in _NEEDED if found.is_clear(role)]
    return _Found("physics", candidates, clear, found.comments, found.remarks, nominal_v=nominal_v)


def _known(paths: Sequence[Path]) -> str | None:
    """Return the preset that matches all captures; None without."""
    from cangauge.inspect.capture import inspect_capture

    matching = [set(inspect_capture(path).matching) for path in paths]
    common = sorted(set.intersection(*matching)) if matching else []
    if len(common) > 1:
        note(f"several presets match ({', '.join(common)}): none is taken")
    return common[0] if len(common) == 1 else None


def _choose(found: _Found, picks: dict[str, int], output: Path, *, quiet: bool) -> None:
    """Choose a candidate for each role: the user's, or the clear one.

    Raises
    ------
    CangaugeError
        If a needed role has no clear candidate; tables of them are printed first, if not `quiet`.
    """
    unclear = []
    for name, role in () if found.method == "preset" else _ROLES.items():
        count = len(found.candidates[role])
        if role in picks:
            if picks[role] >= count:
                value = f"{name}={picks[role] + 1}"
                raise InputError(f"there are {count} candidates", field="--choose", value=value)
            found.chosen[role] = picks[role]
        elif role in _NEEDED and role not in found.clear:
            unclear.append(role)
        # Slow and plausible is not enough: the user chooses a temperature, or none.
        elif count and (role != "temperature" or found.method == "dbc"):
            found.chosen[role] = 0
    if not unclear:
        return
    lines = [f"no {' and no '.join(unclear)} is clearly ahead of the others"]
    if found.method == "physics" and found.nominal_v is None:
        lines.append("the scale of the voltage is open (--nominal-voltage V decides it)")
    if not quiet:
        _show(found)
    for role in unclear if quiet else ():
        names = [f"{n}) {c.name}" for n, c in enumerate(found.candidates[role], 1)]
        lines.append(f"{role}: {', '.join(names)}")
    raise CangaugeError(
        f"{'; '.join(lines)}; nothing was written to {output}: choose by"
        f" {' '.join(f'--choose {role}=1' for role in unclear)}, or record a drive with current"
        " steps"
    )


def _prove(
    found: _Found, paths: Sequence[Path], output: Path, folder: Path, bus: Mapping[str, Any]
) -> None:
    """Decode the first capture by the files before they are saved; set `proof` and a named sign.

    Raises
    ------
    InputError
        If the files do not decode the capture.
    """
    import numpy as np

    from cangauge.bus.recording import capture_samples
    from cangauge.bus.vehicle import Vehicle
    from cangauge.logs.log import Log
    from cangauge.logs.sign import sign_of_current

    if found.vehicle is not None:
        car = Vehicle.load(found.vehicle, temperature_c=found.fixed_c)
    else:
        for name, text in found.texts(output, bus).items():
            (folder / name).write_text(text, encoding="utf-8")
        if found.dbc is not None:
            shutil.copy(found.dbc, folder / found.dbc.name)
        car = Vehicle.load(map=folder / "car.toml")
    for path in paths:
        samples = capture_samples(path, car)
        if len(samples) < 2:
            raise InputError(
                "current and voltage found do not make samples: their frames are too far apart",
                source=path,
                cure="choose others by --choose",
            )
        good = np.isfinite(samples.voltage_v)
        good &= np.diff(samples.time_s, prepend=-np.inf) > 0.0
        amps, volts = samples.current_a, samples.voltage_v[good]
        if len(volts):  # the sign needs no temperature
            rows = (samples.time_s[good], amps[good], volts, np.zeros(len(volts)))
            sign = sign_of_current(Log(*rows, soc_pct=samples.soc_pct[good]))
            found.proof["sign"] = {
                "sign": sign.sign, "confidence": sign.confidence, "text": sign.strongest.text,
            }  # fmt: skip
            if found.method == "dbc" and sign.sign == -1:  # the map says how its sign was found
                turned = [replace(each, sign=-1) for each in found.candidates["current"]]
                found.candidates["current"] = turned
                amps = -amps
        found.proof |= {
            "samples": len(samples),
            "current_a": [float(amps.min()), float(amps.max())],
            "voltage_v": [float(volts.min()), float(volts.max())] if len(volts) else None,
        }


# --- What is shown


def _show(found: _Found) -> None:
    """Print the candidates of each role; a tick means that the data leave nothing of it open."""
    for role in (role for role in _ROLES.values() if found.candidates.get(role)):
        head = found.candidates[role][0].HEAD
        rows = []
        for number, candidate in enumerate(found.candidates[role]):
            mark = str(number + 1)
            if found.chosen.get(role) == number:
                is_open = found.levels(role) or (role == "current" and not found.is_sign_proven)
                mark += " ?" if is_open else " ✓"
            rows.append([mark, *candidate.cells])
        print_table(role.replace("_reference", ""), ["", *head], rows)
    for remark in found.remarks:
        note(f"note: {remark}")


def _show_proof(found: _Found) -> None:
    from cangauge.bus.vehicle import PRESETS
    from cangauge.extras.discovery.candidate import range_text

    if found.vehicle is not None:
        note(f"known vehicle: {found.vehicle}, {PRESETS[found.vehicle].about}")
    if found.proof:
        amps, volts = found.proof["current_a"], found.proof["voltage_v"]
        shown = "no voltage" if volts is None else range_text(volts[0], volts[1], "V")
        shown = f"{range_text(amps[0], amps[1], 'A')}, {shown}"
        note(f"decoded: {found.proof['samples']} samples of the first capture, {shown}")
    if found.method != "physics":
        note(found.sign_text)
    if found.fixed_c is not None:
        note(
            f"note: no temperature was found or chosen: the files assume {found.fixed_c:g} °C;"
            " some °C of error are worth several % SoC"
        )
    cures = {
        "voltage": "Give --nominal-voltage V (type plate, or a meter).",
        "soc_reference": "Compare it with the car's display, and correct the factor in the DBC.",
    }
    for role, cure in cures.items():
        if levels := found.levels(role):
            quantity = "SoC" if role == "soc_reference" else role
            texts = ", ".join(level.text for level in levels)
            note(f"note: The bits do not tell the scale of the {quantity}: {texts}. {cure}")
