"""Fuzzing targets: how inputs are made, and the code that reads them."""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import os
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from random import Random

import can

from cangauge._files import text_sha256
from cangauge._resources import shared_file
from cangauge.bus.captures import find_capture, open_capture
from cangauge.bus.database import load_dbc
from cangauge.bus.protection import GENERIC_RULE
from cangauge.bus.publish import SocPublisher, SocReader
from cangauge.bus.recording import capture_to_log, read_log
from cangauge.bus.time_source import ClockFrames, StampLimiter
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import estimate_log
from cangauge.estimation.settings import EstimatorSettings
from cangauge.inspect.capture import inspect_capture
from cangauge.inspect.log import inspect_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model
from cangauge.replay.encoder import FrameEncoder
from cangauge.service import state as state_file
from cangauge.service.config import load_config
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.setup import address_of, load_vehicle, pipeline_settings
from cangauge.types import Estimate, Sample
from fuzzing import corpus
from fuzzing.mutate import json_bytes, mutate, mutate_json
from fuzzing.target import FindingError, Target, refusable

FRAMES_AT_ONCE = 200
"""Frames of one stream; each counts as an input."""
MF4_EVERY = 500
"""Each MF4 log costs a process and a second."""
ESTIMATED_ROWS = 200
"""Longer logs are read and inspected, not estimated."""


@cache
def _folder() -> Path:
    """Return a temporary folder of this process, in memory if possible."""
    memory = Path("/dev/shm")  # noqa: S108 - parent of a temporary folder
    where = memory if memory.is_dir() and os.access(memory, os.W_OK) else None
    holder = tempfile.TemporaryDirectory(prefix="cangauge-fuzz-", dir=where)
    _HOLDERS.append(holder)
    folder = Path(holder.name)
    (folder / "car.dbc").write_text(corpus.DBC)
    (folder / "car.toml").write_text(corpus.MAP)
    (folder / "model.json").write_bytes(json_bytes(corpus.model_tree()))
    return folder


_HOLDERS: list[tempfile.TemporaryDirectory[str]] = []


@contextmanager
def _file(data: bytes, name: str = "input") -> Iterator[Path]:
    path = _folder() / name
    path.write_bytes(data)
    yield path


@cache
def _model() -> Model:
    return Model.load(shared_file("replay", "leaf2012_published_model.json"))


def _packed(rng: Random, data: bytes) -> bytes:
    return gzip.compress(data, 1, mtime=0) if rng.randrange(8) == 0 else data


def _make_log(rng: Random) -> bytes:
    files = corpus.log_files()
    signals = corpus.mf4_signals()
    if signals is not None and rng.randrange(MF4_EVERY) == 0:
        return mutate(rng, signals, [signals])
    name = rng.choice(list(files))
    data = files[name]
    if name.endswith((".parquet", ".gz", ".zip", "utf16.csv")):
        return mutate(rng, data, list(files.values()))
    mutant = mutate(rng, data, [files["log.csv"], files["TripA01.csv"]], text=True)
    if name.startswith("2012") and rng.randrange(8) == 0:
        return corpus.zipped("1 Test Data.txt", mutant)
    return _packed(rng, mutant)


# Some formats have the temperature in the file name.
_LOG_NAMES = ("input", "A_P25_x.csv", "Cell-HPPC-10C.csv", "_N05_.csv")


def _run_log(data: bytes) -> bool:
    with _file(data, _LOG_NAMES[zlib.crc32(data) % len(_LOG_NAMES)]) as path:
        log = read_log(path, temperature_c=20.0 if zlib.crc32(data) % 3 else None)
        find_capture(path)
    inspect_log(log).to_dict()
    if len(log) <= ESTIMATED_ROWS:
        _estimate(log)
    return True


def _estimate(log: Log) -> None:
    table, _ = estimate_log(log, _model(), EstimatorSettings())
    for row in range(len(log)):
        _check_soc(float(table.soc_pct[row]))


