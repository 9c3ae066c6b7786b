"""Golden records: what the program gave when a change began; `python tests/golden/make.py` remakes.

Three sets, each a JSON file here; `test_golden.py` compares, and a difference is a decision that
the commit states:

- `captures.json`: samples and logs of every capture in `../shared/data` by every preset, and the
  one-line errors of bad inputs. Values.
- `commands.json`: keys and types of every command's `--json`. No values.
- `models.json`: estimates and published frames of `day.log.gz` by the frozen `oxide.json` and
  `lfp.json`. Values. Made again, with the models (`make.py --models`), only with the fit, the
  filter or the diagnosis.

    python tests/golden/make.py [captures|commands|models]… [--models]
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import json
import math
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import cangauge
from cangauge.__main__ import main
from cangauge.bus.captures import open_capture
from cangauge.bus.recording import capture_samples
from cangauge.bus.vehicle import PRESETS
from cangauge.logs.canonical import write_log
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
DATA = PROJECT.parent / "shared" / "data"
PLACES = 6  # decimals of the values compared: A, V, °C, %, s


# --- values


def digest(values: Any) -> str:
    """Return a hash of values rounded to `PLACES` decimals; NaN has its own."""
    column = np.asarray(values, dtype=np.float64)
    whole = np.where(np.isnan(column), -(2.0**62), np.round(column * 10.0**PLACES))
    return hashlib.sha256(whole.astype(np.int64).tobytes()).hexdigest()[:16]


def column(values: Any) -> dict[str, Any]:
    """Return first, last, sum and hash of a column."""
    known = np.asarray(values, dtype=np.float64)
    finite = known[np.isfinite(known)]
    ends = [None if math.isnan(each) else round(float(each), PLACES) for each in known[[0, -1]]]
    total = round(math.fsum(finite.tolist()), 3)
    return {"ends": ends, "finite": int(finite.size), "sum": total, "hash": digest(known)}


def one_line(error: Exception, folder: Path | None = None) -> str:
    """Return an error's text without folders."""
    text = f"{type(error).__name__}: {error}"
    for each in (folder, DATA, PROJECT):
        text = text if each is None else text.replace(f"{each}/", "").replace(f"{each}", "FOLDER")
    return text


def outcome(run: Callable[[], Any], folder: Path | None = None) -> Any:
    """Return what a call gives, or its one-line error."""
    try:
        return run()
    except cangauge.CangaugeError as error:
        return {"error": one_line(error, folder)}


# --- captures


def captures() -> list[Path]:
    """Return the recorded captures."""
    return sorted([*DATA.glob("leaf_can/*.gz"), *DATA.glob("can_captures/*.gz")])


# The other presets decode as these: leaf_ze0 as leaf_aze0, leaf_ze1 without a temperature.
DECODED_BY = ("generic", "leaf_aze0", "leaf_ze1_polled", "bmw_i3", "hyundai_kona_64")
LOGS_BY = ("leaf_aze0", "bmw_i3")


def samples_of(path: Path, preset: str, vehicle: cangauge.Vehicle) -> dict[str, Any]:
    """Return samples, counts and, by one preset of each make, the log of a capture."""
    found = capture_samples(path, vehicle)
    names = ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct")
    counts = found.statistics
    record: dict[str, Any] = {
        "samples": len(found),
        **{name: column(getattr(found, name)) for name in names},
        "frames": counts.frames,
        "counts": {
            name: getattr(counts, name)
            for name in ("crc_errors", "counter_repeats", "counter_jumps", "frames_lost", "short",
                         "not_available", "two_senders")
        },
        "remarks": list(found.remarks),
    }  # fmt: skip

    def as_log() -> dict[str, Any]:
        log = cangauge.read_log(path, vehicle)
        columns = [log.time_s, log.current_a, log.voltage_v, log.temperature_c]
        columns += [] if log.soc_pct is None else [log.soc_pct]
        return {"rows": len(log), "hash": digest(np.concatenate(columns))}

    return record | ({"log": outcome(as_log)} if preset in LOGS_BY else {})


def capture_records(path: Path) -> dict[str, Any]:
    """Return the records of a capture by preset."""
    found = {}
    for name in DECODED_BY:
        warm = {"temperature_c": 20.0} if PRESETS[name].mapping.temperature is None else {}
        vehicle = cangauge.Vehicle.load(name, **warm)
        found[name] = outcome(lambda n=name, v=vehicle: samples_of(path, n, v))
    return found


