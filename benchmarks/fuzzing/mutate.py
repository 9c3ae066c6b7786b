"""Mutations of bytes, of text and of JSON, all drawn from one `random.Random`.

The same generator state gives the same input, so that seed and number identify a finding, and
hypothesis can draw (and shrink) the choices instead.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

MAX_BYTES = 20_000
"""Largest mutant; large files have separate tests."""

NUMBERS = (
    "0", "-1", "1", "2", "7", "8", "9", "63", "64", "65", "127", "128", "255", "256", "1023",
    "65535", "65536", "4294967295", "4294967296", "9223372036854775807", "18446744073709551616",
    "-2147483649", "1e308", "-1e308", "1e-320", "1e999", "0.1", "-0.0", "nan", "inf", "-inf",
    "1,5", "0x10", "0xFFFFFFFFFFFFFFFFFF", "1_000", "١٢", "9" * 30, "9" * 400 + ".5", "9" * 5000,
)  # fmt: skip
WORDS = (
    "", " ", "\t", "\n", "\r", "\r\n", "\x00", "\x1a", "\x85", "\u2028", ",", ";", '"', '""', "'",
    "#", "[", "]", "{", "}", "=", ":", "(", ")", "%", "true", "null", "-", "--", "n/a", "auto",
    "../../x", "/dev/null", "a" * 300, "ä", "\ufeff", "\ufffd", "°", "time_s", "current_a",
    "soc_pct", "R", "M", "m0", "x" * 9000, "(" * 500, "[" * 3000, " " * 3000, "\t" * 500,
)  # fmt: skip
BYTES = (b"\x00", b"\xff", b"\x7f", b"\x80", b"\xff\xff\xff\xff", b"\x00\x00\x00\x00", b"PAR1",
         b"LOBJ", b"PK\x03\x04", b"\x1f\x8b", b"\xef\xbb\xbf", b"\xff\xfe")  # fmt: skip

_TOKEN = re.compile(rb"[0-9A-Za-z_.+-]+|[^0-9A-Za-z_.+\s-]")
_NUMBER = re.compile(rb"(?<![A-Za-z_])-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


def mutate(rng: Random, data: bytes, others: Sequence[bytes] = (), *, text: bool = False) -> bytes:
    """Apply one or a few mutations.

    Parameters
    ----------
    rng : Random
    data : bytes
    others : sequence of bytes
        Other inputs of the kind, to splice.
    text : bool
        Whether to mutate tokens and lines too.
    """
    steps = _TEXT + _BINARY if text else _BINARY
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5, 8))):
        data = rng.choice(steps)(rng, data, others)[:MAX_BYTES]
    return data


def _place(rng: Random, data: bytes) -> int:
    return rng.randrange(len(data) + 1)


def _flip(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    if not data:
        return data
    at = rng.randrange(len(data))
    return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]


def _overwrite(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at, part = _place(rng, data), rng.choice(BYTES)
    return data[:at] + part + data[at + len(part) :]


def _insert(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = _place(rng, data)
    return data[:at] + bytes(rng.randrange(256) for _ in range(rng.randrange(1, 9))) + data[at:]


def _remove(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = _place(rng, data)
    return data[:at] + data[at + rng.randrange(1, 40) :]


def _cut(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return data[: _place(rng, data)]


def _double(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = _place(rng, data)
    part = data[at : at + rng.randrange(1, 120)]
    return data[:at] + part * rng.choice((2, 2, 3, 100)) + data[at:]


def _splice(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    if not others:
        return data
    other = rng.choice(others)
    return data[: _place(rng, data)] + other[_place(rng, other) :]


def _replace(rng: Random, data: bytes, pattern: re.Pattern[bytes], word: str) -> bytes:
    hits = list(pattern.finditer(data))
    if not hits:
        return data
    hit = rng.choice(hits)
    return data[: hit.start()] + word.encode("utf-8", "replace") + data[hit.end() :]


def _number(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return _replace(rng, data, _NUMBER, rng.choice(NUMBERS))


def _nudge(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return _replace(rng, data, _NUMBER, str(rng.randrange(-300, 300) / rng.choice((1, 1, 10, 1e6))))


def _token(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return _replace(rng, data, _TOKEN, rng.choice(NUMBERS + WORDS))


def _word(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    at = _place(rng, data)
    return data[:at] + rng.choice(WORDS).encode("utf-8", "replace") + data[at:]


def _swap(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    """Replace a token by another of the text."""
    hits = list(_TOKEN.finditer(data))
    return data if not hits else _replace(
        rng, data, _TOKEN, rng.choice(hits)[0].decode("utf-8", "replace")
    )  # fmt: skip


def _lines(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    """Remove, repeat or swap lines."""
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    what = rng.randrange(3)
    if what == 0:
        del lines[a]
    elif what == 1:
        lines.insert(b, lines[a])
    else:
        lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


_Step = Callable[[Random, bytes, Sequence[bytes]], bytes]
_BINARY: tuple[_Step, ...] = (_flip, _flip, _overwrite, _insert, _remove, _cut, _double, _splice)
_TEXT: tuple[_Step, ...] = (_number, _number, _nudge, _token, _word, _swap, _lines)

_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 0.5, 1e308, -1e308, 5e-324, 1e-300, 1e18, 2**63, 10**400,
    float("inf"), float("nan"), "", "x", "0", "nan", "a" * 5000, [], {}, [[]], [1, 2], {"x": 1},
    [0.0] * 300, 1e5, -1e5, 100, 3600, "\u0000", "\ud800",
)  # fmt: skip


def mutate_json(rng: Random, tree: Any) -> Any:
    """Replace, remove, rename or repeat a few nodes of JSON data."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        owners = [node for node in _nodes(tree) if node]
        if not owners:
            break
        owner = rng.choice(owners)
        key = rng.choice(list(owner)) if isinstance(owner, dict) else rng.randrange(len(owner))
        what = rng.randrange(6)
        value = owner[key]
        if what == 0 and isinstance(owner, dict):
            owner[rng.choice((f"{key}x", str(key)[:-1], "", "R5"))] = owner.pop(key)
        elif what == 1:
            del owner[key]
        elif what == 2 and isinstance(value, int | float) and not isinstance(value, bool):
            factor = rng.choice((-1, 0, 2, 10, 1e-3, 1e6, 1e30, 0.999, 1.001))
            try:
                owner[key] = value * factor
            except OverflowError:  # an integer beyond float, from an earlier mutation
                owner[key] = value * 10
        elif what == 3 and isinstance(value, list):
            owner[key] = value * rng.choice((2, 50))
        elif what == 4:
            donors = list(_nodes(tree))
            owner[key] = copy.deepcopy(rng.choice(donors))
        else:
            owner[key] = copy.deepcopy(rng.choice(_VALUES))
    return tree


def json_bytes(tree: Any) -> bytes:
    """Return JSON data as text, with NaN as Python writes it."""
    return json.dumps(tree).encode("utf-8", "replace")


def _nodes(tree: Any) -> list[Any]:
    found, open_ = [], [tree]
    while open_ and len(found) < 3000:
        node = open_.pop()
        if isinstance(node, dict | list):
            found.append(node)
            open_.extend(node.values() if isinstance(node, dict) else node)
    return found
