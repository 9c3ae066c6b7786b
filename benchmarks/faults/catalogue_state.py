"""Faults of the state file: twenty ways to spoil it between two starts."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

from faults.drive import REAL
from faults.fault import Fault, at
from faults.stage import Stage

Damage = Callable[[bytes, Random], bytes]


def spoil(damage: Damage) -> Callable[[Stage], None]:
    """End the service, spoil its file's content, start it again."""

    def do(stage: Stage) -> None:
        stage.service.stop()
        path = stage.state_path
        path.write_bytes(damage(path.read_bytes(), stage.rng))
        stage.start()

    return do


def instead(make: Callable[[Path], object]) -> Callable[[Stage], None]:
    """End the service, put something else in its file's place, start it again."""

    def do(stage: Stage) -> None:
        stage.service.stop()
        stage.state_path.unlink()
        make(stage.state_path)
        stage.start()

    return do


def flip(data: bytes, rng: Random) -> bytes:
    """Turn one bit."""
    out = bytearray(data)
    out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def numbers(change: Callable[[float], object]) -> Damage:
    """Change every number of a JSON file (what is no JSON has its digits turned to 9)."""

    def walk(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: walk(value) for key, value in node.items()}
        if isinstance(node, list):
            return [walk(value) for value in node]
        is_number = isinstance(node, int | float) and not isinstance(node, bool)
        return change(float(node)) if is_number else node

    def whole(data: bytes, _rng: Random) -> bytes:
        try:
            found = json.loads(data)
        except ValueError:
            return bytes(0x39 if 0x30 <= byte <= 0x39 else byte for byte in data)
        return json.dumps(walk(found)).encode()

    return whole


def without_keys(data: bytes, rng: Random) -> bytes:
    """Remove half of the keys of a JSON file."""
    try:
        found = json.loads(data)
    except ValueError:
        return data[::2]
    keys = list(found)
    for key in rng.sample(keys, (len(keys) + 1) // 2):
        del found[key]
    return json.dumps(found).encode()


WAYS: list[tuple[str, str, Callable[[Stage], None]]] = [
    ("empty", "no byte in it", spoil(lambda _d, _r: b"")),
    ("one byte", "its first byte only", spoil(lambda data, _r: data[:1])),
    ("half", "cut in the middle", spoil(lambda data, _r: data[: len(data) // 2])),
    ("last byte", "its last two bytes missing", spoil(lambda data, _r: data[:-2])),
    ("zeros", "as long, all zeros", spoil(lambda data, _r: bytes(len(data)))),
    ("noise", "as long, random bytes", spoil(lambda data, rng: rng.randbytes(len(data)))),
    ("bit", "one bit turned", spoil(flip)),
    ("twice", "its content twice", spoil(lambda data, _r: data + data)),
    ("rubbish after", "random bytes after it", spoil(lambda d, rng: d + rng.randbytes(50))),
    ("numbers null", "every number null", spoil(numbers(lambda _n: None))),
    ("numbers NaN", "every number NaN", spoil(numbers(lambda _n: float("nan")))),
    ("numbers huge", "every number 1e308", spoil(numbers(lambda _n: 1e308))),
    ("numbers shifted", "every number 30 more", spoil(numbers(lambda number: number + 30.0))),
    ("numbers text", "every number a text", spoil(numbers(str))),
    ("keys missing", "half of its keys missing", spoil(without_keys)),
    ("not an object", "a JSON list", spoil(lambda _d, _r: b"[1, 2, 3]")),
    ("deep", "100,000 nested lists", spoil(lambda _d, _r: b"[" * 100_000)),
    ("large", "64 MB of spaces", spoil(lambda _d, _r: b" " * (64 << 20))),
    ("UTF-16", "another encoding",
     spoil(lambda data, _r: data.decode("utf-8", "replace").encode("utf-16"))),
    ("folder", "a folder in its place", instead(Path.mkdir)),
    ("pipe", "a pipe without a writer in its place", instead(os.mkfifo)),
    ("loop", "a link to itself", instead(lambda path: path.symlink_to(path))),
    ("gone", "removed", instead(lambda _path: None)),
]  # fmt: skip

# In real time: by the replay clock a start would take half a minute of the log.
ALL = [
    Fault(f"state: {name}", f"state file: {done}; restarted", REAL, plan=at(0.0, do),
          needs=frozenset({"state"}))
    for name, done, do in WAYS
]  # fmt: skip