MAP = """name = "car"
[current]
message = "PACK_CURRENT"
signal = "current_a"
[voltage]
message = "PACK_VOLTAGE"
signal = "voltage_v"
[temperature]
fixed_c = 20
"""
CANDUMP = "(1.000000) can0 1DB#3FF1FFC000000000\n"
HEAD = "time_s,current_a,voltage_v,temperature_c\n"
BAD_CAPTURES: dict[str, bytes] = {
    "empty.log": b"",
    "binary.log": bytes(range(256)) * 8,
    "words.txt": b"the quick brown fox\njumps over\n" * 20,
    "cut.log.gz": gzip.compress(CANDUMP.encode() * 4000)[:60],
    "not_gzip.log.gz": b"\x1f\x8b\x08\x00" + b"junk" * 50,
    "other_id.log": b"(1.0) can0 123#0011\n(2.0) can0 123#0022\n",
    "mostly_junk.log": CANDUMP.encode() + b"(2.0) can0 zzz#!!\n" * 30,
    "short_frames.log": b"(1.0) can0 1DB#00\n(2.0) can0 1DB#00\n",
    "head_only.asc": b"date Mon Jan 1 00:00:00 2024\nbase hex timestamps absolute\n",
    "head_only.trc": b";$FILEVERSION=1.1\n;$STARTTIME=43000.5\n",
    "head_only.csv": b"Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n",
    "cut.blf": b"LOGG" + bytes(20),
    "cut.mf4": b"MDF     4.10    " + bytes(80),
    "cut.pcap": b"\xd4\xc3\xb2\xa1" + bytes(4),
}
BAD_MAPS: dict[str, str] = {
    "unknown_key.toml": MAP + "wrong = 1\n",
    "no_voltage.toml": MAP.replace("[voltage]", "[other]"),
    "unknown_message.toml": MAP.replace("PACK_CURRENT", "PACK_CURENT"),
    "unknown_signal.toml": MAP.replace("current_a", "curent_a"),
    "sign_two.toml": MAP.replace("[voltage]", "sign = 2\n[voltage]"),
    "scale_zero.toml": MAP.replace("[voltage]", "scale = 0\n[voltage]"),
    "swapped_limits.toml": MAP.replace("[voltage]", "lowest = 5\nhighest = -5\n[voltage]"),
    "wrong_type.toml": MAP.replace('signal = "voltage_v"', "signal = [1]"),
    "unit_of_another_role.toml": MAP.replace("PACK_CURRENT", "PACK_TEMPERATURE").replace(
        "current_a", "temperature_c"
    ),
    "no_temperature.toml": MAP.partition("[temperature]")[0],
    "hot.toml": MAP.replace("20", "2000"),
    "unknown_message_rule.toml": MAP + '[messages.NOBODY]\nprotection = "none"\n',
    "unknown_protection.toml": MAP + '[messages.PACK_CURRENT]\nprotection = "magic"\n',
    "pair_within.toml": "pair_within_s = 5.0\n" + MAP,
    "not_toml.toml": "name = = 1\n",
}
BAD_DBC: dict[str, str] = {
    "empty.dbc": "",
    "words.dbc": "this is no DBC\n",
    "cut.dbc": 'VERSION ""\nBO_ 100 A: 8 X\n SG_ S : 0|',
    "overlong.dbc": 'VERSION ""\nBU_: X\nBO_ 100 A: 8 X\n SG_ S : 60|16@1+ (1,0) [0|0] "A" X\n',
}
BAD_LOGS: dict[str, str] = {
    "empty.csv": "",
    "head_only.csv": HEAD,
    "one_row.csv": HEAD + "0,1,380,20\n",
    "no_voltage.csv": "time_s,current_a,temperature_c\n0,1,20\n1,1,20\n",
    "no_temperature.csv": "time_s,current_a,voltage_v\n0,1,380\n1,1,380\n",
    "backwards.csv": HEAD + "5,1,380,20\n4,1,380,20\n3,1,380,20\n2,1,380,20\n",
    "word.csv": HEAD + "0,1,380,20\n1,high,380,20\n2,1,380,20\n",
    "missing_current.csv": HEAD + "0,1,380,20\n1,,380,20\n2,1,380,20\n",
    "ragged.csv": HEAD + "0,1,380,20\n1,1\n2,1,380,20\n",
    "kelvin.csv": HEAD + "".join(f"{k},1,380,293\n" for k in range(9)),
    "volts_in_mv.csv": HEAD + "".join(f"{k},1,380000,20\n" for k in range(9)),
    "soc_over_100.csv": HEAD.replace("\n", ",soc_pct\n") + "0,1,380,20,50\n1,1,380,20,500\n",
    "prose.csv": "the quick brown fox\njumps over\n" * 9,
    "notes.xyz": "nothing to read here\n",
    "cut.parquet": "PAR1",
}


