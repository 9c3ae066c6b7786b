"""`cangauge run` as a process that is killed, stopped, starved or set to another time.

Twenty seeds each. Nothing that was saved is lost, one line says what could not be saved, and no SoC
is valid that comes from a state of unknown age.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from random import Random
from typing import Any

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

from cangauge.bus.captures import open_capture
from cangauge.bus.open import BusAddress, open_bus
from cangauge.bus.publish import SocReader
from cangauge.bus.time_source import clock_frame
from cangauge.extras.judge.live import stored_logs
from cangauge.logs.read import open_log
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.state import read_state
from cangauge.settings import FrameIds
from cangauge.types import Sample, Status
from live import waits
from live_service import Traffic

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="signals and mounts of Linux")
HOUR_S = 3600.0
STOPPED_S = float(os.environ.get("STOPPED_S", "600"))
"""Time for which a process is stopped [s]; less for a trial."""
STRETCH_S = 300
"""Bus time after which a night follows, in replays [s]: the judge keeps the stretch as a log."""


class Battery(Traffic):
    """Sends a drive on a UDP bus and reads the estimates of a service.

    Parameters
    ----------
    number : int
        Of the bus; no two tests share one, since they run at the same time.
    samples : list of Sample
        One each `every_s` [s].
    is_replay : bool
        Sends the time of the samples by REPLAY_CLOCK.
    """

    def __init__(
        self, number: int, samples: list[Sample], every_s: float, *, is_replay: bool
    ) -> None:
        self.address = BusAddress("udp_multicast", "239.74.163.7", {"port": 45_000 + number})
        self._bus = open_bus(self.address)
        super().__init__(self._bus)
        self._samples, self._every_s, self._is_replay = samples, every_s, is_replay
        self.estimates: list[dict[str, Any]] = []

    def run(self) -> None:
        """Send the samples over and over, the later ones after a night."""
        encoder, reader = FrameEncoder(VEHICLE), SocReader()
        due_s, clock_us = time.monotonic(), 0
        for number in range(1 << 40):
            sample = self._samples[number % len(self._samples)]
            clock_us += 1_000_000 if number % STRETCH_S else 700_000_000
            if self._is_replay:
                self._bus.send(clock_frame(clock_us, FrameIds().replay_clock))
            for frame in encoder.encode(sample._replace(time_s=clock_us / 1e6), 60.0):
                self._bus.send(frame)
            due_s += self._every_s
            while not self._over.is_set() and (left_s := due_s - time.monotonic()) > 0.0:
                message = self._bus.recv(left_s)
                name, values = reader.read(message) if message else ("", {})
                if name == "soc_estimate":
                    self.estimates.append(values)
            if self._over.is_set():
                return

    def wait(self, more: int = 5) -> None:
        """Wait for so many further estimates."""
        wanted = len(self.estimates) + more
        assert waits(lambda: len(self.estimates) >= wanted), "no estimates"

    def statuses(self, since: int) -> set[Status]:
        return {Status(int(each["status"])) for each in self.estimates[since:]}


REPLAY = {
    "time_source": '"replay-clock"',
    "judge": '{ folder = "FOLDER/judge", keep = 4 }',
    "record": '"FOLDER/drive.log"',
    "record_part_mb": "1",
    "record_keep_mb": "4",
}
"""Everything that a service writes, at some 150 times the speed of the drive."""


def check_saved(folder: Path) -> tuple[int, int]:
    """Read all that a service has saved; return the numbers of logs and of recorded frames."""
    state = folder / "cangauge-state.json"
    if state.exists():
        assert 0.0 <= read_state(state).estimator.soc_pct <= 100.0
    for log in stored_logs(folder / "judge"):
        assert len(open_log(log).read()) >= 240
    recorded = sum(1 for part in folder.glob("drive-*.log") for _ in open_capture(part))
    return len(stored_logs(folder / "judge")), recorded


# First: it takes longest, and other workers run the rest meanwhile.
def test_stopped(tmp_path: Path) -> None:
    random = Random(2)  # noqa: S311 - repeatable
    with ExitStack() as stack:
        lives = []
        for seed in range(SEEDS):
            drive = DRIVE[150 + 10 * seed :]
            battery = stack.enter_context(Battery(60 + seed, drive, 1.0, is_replay=False))
            write_state(tmp_path / str(seed) / "cangauge-state.json", battery.address, seed)
            life = stack.enter_context(
                Life(battery.address, tmp_path / str(seed), max_gap_s="60.0")
            )
            assert waits(lambda: Status.VALID in battery.statuses(0), 120.0), life.text  # noqa: B023
            time.sleep(random.uniform(0.0, 1.0))
            life.process.send_signal(signal.SIGSTOP)
            lives.append((life, battery))
        time.sleep(STOPPED_S)
        for life, battery in lives:
            time.sleep(0.3)  # what was on the way
            since = len(battery.estimates)
            life.process.send_signal(signal.SIGCONT)
            battery.wait(30)
            again = battery.estimates[since:]
            valid = [each for each in again if each["status"] == Status.VALID]
            assert all(each["age_s"] <= 2.0 for each in valid), valid
            assert life.end() == 0
            assert clean(life.text), life.text
            assert read_state(tmp_path / life.log.stem / "cangauge-state.json").saved_s >= 0.0


def test_kill(tmp_path: Path) -> None:
    random, folder = Random(0), tmp_path / "life"  # noqa: S311 - repeatable
    logs = saved = 0
    with Battery(0, DRIVE, 0.006, is_replay=True) as battery:
        for seed in range(SEEDS):
            newest = stored_logs(folder / "judge")[-1:]
            saved += (folder / "cangauge-state.json").exists()
            with Life(battery.address, folder, **REPLAY) as life:
                battery.wait()
                if seed % 4 == 3:  # a life in which a log is stored, and judged
                    assert waits(lambda: stored_logs(folder / "judge")[-1:] != newest)  # noqa: B023
                time.sleep(random.uniform(0.0, 2.0))
                life.end(signal.SIGKILL)
                now, frames = check_saved(folder)
                assert now >= min(logs, 4)
                assert frames > 0
                logs = now
        saved += (folder / "cangauge-state.json").exists()
        with Life(battery.address, folder, **REPLAY) as life:
            battery.wait()
            assert life.end() == 0
    assert logs > 1
    assert clean(life.text)
    # On a busy machine the first kill may come before the first state.
    assert life.text.count("state.restored") == saved > SEEDS // 2
    assert "state.refused" not in life.text


@contextmanager
def read_only(folder: Path) -> Iterator[Callable[[], object]]:
    """Forbid everybody to make, rename or remove files in a folder; yield what allows it again."""
    subprocess.run(["chattr", "+i", folder], check=True)
    try:
        yield lambda: subprocess.run(["chattr", "-i", folder], check=True)
    finally:
        subprocess.run(["chattr", "-i", folder], check=True)


@as_root
@pytest.mark.parametrize("fault", ["full", "read-only"])
def test_disk(fault: str, tmp_path: Path) -> None:
    random = Random(1)  # noqa: S311 - repeatable
    for seed in range(SEEDS):
        folder, words = tmp_path / str(seed), "free some space"
        with ExitStack() as stack:
            if fault == "full":
                mend = stack.enter_context(full_disk(folder, random.randrange(80, 900)))
            number = 20 + (fault == "full")
            battery = stack.enter_context(Battery(number, DRIVE, 0.006, is_replay=True))
            life = stack.enter_context(Life(battery.address, folder, **REPLAY))
            battery.wait(20)
            time.sleep(random.uniform(0.0, 2.0))
            if fault == "read-only":
                mend, words = stack.enter_context(read_only(folder)), "not writable"
            assert waits(lambda: words in life.text, 180.0), life.text  # noqa: B023
            battery.wait(20)  # it goes on
            check_saved(folder)
            before_s = saved_s(folder)
            mend()
            assert waits(lambda: saved_s(folder) > before_s, 60.0), life.text  # noqa: B023
            assert life.end() == 0
            check_saved(folder)
            assert clean(life.text), life.text


CLOCKS_OFF_S = [0.0, -2.0 * YEAR_S, -HOUR_S, HOUR_S, 2.0 * YEAR_S]


@pytest.mark.parametrize("off_s", CLOCKS_OFF_S)
def test_clock(off_s: float, tmp_path: Path) -> None:
    number = 40 + CLOCKS_OFF_S.index(off_s)
    for seed in range(SEEDS):
        folder = tmp_path / str(seed)
        with Battery(number, DRIVE[150 + 10 * seed :], 1.0, is_replay=False) as battery:
            write_state(folder / "cangauge-state.json", battery.address, seed)
            before = (folder / "cangauge-state.json").read_bytes()
            with Life(battery.address, folder, code=SHIFT.format(off_s), max_gap_s="60.0") as life:
                battery.wait(20)
                if off_s == 0.0:
                    assert waits(lambda: Status.VALID in battery.statuses(0), 120.0), life.text
                else:
                    assert Status.VALID not in battery.statuses(0)
                assert life.end() == 0
                words = "of unknown age" if off_s < 0.0 else "state.restored"
                if off_s > 86400.0:
                    words = "state.refused"
                    assert (folder / "cangauge-state.json.refused").read_bytes() == before
                assert words in life.text
                assert clean(life.text), life.text


def test_memory_limit(tmp_path: Path) -> None:
    random, started, refused = Random(3), 0, 0  # noqa: S311 - repeatable
    for seed in range(SEEDS):
        folder = tmp_path / str(seed)
        with Battery(90, DRIVE, 0.006, is_replay=True) as battery:
            size = random.randrange(300, 1500) << 20
            with Life(battery.address, folder, code=LIMIT.format(size), **REPLAY) as life:
                came = waits(lambda: life.process.poll() is not None or len(battery.estimates) > 20)
                assert came
                if life.process.poll() is None:
                    started += 1
                    life.process.send_signal(signal.SIGHUP)
                    battery.wait(30)
                    assert life.process.poll() is None, life.text
                    assert life.end() == 0
                else:
                    refused += 1
                    assert life.process.returncode > 0
                    assert len(errors(life.text)) == 1, life.text
                assert clean(life.text), life.text
                check_saved(folder)
    assert started
    assert refused
