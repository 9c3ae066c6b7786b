"""What was saved survives kill −9, full disks and wrong clocks; an error says what was not."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random
from unittest.mock import Mock

import pytest

from cangauge._files import remove_parts, write_text_atomic
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import CangaugeError
from cangauge.estimation.offline import samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.judge.live import store, stored_logs
from cangauge.logs.read import open_log
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.state import StateKeeper, read_state
from cangauge.types import Sample, Status
from live import LoggedLines, in_process, leaf_model, short_log

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="fork and signals of Unix")
SEEDS = 20
VEHICLE, MODEL = Vehicle.load("generic"), leaf_model()
EPOCH_S = 1_700_000_000.0
DRIVE = [each._replace(time_s=each.time_s + EPOCH_S) for each in samples_of(short_log(200.0))]
HOUR_S, YEAR_S = 3600.0, 365.0 * 86400.0


def killed(write: Callable[[int], object], folder: Path, after_s: float) -> int:
    """Let a child write 0, 1, 2, … and kill it; return the last number that it had written."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(reader)
            for number in range(1 << 30):
                write(number)
                os.write(writer, number.to_bytes(4, "little"))
        finally:
            os._exit(9)
    os.close(writer)
    numbers = os.read(reader, 4)
    time.sleep(after_s)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    while part := os.read(reader, 1 << 16):
        numbers += part
    os.close(reader)
    assert folder.is_dir()
    return int.from_bytes(numbers[len(numbers) // 4 * 4 - 4 :][:4], "little")


def test_a_file_survives_a_kill_at_any_write(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    random = Random(0)  # noqa: S311 - repeatable
    for _ in range(SEEDS):
        last = killed(
            lambda number: write_text_atomic(path, f"{number}\n" * 5_000),
            tmp_path,
            random.uniform(0.0, 0.02),
        )
        lines = path.read_text().splitlines()
        assert len(lines) == 5_000
        assert {*map(int, lines)} <= {last, last + 1}
        remove_parts(path)
        assert [each.name for each in tmp_path.iterdir()] == ["state.json"]


def test_content_is_on_the_disk_before_a_name_leads_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What a power cut then leaves is the old file or the new one.
    synced, fsync, replace = [], os.fsync, Path.replace

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        info = os.fstat(descriptor)
        synced.append((info.st_ino, info.st_size))

    def checked(self: Path, target: Path) -> Path:
        assert (self.stat().st_ino, 20_000) in synced
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(Path, "replace", checked)
    write_text_atomic(tmp_path / "state.json", "x" * 20_000)
    assert (tmp_path / "state.json").stat().st_size == 20_000


def test_logs_of_the_judge_survive_a_kill_at_any_write(tmp_path: Path) -> None:
    rows = [(float(row), 10.0, 380.0, 20.0, 50.0) for row in range(2_000)]
    random = Random(1)  # noqa: S311 - repeatable
    for _ in range(SEEDS):
        killed(lambda _number: store(tmp_path, 3, rows), tmp_path, random.uniform(0.0, 0.02))
        # As what it was writing when it was killed.
        (tmp_path / ".20260101T000000.0123abcd.parquet").write_bytes(b"PAR1")
        assert 1 <= len(stored_logs(tmp_path)) <= 4
        for path in stored_logs(tmp_path):
            assert len(open_log(path).read()) == len(rows)


def test_a_wrong_clock_removes_no_log_of_the_judge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random, monday = Random(4), datetime(2026, 11, 30, tzinfo=UTC)  # noqa: S311 - repeatable
    for seed in range(SEEDS):
        (tmp_path / str(seed)).mkdir()
        offs = [random.choice([-2.0, 0.0, 0.0, 1e-4, 2.0]) for _ in range(6)]
        for number, years in enumerate(offs):
            clock = Mock(now=Mock(return_value=monday + timedelta(days=365.0 * years)))
            monkeypatch.setattr("cangauge.extras.judge.live.datetime", clock)
            rows = [(float(row), 10.0, 380.0, 20.0, 50.0 + number) for row in range(300)]
            store(tmp_path / str(seed), 3, rows)
        kept = [open_log(path).read() for path in stored_logs(tmp_path / str(seed))]
        assert [log.soc_pct[0] for log in kept] == [53.0, 54.0, 55.0]


def test_a_full_disk_leaves_the_old_file_and_says_so(tmp_path: Path) -> None:
    path, random = tmp_path / "state.json", Random(2)  # noqa: S311 - repeatable
    write_text_atomic(path, "old")

    def fill(limit: int) -> bool:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        try:
            write_text_atomic(path, "x" * 100_000)
        except CangaugeError as error:
            return "writing failed" in str(error) and "free some space" in str(error)
        return False

    for _ in range(SEEDS):
        child = os.fork()
        if child == 0:
            os._exit(0 if fill(random.randrange(1, 100_000)) else 1)
        random.random()
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert path.read_text() == "old"
        assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() != 0, reason="root drops its rights")
def test_a_folder_that_became_read_only_is_reported(tmp_path: Path) -> None:
    state = tmp_path / "state.json"
    keeper, pipeline = begun(state, EPOCH_S, known=80.0)
    with LoggedLines("cangauge.service.state") as logged:
        tmp_path.chmod(0o555)
        os.seteuid(65534)
        try:
            drive(pipeline, DRIVE[:100])
            keeper.__exit__()
        finally:
            os.seteuid(0)
    assert "state not written" in " ".join(logged.lines)


def begun(path: Path, wall_s: float, known: float | None = None) -> tuple[StateKeeper, Pipeline]:
    settings = PipelineSettings(EstimatorSettings(initial_soc_pct=known))
    pipeline = Pipeline(VEHICLE, MODEL, settings)
    keeper = StateKeeper(path, pipeline, "virtual x", 86400.0, wall_s=lambda: wall_s)
    return keeper.__enter__(), pipeline


def drive(pipeline: Pipeline, samples: list[Sample]) -> list[Status]:
    encoder, found = FrameEncoder(VEHICLE), list[Status]()
    for sample in samples:
        for frame in encoder.encode(sample):
            if pipeline.handle(frame):
                found.append(pipeline.latest.status)
    return found


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Number of samples → the state that a service saved after them; only to read."""
    folder, random = tmp_path_factory.mktemp("states"), Random(3)  # noqa: S311 - repeatable
    counts = [random.randrange(50, 900) for _ in range(SEEDS)]
    for count in counts:
        keeper, pipeline = begun(folder / f"{count}.json", EPOCH_S, known=80.0)
        drive(pipeline, DRIVE[:count])
        keeper.__exit__()
    return {count: folder / f"{count}.json" for count in counts}


@pytest.mark.parametrize("off_s", [-2.0 * YEAR_S, -HOUR_S, HOUR_S, 2.0 * YEAR_S])
def test_a_wrong_clock_makes_no_valid_soc_of_an_old_state(
    off_s: float, saved: dict[int, Path], tmp_path: Path
) -> None:
    for count, state in saved.items():
        path = Path(shutil.copy(state, tmp_path))
        saved_pct = read_state(path).estimator.soc_pct
        _, again = begun(path, EPOCH_S + off_s)
        found = drive(again, DRIVE[count : count + 20])
        if off_s < 0.0 or off_s > 86400.0:  # its age is not known, or too old
            assert Status.VALID not in found
        if 0.0 < off_s < 86400.0:
            assert again.latest.soc_pct == pytest.approx(saved_pct, abs=1.0)


@pytest.mark.parametrize(
    "error",
    [MemoryError(), ImportError("libarrow.so: failed to map segment from shared object")],
    ids=["memory", "library"],
)
def test_a_reached_memory_limit_is_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def exhausted(**_: object) -> None:
        raise error

    monkeypatch.setattr("cangauge.cli.app.app", exhausted)
    ended = in_process("status")
    assert (ended.code, ended.out) == (1, "")
    assert ended.err.splitlines() == [
        "error: the memory limit is reached; raise it (ulimit -v, MemoryMax=)"
    ]