def _check_soc(soc_pct: float) -> None:
    if not (math.isnan(soc_pct) or 0.0 <= soc_pct <= 100.0):
        raise FindingError(f"a SoC of {soc_pct} %")


def _check_estimate(estimate: Estimate) -> None:
    _check_soc(estimate.soc_pct)
    if estimate.soc_std_pct < 0.0:
        raise FindingError(f"a standard deviation of {estimate.soc_std_pct} %")


@cache
def _vehicles() -> tuple[Vehicle, ...]:
    folder = _folder()
    return (
        Vehicle.load("leaf_aze0"),
        Vehicle.load("generic"),
        Vehicle.load("leaf_ze1", temperature_c=20.0),
        Vehicle.load(map=folder / "car.toml"),
    )


def _make_capture(rng: Random) -> bytes:
    files = corpus.capture_files()
    name = rng.choice([name for name in files if name != "x.mf4"])
    if "x.mf4" in files and rng.randrange(MF4_EVERY) == 0:
        name = "x.mf4"
    is_text = not name.endswith((".blf", ".gz", ".mf4", ".pcap", ".pcapng"))
    mutant = mutate(rng, files[name], list(files.values()), text=is_text)
    return _packed(rng, mutant) if is_text else mutant


def _run_capture(data: bytes) -> bool:
    with _file(data, "capture") as path:
        capture = open_capture(path)
        for _ in capture:
            pass
        _ = capture.info
        with refusable():
            _use_capture(path, zlib.crc32(data) % 40)
    return True


def _use_capture(path: Path, what: int) -> None:
    if what == 0:
        inspect_capture(path).to_dict()
    elif what == 1:
        inspect_capture(path, _vehicles()[0]).to_dict()
    elif what <= 20:
        log = capture_to_log(path, _vehicles()[0])
        if len(log) <= ESTIMATED_ROWS:
            _estimate(log)


def _make_frames(rng: Random) -> bytes:
    """Return the seed of a stream, which draws its frames."""
    return rng.randrange(1 << 62).to_bytes(8, "big")


def _run_frames(data: bytes) -> bool:
    rng = Random(data)  # noqa: S311 - no secret
    which = rng.randrange(len(_vehicles()))
    vehicle = _vehicles()[which]
    estimator = EstimatorSettings(
        method=rng.choice(("ekf", "ekf", "newton", "coulomb")),
        initial_soc_pct=rng.choice((None, 0.0, 50.0, 100.0)),
    )
    source = rng.choice(("receive", "receive", "replay-clock"))
    settings = PipelineSettings(estimator, source)
    pipeline = Pipeline(vehicle, _model(), settings, publishes=False)
    reader, publisher = SocReader(), SocPublisher()
    limiter = rng.choice((None, StampLimiter(0.02), StampLimiter(0.25, 1.7e9)))
    good = _good_frames(which)
    now_s = rng.choice((0.0, 1000.0, 1.7e9))
    for number in range(FRAMES_AT_ONCE):
        frame = _mutant_frame(rng, good[number % len(good)], vehicle)
        now_s += rng.choice((0.01, 0.01, 0.01, 0.0, 1.0, 5.0, -0.5, 1e5, -1e6, 1e-9))
        frame.timestamp = now_s if rng.randrange(20) else rng.choice(_ODD_STAMPS)
        if limiter is not None:
            _limit(rng, limiter, frame, number)
        is_complete = pipeline.handle(frame)
        reader.read(frame)
        if is_complete:
            _check_estimate(pipeline.latest)
            for message in publisher.publish(pipeline.latest, pipeline.samples):
                _read_back(rng, reader, message)
    pipeline.finish()
    if pipeline.samples:
        _check_estimate(pipeline.latest)
    return bool(pipeline.samples)


_ODD_STAMPS = (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e300, 1e11, -1e-6)


