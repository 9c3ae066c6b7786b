"""`cangauge init`: from a capture or a live bus to a map and a configuration."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from cangauge._files import check_writable, make_folder, write_texts_atomic
from cangauge.cli.options import Json, argument, command, config_parameters, config_values, option
from cangauge.cli.output import finish, note, print_table, progress, say
from cangauge.errors import CangaugeError, InputError
from cangauge.extras.discovery.candidate import LEAST_HOURS, ROLES, range_text, short_name

if TYPE_CHECKING:
    import can

    from cangauge.extras.discovery.proposal import Proposal
    from cangauge.logs.log import Log

_BUS: Final = ("interface", "channel", "bus_options")
_SCALE_CURES: Final = {
    "voltage": ("voltage", "Give --nominal-voltage V (by a meter; a type plate is less sure)."),
    "soc_reference": (
        "SoC",
        "Compare it with the car's display, and correct the factor in the DBC.",
    ),
}


@command(keys=config_parameters(*_BUS))
def init_command(
    captures: Annotated[
        list[Path] | None, argument("[CAPTURE]…", "Captures of one car, recorded while driving.")
    ] = None,
    *,
    output: Annotated[
        Path, option("-o, --output", "DIR", "Folder for run.toml and the other files.")
    ],
    dbc: Annotated[
        Path | None, option("--dbc", "FILE", "DBC of the car. Signals are found by name and unit.")
    ] = None,
    choose: Annotated[
        list[str] | None,
        option("--choose", "ROLE=N", "Take candidate N for current, voltage, soc or temperature."),
    ] = None,
    nominal_voltage: Annotated[
        float | None,
        option(
            "--nominal-voltage",
            "V",
            "Voltage of the pack, nominal or measured. It decides the scale of the voltage signal.",
            within=(10, 1500),
            unit="V",
        ),
    ] = None,
    presets: Annotated[
        bool, option("--presets/--no-presets", "", "Look for known vehicles.")
    ] = True,
    seconds: Annotated[
        float,
        option("--seconds", "S", "Time to listen to a live bus.", within=(1, 86400), unit="s"),
    ] = 60.0,
    force: Annotated[bool, option("--force", "", "Overwrite existing files.")] = False,
    json_output: Json = False,
    **options: Any,
) -> None:
    """Find the car's signals, check them against each other, and write a map and a configuration.

    The frames come from captures or from a live bus. Known vehicles are recognised by ids and CRC.
    With --dbc, signals are found by name and unit. Otherwise, signals are found by physics: current
    and voltage are the pair of fields that follows ΔU = −R·ΔI. Record while driving, because a
    parked car has no current. If the first of three candidates is not clearly the best, `init`
    names the three, and ends with exit code 1. Then choose one with --choose.

    Examples
    --------
    `cangauge init drive.log -o mycar`

    `cangauge init --interface socketcan --channel can0 --seconds 120 -o mycar`

    `cangauge init drive.log --dbc car.dbc -o mycar`

    `cangauge init drive.log --choose current=2 -o mycar`
    """
    picks = _picks(choose or [])
    _check(output, force=force)
    values = config_values(options)
    bus = {name: values[name] for name in _BUS}
    with tempfile.TemporaryDirectory(prefix="cangauge-init-") as name:
        folder, paths = Path(name), list(captures or [])
        if bus["interface"] is not None or bus["channel"] is not None:
            if paths:
                problem, cure = "given together with a capture", "omit one"
                raise InputError(problem, field="--interface", cure=cure)
            paths = [_listen(bus, seconds, folder / "live.log")]
        if not paths and dbc is None:
            cure = "give a capture, --interface and --channel, or --dbc FILE"
            raise InputError("nothing to look at", field="CAPTURE", cure=cure)
        proposal = _find(paths, dbc, nominal_voltage, presets=presets)
        unclear = [] if proposal.vehicle else _choose(proposal, picks)
        if unclear or (proposal.method == "physics" and not proposal.has_steps):
            raise _undecided(proposal, unclear, nominal_voltage, output, quiet=json_output)
        _prove(proposal, paths, output, bus, folder)
        texts = proposal.texts(output, bus)
    make_folder(output)
    write_texts_atomic({output / name: text for name, text in texts.items()})
    files = [str(output / name) for name in texts]
    show = partial(_show, proposal, files, output)
    finish({**proposal.to_dict(), "files": files}, show, as_json=json_output)


def _picks(given: Sequence[str]) -> dict[str, int]:
    """Return the number of the candidate by role, from 0."""
    of_name = {short_name(role): role for role in ROLES}
    picks = {}
    for text in given:
        name, _, number = text.partition("=")
        if name not in of_name or number not in {*"123456789"}:
            cure = f"ROLE is {', '.join(of_name)}; N counts from 1: --choose current=2"
            raise InputError("not ROLE=N", field="--choose", value=text, cure=cure)
        picks[of_name[name]] = int(number) - 1
    return picks


def _check(output: Path, *, force: bool) -> None:
    """Raise InputError if a file exists in the folder, or cannot be written."""
    try:
        existing = next(folder for folder in (output, *output.parents) if folder.exists())
    except OSError as error:  # too long a name
        raise InputError("cannot create this folder", source=output) from error
    if not existing.is_dir():
        raise InputError(f"cannot create this folder: {existing} is a file", source=output)
    for name in ("car.toml", "run.toml", "car.dbc"):
        if (output / name).is_file() and not force:
            raise InputError("exists", source=output / name, cure="give --force to overwrite it")
    check_writable(existing / "car.toml")


def _listen(bus: Mapping[str, Any], seconds: float, path: Path) -> Path:
    """Record a live bus to a file."""
    import can

    from cangauge.bus.connection import BusConnection
    from cangauge.bus.open import bus_address, open_bus

    address = bus_address(bus["interface"], bus["channel"], bus["bus_options"])
    frames = 0
    with (
        BusConnection(open_bus(address), address) as port,
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
) -> Proposal:
    """Find the signals by the names of a DBC, else by a preset, else by physics."""
    from cangauge.bus.database import load_dbc
    from cangauge.extras.discovery.by_name import PROVEN, clear_roles, named_signals
    from cangauge.extras.discovery.proposal import Proposal
    from cangauge.extras.discovery.search import search

    if dbc is not None:
        remarks: list[str] = []
        named = named_signals(load_dbc(dbc, remarks), _joined(paths), nominal_v)
        return Proposal(
            method="dbc",
            candidates=named,
            clear=clear_roles(named),
            head=("Signals found by their names and units in the DBC.",),
            remarks=tuple(remarks),
            dbc=dbc,
            has_steps=any(each.evidence > PROVEN for each in named["current"]),
        )
    if presets and (known := _known(paths)) is not None:
        return Proposal("preset", vehicle=known)
    with progress("cangauge.extras.discovery") as show:
        show("reading frames")
        return search(_joined(paths), nominal_v)


def _known(paths: Sequence[Path]) -> str | None:
    """Return the preset that matches all captures; None without."""
    from cangauge.inspect.capture import inspect_capture

    matching = [set(inspect_capture(path).matching) for path in paths]
    common = sorted(set.intersection(*matching)) if matching else []
    if len(common) > 1:
        note(f"several presets match ({', '.join(common)}): none is taken")
    return common[0] if len(common) == 1 else None


def _choose(proposal: Proposal, picks: Mapping[str, int]) -> list[str]:
    """Choose a candidate for each role: the user's, or the clear one; return unclear roles."""
    for role, found in proposal.candidates.items():
        number = picks.get(role, 0)
        if number >= len(found) and role in picks:
            value = f"{short_name(role)}={number + 1}"
            problem = f"there are {len(found)} candidates"
            raise InputError(problem, field="--choose", value=value)
        if role in picks or role in proposal.clear:
            proposal.chosen[role] = number
    return [role for role in ("current", "voltage") if role not in proposal.chosen]


