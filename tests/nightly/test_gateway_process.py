"""The gateway as a process on two CAN buses, killed, stopped, starved or set to another time.

Twenty seeds each: the inverter gets current frames or none, and no SoC from a state of unknown age.
"""

from __future__ import annotations

import signal
import struct
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from random import Random

import can
import pytest
from whole_processes import (
    DRIVE,
    LIMIT,
    SEEDS,
    SHIFT,
    VEHICLE,
    YEAR_S,
    Life,
    as_root,
    clean,
    errors,
    full_disk,
    saved_s,
    write_state,
)

from cangauge.bus.open import BusAddress, has_socketcan
from cangauge.extras.inverter.gateway import DOUBT_S
from cangauge.replay.encoder import FrameEncoder
from live import waits
from live_service import Traffic

pytestmark = [
    pytest.mark.socketcan,
    pytest.mark.skipif(not has_socketcan("vcan0"), reason="no vcan0"),
]
OWN_PCT, EVERY_S = 11, 0.1
LATE_S = DOUBT_S + 0.3


class Battery(Traffic):
    """Sends a drive, its own SoC (0x355) and the time (0x351) on vcan0; listens on vcan1."""

    address = BusAddress("socketcan", "vcan0")

    def __init__(self) -> None:
        if not has_socketcan("vcan1"):
            for command in ("link add vcan1 type vcan", "link set vcan1 up"):
                subprocess.run(["ip", *command.split()], check=True)
        self._battery, self._inverter = (
            can.Bus(channel, interface="socketcan") for channel in ("vcan0", "vcan1")
        )
        super().__init__(self._battery, self._inverter)
        self.late_s: list[float] = []
        self.soc_pct: list[int] = []

    def run(self) -> None:
        """Send the samples until the end."""
        encoder, due_s = FrameEncoder(VEHICLE), time.monotonic()
        for sample in DRIVE[150:] * 9:
            for frame in encoder.encode(sample._replace(time_s=due_s)):
                self._send(frame.arbitration_id, bytes(frame.data))
            self._send(0x355, struct.pack("<2H", OWN_PCT, 99))
            self._send(0x351, struct.pack("<d", time.time()))
            due_s += EVERY_S
            while not self._over.is_set() and (left_s := due_s - time.monotonic()) > 0.0:
                message = self._inverter.recv(left_s)
                if message is not None and message.arbitration_id == 0x351:
                    # By the kernel's stamp: this thread may read late.
                    self.late_s.append(message.timestamp - struct.unpack("<d", message.data)[0])
                elif message is not None and message.arbitration_id == 0x355:
                    self.soc_pct.append(struct.unpack_from("<H", message.data)[0])
            if self._over.is_set():
                return

    def _send(self, number: int, data: bytes) -> None:
        message = can.Message(arbitration_id=number, is_extended_id=False, data=data)
        self._battery.send(message)

    def wait(self, more: int = 5) -> None:
        """Wait for so many further SoC at the inverter."""
        wanted = len(self.soc_pct) + more
        assert waits(lambda: len(self.soc_pct) >= wanted), "the inverter gets nothing"


def gateway(battery: Battery, folder: Path, code: str = "") -> Life:
    publish = '{ profile = "pylontech", interface = "socketcan", channel = "vcan1" }'
    # The guest starts slowly: the state is still continued from without a gap.
    return Life(battery.address, folder, code=code, publish=publish, max_gap_s="60.0")


@pytest.mark.parametrize("fault", ["kill", "stop", "clock", "memory"])
def test_gateway(fault: str, tmp_path: Path) -> None:
    random, ended = Random(fault), 0  # noqa: S311 - repeatable
    with Battery() as battery:
        for seed in range(SEEDS):
            folder, code = tmp_path / str(seed), ""
            write_state(folder / "cangauge-state.json", battery.address, seed)
            if fault == "clock":
                code = SHIFT.format(random.choice([-2.0, -1e-4, 2.0]) * YEAR_S)
            elif fault == "memory":
                code = LIMIT.format(random.randrange(260, 420) << 20)
            begun, timed = len(battery.soc_pct), len(battery.late_s)
            with gateway(battery, folder, code) as life:
                waits(lambda: life.process.poll() is not None or len(battery.soc_pct) > begun + 9)  # noqa: B023
                if life.process.poll() is not None:
                    assert fault == "memory", life.text
                    assert len(errors(life.text)) == 1, life.text
                    ended += 1
                    continue
                if fault == "clock":
                    assert set(battery.soc_pct[begun:]) == {OWN_PCT}
                elif fault != "memory":
                    assert waits(lambda: battery.soc_pct[-1] != OWN_PCT, 60.0), life.text
                time.sleep(random.uniform(0.0, 1.0))
                if fault == "kill":
                    life.end(signal.SIGKILL)
                    time.sleep(0.3)
                    gone = len(battery.soc_pct)
                    time.sleep(0.5)
                    assert len(battery.soc_pct) == gone
                elif fault == "stop":
                    life.process.send_signal(signal.SIGSTOP)
                    time.sleep(random.uniform(2.0, 4.0))
                    life.process.send_signal(signal.SIGCONT)
                    battery.wait(10)
                if fault != "kill":
                    assert life.end() == 0
                assert clean(life.text), life.text
            late_s = [late_s for late_s in battery.late_s[timed:] if late_s >= LATE_S]
            # The one in hand when the process is stopped is sent when it goes on.
            assert len(late_s) <= (fault == "stop"), late_s
    assert ended > 0 or fault != "memory"


@as_root
def test_gateway_hands_on_with_its_disk_full(tmp_path: Path) -> None:
    random = Random("disk")  # noqa: S311 - repeatable
    with Battery() as battery:
        for seed in range(SEEDS):
            folder = tmp_path / str(seed)
            with full_disk(folder, random.randrange(80, 900)) as mend:
                write_state(folder / "cangauge-state.json", battery.address, seed)
                begun = len(battery.soc_pct)
                with gateway(battery, folder) as life:
                    # Filled while it starts, or while it runs.
                    time.sleep(random.uniform(0.0, 4.0))
                    with suppress(OSError), (folder / "other").open("wb", buffering=0) as other:
                        while True:
                            other.write(bytes(4096))
                    assert waits(lambda: "free some space" in life.text, 60.0), life.text
                    before_s = saved_s(folder)
                    assert before_s > 0.0
                    assert waits(lambda: {OWN_PCT} < set(battery.soc_pct[begun:]), 60.0)  # noqa: B023
                    battery.wait(20)
                    mend()
                    assert waits(lambda: saved_s(folder) > before_s, 60.0), life.text  # noqa: B023
                    assert life.end() == 0
                    assert clean(life.text), life.text
        assert max(battery.late_s) < LATE_S