def bad_inputs() -> dict[str, Any]:
    """Return the error of each bad input, by kind and name."""
    found: dict[str, dict[str, Any]] = {
        "vehicle": {},
        "capture": {},
        "map": {},
        "dbc": {},
        "log": {},
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def keep(kind: str, label: str, run: Callable[[], Any]) -> None:
            got = outcome(run, folder)
            found[kind][label] = got["error"] if isinstance(got, dict) else "accepted"

        load = cangauge.Vehicle.load
        generic = PROJECT / "dbc" / "generic_pack.dbc"
        (folder / "map.toml").write_text(MAP)
        keep("vehicle", "unknown", lambda: load("leaf_zeo"))
        keep("vehicle", "far_from_any", lambda: load("spaceship"))
        keep("vehicle", "none", load)
        keep("vehicle", "preset_and_dbc", lambda: load("leaf_aze0", generic))
        keep("vehicle", "dbc_alone", lambda: load(dbc=generic))
        keep("vehicle", "map_without_dbc", lambda: load(map=folder / "map.toml"))
        keep("vehicle", "no_such_map", lambda: load(dbc=generic, map=folder / "none.toml"))
        keep("vehicle", "no_such_dbc", lambda: load(dbc=folder / "a.dbc", map=folder / "map.toml"))
        keep("vehicle", "too_hot", lambda: load("leaf_aze0", temperature_c=500.0))
        keep("vehicle", "without_temperature", lambda: load("leaf_ze1"))
        keep("vehicle", "pair_within", lambda: load("leaf_aze0", pair_within_s=3.0))
        for label, data in BAD_CAPTURES.items():
            (folder / label).write_bytes(data)
            keep("capture", label,
                 lambda p=folder / label: cangauge.read_log(p, load("leaf_aze0")))  # fmt: skip
        (folder / "good.log").write_text(CANDUMP)
        keep("capture", "without_vehicle", lambda: cangauge.read_log(folder / "good.log"))
        keep("capture", "absent", lambda: cangauge.read_log(folder / "absent.log"))
        keep("capture", "folder", lambda: cangauge.read_log(folder))
        for label, text in BAD_MAPS.items():
            (folder / label).write_text(text)
            keep("map", label, lambda p=folder / label: load(dbc=generic, map=p))
        for label, text in BAD_DBC.items():
            (folder / label).write_text(text)
            keep("dbc", label, lambda p=folder / label: load(dbc=p, map=folder / "map.toml"))
        for label, text in BAD_LOGS.items():
            (folder / label).write_text(text)
            keep("log", label, lambda p=folder / label: cangauge.read_log(p))
    return found


# --- commands


def command(*arguments: object) -> dict[str, Any]:
    """Run a command in this process with `--json`; return the object that it prints."""
    out, said = io.StringIO(), io.StringIO()
    before, sys.argv = sys.argv, ["cangauge", *map(str, arguments), "--json"]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
            main()
    except SystemExit:
        pass
    finally:
        sys.argv = before
    try:
        found: dict[str, Any] = json.loads(out.getvalue())
    except json.JSONDecodeError:
        raise AssertionError(f"{arguments} printed no JSON: {said.getvalue()}") from None
    return found


def succeed(*arguments: object) -> dict[str, Any]:
    """Run a command that must not fail."""
    found = command(*arguments)
    if "error" in found:
        raise AssertionError(f"{arguments}: {found['error']}")
    return found


NAMED_BY_DATA = {"reasons"}
"""Objects whose keys are what occurred; the shapes of their values are compared."""


def shape(value: Any) -> Any:
    """Return keys and types of a JSON value; a list has the shapes of its items, each once."""
    if isinstance(value, dict):
        return {
            key: shape(
                list(each.values()) if key in NAMED_BY_DATA and isinstance(each, dict) else each
            )
            for key, each in sorted(value.items())
        }
    if isinstance(value, list):
        shapes = {json.dumps(shape(each), sort_keys=True) for each in value}
        return [json.loads(each) for each in sorted(shapes)]
    if isinstance(value, bool):
        return "boolean"
    # Whether a number is known can depend on the last digits of the inputs.
    return "number or null" if value is None or isinstance(value, int | float) else "text"


def live(folder: Path, log: Path, model: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield what run, status and replay print, on a virtual bus in this process."""
    bus = ("--interface", "virtual", "--channel", "golden", "--vehicle", "generic")
    socket = folder / "status.sock"
    # Not by the command: two commands at once in one process would share standard output.
    config = folder / "run.toml"
    config.write_text(
        f'model = "{model}"\ninterface = "virtual"\nchannel = "golden"\nvehicle = "generic"\n'
        f'time_source = "replay-clock"\nduration_s = 60.0\nstatus_socket = "{socket}"\n'
    )
    service, summary = cangauge.Service(config), list[dict[str, Any]]()
    run = threading.Thread(target=lambda: summary.append(service.run()))
    run.start()
    until = time.monotonic() + 60.0
    while run.is_alive() and not socket.exists() and time.monotonic() < until:
        time.sleep(0.05)
    yield "replay", succeed("replay", log, *bus, "--speed", "max")
    yield "status", succeed("status", "--endpoint", socket)
    service.stop()
    run.join()
    yield "run", json.loads(json.dumps(summary[0]))


def command_records() -> dict[str, Any]:
    """Return keys and types of every command's --json, on inputs made on the spot."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model, drive = HERE / "oxide.json", folder / "drive.csv"
        reference, capture = folder / "reference.csv", HERE / "day.log.gz"

        def keep(label: str, *arguments: object) -> None:
            run = command if label == "error" else succeed
            found[label] = shape(run(*arguments))

        simulated = folder / "simulated.csv"
        keep("twin", "twin", "--seed", 3, "-o", simulated)
        keep("twin_effect", "twin", "--seed", 3, "--effect", "current_offset", "-o", simulated)
        write_log(cangauge.simulate(seed=3, hours=0.3).log, drive)
        faulty = cangauge.simulate("current_offset", seed=3, drive=2, hours=0.3)
        write_log(faulty.log, reference)
        keep("fit", "fit", drive, reference, "--capacity-ah", 55, "-o", folder / "model.json")
        keep("estimate", "estimate", drive, "-m", model, "-o", folder / "out.csv")
        keep("estimate_capture", "estimate", capture, "-m", model, "-o", folder / "out.csv",
             "--vehicle", "generic")  # fmt: skip
        keep("gap", "gap", reference, "-m", model, "--reference", drive)
        keep("inspect", "inspect", drive)
        keep("inspect_capture", "inspect", capture, "--vehicle", "generic")
        keep("init", "init", capture, "-o", folder / "car")
        keep("export-c", "export-c", "-m", model, "-o", folder / "c")
        keep("export-fmu", "export-fmu", "-m", model, "-o", folder / "unit.fmu")
        keep("error", "estimate", drive, "-m", folder / "none.json", "-o", folder / "out.csv")
        with gzip.open(capture, "rt") as file:
            (folder / "short.log").write_text("".join(file.readlines()[:400]))
        for label, printed in live(folder, folder / "short.log", model):
            found[label] = shape(printed)
    return found


# --- frozen models

FROZEN = {"oxide": "leaf24", "lfp": "car60lfp"}


def make_models() -> None:
    """Fit the frozen models, and write the day that they estimate."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for label, pack in FROZEN.items():
            drives = [folder / f"{label}{day}.csv" for day in (1, 2, 3)]
            for day, path in enumerate(drives, 1):
                simulated = cangauge.simulate(
                    seed=7, drive=day, pack=pack, hours=1.5, start_soc_pct=95, end_soc_pct=15
                )
                write_log(simulated.log, path)
            truth = cangauge.read_log(drives[0])
            capacity = truth.soc_pct[0] - truth.soc_pct[-1]
            charge = np.trapezoid(truth.current_a, truth.time_s) / 3600.0
            succeed("fit", *drives, "--capacity-ah", round(100.0 * charge / capacity, 1),
                    "--chemistry", label, "-o", HERE / f"{label}.json")  # fmt: skip
            plain = json.loads((HERE / f"{label}.json").read_text())
            (HERE / f"{label}.json").write_text(json.dumps(plain, ensure_ascii=False) + "\n")
        simulated = cangauge.simulate(seed=7, drive=4, pack="leaf24", hours=0.25, start_soc_pct=70)
        write_log(simulated.log, folder / "day.csv")
        write_day(folder / "day.csv")


def write_day(log: Path) -> None:
    """Write the frames of a log, by the generic preset, with stamps from 1000 s on."""
    day = cangauge.read_log(log)
    encoder = FrameEncoder(cangauge.Vehicle.load("generic"))
    lines = []
    rows = zip(day.time_s, day.current_a, day.voltage_v, day.temperature_c, strict=True)
    for row in rows:
        lines += [
            f"({1000.0 + frame.timestamp:.6f}) can0"
            f" {frame.arbitration_id:03X}#{frame.data.hex().upper()}\n"
            for frame in encoder.encode(cangauge.Sample(*map(float, row)), 50.0)
        ]
    with (
        (HERE / "day.log.gz").open("wb") as raw,
        gzip.GzipFile(fileobj=raw, mode="wb", mtime=0, filename="") as file,
    ):
        file.write("".join(lines).encode())


def published(model: cangauge.Model) -> list[str]:
    """Return the frames published over the day, one beat every 100 ms of bus time."""
    pipeline = Pipeline(cangauge.Vehicle.load("generic"), model, PipelineSettings())
    lines, due_s = [], 1000.0
    for frame in open_capture(HERE / "day.log.gz"):
        while due_s <= frame.timestamp:
            lines += [
                f"{due_s:.1f} {sent.arbitration_id:X}#{sent.data.hex()}"
                for sent in pipeline.heartbeat()
            ]
            due_s += 0.1
        pipeline.handle(frame)
    return lines


def model_record(name: str) -> dict[str, Any]:
    """Return estimates and frames by a frozen model."""
    model = cangauge.Model.load(HERE / f"{name}.json")
    log = cangauge.read_log(HERE / "day.log.gz", cangauge.Vehicle.load("generic"))
    table = cangauge.estimate(log, model)
    frames = published(model)
    names = ("soc_pct", "soc_std_pct", "soc_newton_pct", "soc_coulomb_pct", "voltage_model_v",
             "residual_v")  # fmt: skip
    return {
        "estimate": {each: column(getattr(table, each)) for each in names},
        "frames": {
            "count": len(frames),
            "hash": hashlib.sha256("\n".join(frames).encode()).hexdigest()[:16],
            "some": frames[:: max(len(frames) // 24, 1)],
        },
    }


def model_records() -> dict[str, Any]:
    """Return the records of the frozen models."""
    return {name: model_record(name) for name in FROZEN}


def all_captures() -> dict[str, Any]:
    """Return the records of all captures and bad inputs."""
    return {
        "captures": {path.name: capture_records(path) for path in captures()},
        "bad_inputs": bad_inputs(),
    }


SETS: dict[str, Callable[[], dict[str, Any]]] = {
    "captures": all_captures,
    "commands": command_records,
    "models": model_records,
}


def write(name: str) -> None:
    """Write a set, and print each value that is another one than before."""
    path = HERE / f"{name}.json"
    before, content = json.loads(path.read_text()), SETS[name]()
    text = json.dumps(content, indent=1, ensure_ascii=False, sort_keys=True)
    path.write_text(text + "\n")
    for line in differences(before, json.loads(text), name):
        print(line)


def differences(before: Any, after: Any, at: str) -> Iterator[str]:
    """Yield the values that differ, with their places."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted({*before, *after}):
            yield from differences(before.get(key), after.get(key), f"{at}/{key}")
    elif before != after:
        yield f"{at}: {before} -> {after}"


def run(arguments: list[str]) -> None:
    """Make what the arguments name; all without one."""
    if "--models" in arguments:
        make_models()
    for name in [each for each in arguments if each in SETS] or SETS:
        write(name)
    shutil.rmtree(HERE / "__pycache__", ignore_errors=True)


if __name__ == "__main__":
    run(sys.argv[1:])
