"""Actions of faults on the service, its files, the bus interface and the machine."""

from __future__ import annotations

import json
import re
import socket
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, Final, Literal

from faults.bench import Bench
from faults.fault import Plan, at
from faults.large_dbc import write_large_dbc
from faults.line import HarnessBus, run
from faults.process import run_command

LARGE_DBC_MB: Final = 3.9
"""Just below the largest that is read [MB]."""
RELOAD_S: Final = 8.0
"""Time in which a small configuration is read, on a busy machine [s]."""
REFUSED: Final = 2
"""Exit status of a command with bad input."""


def down_for(seconds: float, times: int = 1, up_s: float = 0.0) -> Plan:
    """Take the interface down and up again."""

    def do(bench: Bench) -> None:
        with bench.without_bus():
            for _ in range(times):
                bench.line.link("set DEV down")
                bench.wait(seconds)
                bench.line.link("set DEV up")
                bench.wait(up_s)

    return at(0.0, do)


def unplugged_for(seconds: float) -> Plan:
    """Remove the interface and create it again."""

    def do(bench: Bench) -> None:
        with bench.without_bus():
            bench.line.remove()
            bench.wait(seconds)
            bench.line.create()

    return at(0.0, do)


def queue_full_for(seconds: float) -> Plan:
    """Let the interface refuse every frame: no acknowledgement, full queue."""

    def do(bench: Bench) -> None:
        with bench.without_bus():
            run(["tc", "qdisc", "add", "dev", bench.line.channel, "root", "pfifo", "limit", "0"])
            bench.wait(seconds)
            run(["tc", "qdisc", "del", "dev", bench.line.channel, "root"])

    return at(0.0, do)


def clock_set(seconds: float) -> Plan:
    """Set the machine's clock."""

    def turn(by_s: float) -> None:
        time.clock_settime(time.CLOCK_REALTIME, time.time() + by_s)

    def do(bench: Bench) -> None:
        turn(seconds)
        bench.at_end(lambda: turn(-seconds))

    return at(0.0, do)


BEGIN: Final = 0.05


def broken_config(text: str | None) -> Plan:
    """Replace the configuration by a text (None: remove it) and reload."""

    def do(bench: Bench) -> None:
        if text is None:
            bench.config_path.unlink()
        else:
            bench.config_path.write_text(text)
        bench.reload()

    return at(BEGIN, do)


def good_config(bench: Bench) -> None:
    """Change a setting and reload."""
    bench.write_config(max_gap_s=3.0)
    bench.reload()


def unknown_key(bench: Bench) -> None:
    """Add an unknown key and reload."""
    bench.write_config(no_such_key=1)
    bench.reload()


def reload_often(bench: Bench) -> None:
    """Reload twenty times in a row."""
    for _ in range(20):
        bench.reload()
        bench.wait(0.2)


def large_dbc(bench: Bench) -> None:
    """Reload with a lawful DBC of nearly the largest size."""
    write_large_dbc(bench.folder, LARGE_DBC_MB)
    bench.write_config(
        vehicle=None, dbc=str(bench.folder / "large.dbc"), map=str(bench.folder / "map.toml")
    )
    bench.reload()


def impossible_model(change: Callable[[dict[str, Any]], None]) -> Callable[[Bench], None]:
    """Reload with a model that no pack has; it must be refused."""

    def do(bench: Bench) -> None:
        content = json.loads(Path(bench.config["model"]).read_text())
        change(content)
        model = bench.folder / "impossible.json"
        model.write_text(json.dumps(content))
        bench.write_config(model=str(model))
        bench.reload()
        bench.wait(RELOAD_S)
        if "config.refused" not in bench.service.output():
            bench.incidents.append("an impossible model was taken")

    return do


def same_files(option: Literal["state", "record"]) -> Callable[[Bench], None]:
    """Start a second service with a file of the first; it must be refused, with exit status 2."""

    def do(bench: Bench) -> None:
        path = bench.state_path if option == "state" else bench.folder / bench.config["record"]
        second = bench.folder / "second.toml"
        second.write_text(f"duration_s = 0.5\n{bench.config_path.read_text()}")
        arguments = ["run", "--config", str(second), f"--{option}", str(path)]
        arguments += ["--interface", "virtual", "--channel", "elsewhere"]
        ended = run_command(arguments)
        if ended != REFUSED:
            bench.incidents.append(f"a second service with its --{option} ended with {ended}")

    return do


def slow_clients(bench: Bench) -> None:
    """Hold 64 connections with half a request, and probe the health once a second."""
    found = re.search(r"http://127\.0\.0\.1:(\d+)/status", bench.service.output())
    if found is None:
        bench.incidents.append("HTTP is not served")
        return
    port = int(found[1])
    clients = [socket.create_connection(("127.0.0.1", port)) for _ in range(64)]
    for client in clients:
        client.sendall(b"GET /status HTTP/1.1\r\nX: ")
    bench.at_end(lambda: [client.close() for client in clients])
    for _ in range(5):
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=2.0) as answer:
                answer.read()
        except OSError as error:
            bench.incidents.append(f"a health probe failed: {error}")
            return
        bench.wait(1.0)


def second_service(bench: Bench) -> None:
    """Start a second service with the same configuration."""
    other = bench.another_service("second")
    bench.others.append(other)
    other.start()


def deaf_listener(bench: Bench) -> None:
    """Open the bus without reading."""
    deaf = HarnessBus(bench.line, published_only=False)
    bench.at_end(deaf.close)


def garbage(bench: Bench) -> None:
    """Send packets that are not frames to the address of the bus."""
    if bench.line.is_vcan:
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for number in range(2000):
            packet = bench.rng.randbytes(number % 200)
            sender.sendto(packet, (bench.line.channel, int(bench.line.options["port"])))
            if number % 20 == 0:
                bench.wait(0.2)


Damage = Callable[[bytes, Random], bytes]


def spoil(damage: Damage) -> Callable[[Bench], None]:
    """Stop the service, damage the content of its state file, start it again."""

    def do(bench: Bench) -> None:
        bench.service.stop()
        path = bench.state_path
        path.write_bytes(damage(path.read_bytes(), bench.rng))
        bench.start()

    return do


def instead(make: Callable[[Path], object]) -> Callable[[Bench], None]:
    """Stop the service, replace its state file, start it again."""

    def do(bench: Bench) -> None:
        bench.service.stop()
        bench.state_path.unlink()
        make(bench.state_path)
        bench.start()

    return do


def flip(data: bytes, rng: Random) -> bytes:
    """Flip one bit."""
    out = bytearray(data)
    out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def numbers(change: Callable[[float], object]) -> Damage:
    """Change every number of a JSON file; in other files set every digit to 9."""

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