def _undecided(
    proposal: Proposal,
    unclear: Sequence[str],
    nominal_v: float | None,
    output: Path,
    *,
    quiet: bool,
) -> CangaugeError:
    """Return the error of a map that cannot be made; print the candidates, if not `quiet`."""
    by_physics = proposal.method == "physics"
    cure = "record a drive"
    if by_physics and not proposal.has_steps:
        problem = "no voltage follows a current in steps, so that nothing proves the signals"
    elif absent := [role for role in unclear if not proposal.candidates[role]]:
        problem = f"nothing can be the {' or the '.join(absent)}"
        if not by_physics:
            cure = "give the DBC that has it, or name the signals in a map file (docs/map-file.md)"
    else:
        problem = f"no {' and no '.join(unclear)} is clearly the pack's"
        choice = f"choose by {' '.join(f'--choose {role}=N' for role in unclear)}"
        cure = choice if proposal.has_steps else f"{cure}, or {choice}"
        if by_physics and nominal_v is None:
            problem += ", and the scale of the voltage is open (--nominal-voltage V decides it)"
    if quiet:
        for role in unclear:
            names = [f"{n}) {c.name}" for n, c in enumerate(proposal.candidates[role], 1)]
            problem += f"; {role}: {', '.join(names)}"
    else:
        say(f"No map: {problem}.")
        _show_candidates(proposal)
    return CangaugeError(f"{problem}; nothing was written to {output}: {cure}")