def _limit(rng: Random, limiter: StampLimiter, frame: can.Message, number: int) -> None:
    """Limit a stamp; bus time must stay in the interval in which the frame arrived."""
    begin_s = 100.0 + 0.1 * number
    limiter.limit([frame], begin_s, begin_s + rng.choice((0.0, 0.001, 0.1)))
    bus_s = frame.timestamp - (limiter.offset_s + begin_s)
    if not -1.0 <= bus_s <= 1.0:
        raise FindingError(f"bus time {bus_s} s from the time of receiving")


def _read_back(rng: Random, reader: SocReader, message: can.Message) -> None:
    if reader.read(message) is None:
        raise FindingError("a published frame cannot be read")
    damaged = bytearray(message.data)
    damaged[rng.randrange(6)] ^= 1 << rng.randrange(8)
    message.data = bytearray(GENERIC_RULE.protect(damaged, rng.randrange(16)))
    reader.read(message)


@cache
def _good_frames(which: int) -> tuple[can.Message, ...]:
    encoder, clock = FrameEncoder(_vehicles()[which]), ClockFrames()
    frames: list[can.Message] = []
    for t, i, u, temp, soc in corpus.log_rows():
        frames.append(clock.at(round(t * 1e6)))
        frames += encoder.encode(Sample(t, i, u, temp), soc)
    return tuple(frames)


def _mutant_frame(rng: Random, frame: can.Message, vehicle: Vehicle) -> can.Message:
    data = bytearray(frame.data)
    number, extended = frame.arbitration_id, frame.is_extended_id
    kinds: dict[str, bool] = {}
    # None at all: repeated or, with another counter, inserted frames.
    for _ in range(rng.choice((0, 0, 1, 1, 2))):
        what = rng.randrange(7)
        if what <= 2 and data:
            data[rng.randrange(len(data))] = rng.choice((0, 255, 127, 128, rng.randrange(256)))
        elif what == 3:
            data = data[: rng.randrange(9)]
        elif what == 4:
            data += bytes(rng.randrange(57))
        elif what == 5:
            number, extended = rng.choice(
                ((0, False), (number, True), (0x5A0, False), (0x5A1, False))
            )
        else:
            kinds = rng.choice(
                ({"is_error_frame": True}, {"is_remote_frame": True}, {"is_fd": True})
            )
    rule = next((m.rule for key, m in vehicle.messages.items() if key == number), None)
    if rule is not None and rng.randrange(3) and rule.fits(len(data)):
        # With a valid CRC the damage reaches the decoder.
        data = bytearray(rule.protect(data, rng.randrange(16)))
    return can.Message(arbitration_id=number, is_extended_id=extended, data=data, **kinds)


def _make_dbc(rng: Random) -> bytes:
    seeds = _dbc_seeds()
    data = rng.choice(list(seeds.values()))
    return mutate(rng, data, list(seeds.values()), text=True)


@cache
def _dbc_seeds() -> dict[str, bytes]:
    shipped = {
        name: shared_file("dbc", name).read_bytes()
        for name in ("soc_estimate.dbc", "generic_pack.dbc")
    }
    # The small one more often, as it reads faster.
    return {"car.dbc": corpus.DBC.encode(), "again.dbc": corpus.DBC.encode()} | shipped


def _run_dbc(data: bytes) -> bool:
    with _file(data, "mutant.dbc") as path:
        load_dbc(path)
        if b"PackCurrent" in data:
            car = Vehicle.load(dbc=path, map=_own_map())
            pipeline = Pipeline(car, _model(), publishes=False)
            for key in car.messages:
                for length in (0, 8, 64):
                    pipeline.handle(
                        can.Message(
                            arbitration_id=key & 0x1FFFFFFF,
                            is_extended_id=key > 0x1FFFFFFF,
                            data=data[-length:] if length else b"",
                            timestamp=1.0,
                            is_fd=True,
                        )
                    )
    return True