def _prove(
    proposal: Proposal, paths: Sequence[Path], output: Path, bus: Mapping[str, Any], folder: Path
) -> None:
    """Load what will be saved from a temporary folder, and decode the first capture by it.

    Sets `proof`, and the sign of a DBC's current, which the saved map then states.

    Raises
    ------
    InputError
        If the files do not decode the capture.
    """
    from cangauge.bus.recording import capture_samples
    from cangauge.bus.vehicle import Vehicle
    from cangauge.logs.sign import sign_of_current

    if proposal.vehicle is not None:
        car = Vehicle.load(proposal.vehicle, temperature_c=proposal.fixed_c)
    else:
        for name, text in proposal.texts(output, bus).items():
            (folder / name).write_text(text, encoding="utf-8")
        if proposal.dbc is not None:
            shutil.copy(proposal.dbc, folder / proposal.dbc.name)
        car = Vehicle.load(map=folder / "car.toml")
    if not paths:
        return
    log = capture_samples(paths[0], car).as_log()
    if log is None:
        problem = "current and voltage found do not make samples: their frames are too far apart"
        raise InputError(problem, source=paths[0], cure="choose others by --choose")
    sign = sign_of_current(log)
    found = {"sign": sign.sign, "confidence": sign.confidence, "text": sign.strongest.text}
    amps, volts = log.current_a, log.voltage_v
    if proposal.method == "dbc" and sign.sign == -1:  # the map says how its sign was found
        turned = [replace(each, sign=-1) for each in proposal.candidates["current"]]
        proposal.candidates["current"] = turned
        amps = -amps
    proposal.proof = {
        "sign": found,
        "soc": _soc_by_charge(log, sign.sign or 1),
        "samples": len(log),
        "current_a": [float(amps.min()), float(amps.max())],
        "voltage_v": [float(volts.min()), float(volts.max())],
    }


def _soc_by_charge(log: Log, sign: int) -> dict[str, Any]:
    """Return the capacity that SoC and charge have by each half [Ah], and whether they agree."""
    from cangauge.logs.charge import implied_capacity

    if log.first_soc() is None:
        return {}
    middle, most = len(log) // 2, 0.1  # largest relative difference
    parts = log.rows(slice(None, middle)), log.rows(slice(middle, None))
    try:
        halves = [implied_capacity([part], 0.0) for part in parts]
    except InputError:
        why = "it stands still in at least one half of the capture, so the charge cannot prove it"
        return {"agrees": False, "why": why}
    low_ah, high_ah = sorted(sign * half.capacity_ah for half in halves)
    agrees = (
        low_ah > 2.0  # from a scooter's
        and high_ah < 600.0  # to a truck's
        and low_ah >= LEAST_HOURS * float(abs(log.current_a).max())
        and low_ah * most >= max(half.std_ah for half in halves)
        and high_ah <= (1.0 + most) * low_ah
    )
    why = f"by charge, 100 % are {low_ah:.3g} … {high_ah:.3g} Ah in the halves of the capture"
    return {"agrees": agrees, "why": why}


def _show_candidates(proposal: Proposal) -> None:
    """Print the candidates of each role; a tick means that the data leave nothing of it open."""
    for role, candidates in proposal.candidates.items():
        rows = []
        for number, candidate in enumerate(candidates):
            mark = str(number + 1)
            if proposal.chosen.get(role) == number:
                mark += " ?" if proposal.is_open(role) else " ✓"
            rows.append([mark, *candidate.cells])
        if candidates:
            print_table(short_name(role), ["", *candidates[0].head], rows)
    for remark in proposal.remarks:
        note(f"note: {remark}")


def _show(proposal: Proposal, files: Sequence[str], output: Path) -> None:
    """Print the candidates, what the capture proves, what is assumed, and the next commands."""
    say(f"{proposal.answer}: wrote {', '.join(files)}.")
    _show_candidates(proposal)
    if proof := proposal.proof:
        (low_a, high_a), (low_v, high_v) = proof["current_a"], proof["voltage_v"]
        shown = f"{range_text(low_a, high_a, 'A')}, {range_text(low_v, high_v, 'V')}"
        note(f"decoded: {proof['samples']} samples of the first capture, {shown}")
    if proposal.method != "physics":
        note(proposal.sign_text)
    if "current" in proposal.chosen and proposal.signals["current"].is_wrapped:
        note("note: the DBC reads negative currents as large ones; the map has signed = true")
    if why := proposal.proof.get("soc", {}).get("why"):
        note(f"SoC: {why}.")
    if proposal.candidates.get("soc_reference") and "soc_reference" not in proposal.chosen:
        note(
            "SoC: no candidate is certain, so the map has none. Compare the ranges above with the"
            " car's display, and take one by --choose soc=N."
        )
    if proposal.fixed_c is not None:
        note(
            "note: no temperature is clearly the pack's or chosen: the files assume"
            f" {proposal.fixed_c:g} °C; some °C of error are worth several % SoC"
        )
    for role, (quantity, cure) in _SCALE_CURES.items():
        if levels := proposal.levels(role):
            texts = ", ".join(level.text for level in levels)
            note(f"note: The bits do not tell the scale of the {quantity}: {texts}. {cure}")
    reading = proposal.reading(output)
    fitting = f"cangauge fit DRIVE … {reading} -o {output / 'model.json'}"
    note(f"next: cangauge inspect DRIVE {reading}, then {fitting}")