@cache
def _own_map() -> Path:
    path = _folder() / "without_dbc.toml"
    path.write_text(corpus.MAP.replace('dbc = "car.dbc"\n', ""))
    return path


def _make_map(rng: Random) -> bytes:
    return mutate(rng, corpus.MAP.encode(), [corpus.CONFIG.encode()], text=True)


def _run_map(data: bytes) -> bool:
    with _file(data, "map.toml") as path:
        Vehicle.load(map=path)
    return True


def _make_config(rng: Random) -> bytes:
    data = rng.choice((corpus.CONFIG, corpus.CONFIG, corpus.OWN_CAR)).encode()
    return mutate(rng, data, [corpus.MAP.encode()], text=True)


def _run_config(data: bytes) -> bool:
    with _file(data, "config.toml") as path:
        config = load_config(path, {"timeout_s": 3.0} if data[:1] == b"m" else None)
        address_of(config)
        pipeline_settings(config)
        load_vehicle(config)
    return True


def _make_model(rng: Random) -> bytes:
    tree = corpus.model_tree()
    if rng.randrange(4) == 0:
        return mutate(rng, json_bytes(tree), text=True)
    if rng.randrange(2):
        tree = {**tree, "effects": rng.sample(tree["effects"], 2)}
    return json_bytes(mutate_json(rng, tree))


def _run_model(data: bytes) -> bool:
    with _file(data, "mutant.json") as path:
        model = Model.load(path)
    volts = model.voltage_model().pseudo_ocv([-5.0, 0.0, 50.0, 100.0, 105.0])
    if not all(map(math.isfinite, volts.tolist())):
        raise FindingError(f"a pseudo-OCV of {volts} V")
    estimator = Estimator(model, EstimatorSettings())
    for t, i, u, temp, _ in corpus.log_rows():
        _check_estimate(estimator.step(Sample(t, i, u, temp)))
    return True


def _make_state(rng: Random) -> bytes:
    tree = json.loads(_state_text())
    if rng.randrange(4) == 0:
        return mutate(rng, json_bytes(tree), text=True)
    tree["content"] = mutate_json(rng, tree["content"])
    if rng.randrange(8):
        # With a valid hash, which is checked first.
        with suppress(TypeError, ValueError):
            text = json.dumps(tree["content"], sort_keys=True, separators=(",", ":"))
            tree["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    return json_bytes(tree)


@cache
def _state_text() -> str:
    estimator = Estimator(_model(), EstimatorSettings())
    for t, i, u, temp, _ in corpus.log_rows():
        estimator.step(Sample(t, i, u, temp))
    return state_file.state_text(
        state_file.StateContent(
            saved_s=1.7e9, boot_id="x", model=text_sha256(_model().to_json()),
            model_name="x", bus="can0", battery="x", vehicle_name="x", time_source="receive",
            estimator=estimator.snapshot(),
        )
    )  # fmt: skip


def _run_state(data: bytes) -> bool:
    with _file(data, "state.json") as path:
        content = state_file.read_state(path)
    estimator = Estimator(_model(), EstimatorSettings())
    _check_estimate(estimator.restore(content.estimator))
    for t, i, u, temp, _ in corpus.log_rows():
        _check_estimate(estimator.step(Sample(2e9 + t, i, u, temp)))
    return True


def targets() -> tuple[Target, ...]:
    """Return all targets."""
    return (
        Target("frames", _make_frames, _run_frames, 0.44, weight=FRAMES_AT_ONCE),
        Target("captures", _make_capture, _run_capture, 0.16, seeds=corpus.capture_files),
        Target("logs", _make_log, _run_log, 0.10, seeds=corpus.log_files),
        Target("model", _make_model, _run_model, 0.08),
        Target("config", _make_config, _run_config, 0.07),
        Target("map", _make_map, _run_map, 0.10),
        Target("dbc", _make_dbc, _run_dbc, 0.05, seeds=_dbc_seeds),
        Target("state", _make_state, _run_state, 0.05),
    )
