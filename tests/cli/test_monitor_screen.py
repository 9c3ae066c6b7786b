"""`cangauge monitor` on a running service: screen, keys, silence, restart, text."""

from __future__ import annotations

import asyncio
import io
import math
import re
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from cangauge.cli.app import COMMANDS
from cangauge.cli.monitor import status_line
from cangauge.errors import InputError
from cangauge.service.status import reason_ids
from cangauge.service.status_feed import LONGEST_HISTORY, Point, StatusFeed
from cangauge.types import Reason
from live import Command, in_process, waits
from running import RunningService

pytest.importorskip("textual", reason="needs the extra cangauge[monitor]")
from cangauge.cli.monitor_screen import (
    _WORDS,
    MonitorScreen,
    chart,
    in_columns,
    timeline,
)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with RunningService(tmp_path_factory.mktemp("monitored"), with_cells=True) as running:
        assert waits(
            lambda: "SoC" in in_process("monitor", "--once", "--endpoint", running.endpoint).out
        )
        yield running


def shown(app: MonitorScreen) -> list[str]:
    """Return the rows that the screen shows, as its terminal would."""
    width = app.size.width
    return [
        "".join(segment.text for segment in strip)[:width].rstrip()
        for strip in app.screen._compositor.render_strips()
    ]


def on_screen(feed: StatusFeed, act: object, size: tuple[int, int] = (80, 24)) -> None:
    """Run a coroutine function of the app and its pilot."""

    async def session() -> None:
        app = MonitorScreen(feed)
        async with app.run_test(size=size) as pilot:
            await act(app, pilot)  # type: ignore[operator]

    with feed:
        asyncio.run(session())


async def until(app: MonitorScreen, pilot: object, pattern: str, seconds: float = 5.0) -> float:
    """Wait for a text on the screen; return how long it took [s]."""
    began_s = time.monotonic()
    while not re.search(pattern, "\n".join(shown(app))):
        assert time.monotonic() - began_s < seconds, "\n".join(shown(app))
        await pilot.pause(0.05)  # type: ignore[attr-defined]
    return time.monotonic() - began_s


def test_a_small_terminal_shows_everything(running: RunningService) -> None:
    async def act(app: MonitorScreen, pilot: object) -> None:
        await until(app, pilot, r"frames +[1-9]\d* /s +energy left +[1-9]")
        rows = shown(app)
        assert len(rows) == 24
        text = "\n".join(rows)
        soc = re.search(r"SoC ([\d.]+) ± [\d.]+ %", text)
        assert soc is not None
        assert float(soc[1]) == pytest.approx(running.service.pipeline.latest.soc_pct, abs=0.3)
        for word in ("VALID|DEGRADED|INITIALISING", r"by voltage +[\d.]+ %", r"by charge +[\d.]+ %",
                     r"current +−?[\d.]+ A", r"voltage +3\d\d", r"modelled +3\d\d",
                     r"residual +−?\d+ mV", r"temperature +[\d.]+ °C", r"capacity +\d+",
                     r"frames +[1-9]\d* /s", r"rejected +\d+", r"weakest cell +40: ",
                     "SoC %.*█|█", "V valid  D degraded", r"last 10.0 min|of 10.0 min",
                     "Pause.*Quit"):  # fmt: skip
            assert re.search(word, text), (word, text)
        assert all(len(row) <= 80 for row in rows)

    on_screen(StatusFeed(running.endpoint), act)


def test_keys_pause_change_the_range_and_help(running: RunningService) -> None:
    async def act(app: MonitorScreen, pilot: object) -> None:
        await until(app, pilot, r"frames +[1-9]\d* /s")
        await pilot.press("r")  # type: ignore[attr-defined]
        await until(app, pilot, r"of 60.0 min")
        await pilot.press("p")  # type: ignore[attr-defined]
        await until(app, pilot, "PAUSED")
        before = shown(app)
        await pilot.pause(0.6)  # type: ignore[attr-defined]
        assert shown(app) == before
        await pilot.press("question_mark")  # type: ignore[attr-defined]
        await until(app, pilot, "Positive current discharges")
        await pilot.press("escape")  # type: ignore[attr-defined]
        await pilot.press("p")  # type: ignore[attr-defined]
        await pilot.pause(0.4)  # type: ignore[attr-defined]
        assert "PAUSED" not in "\n".join(shown(app))
        await pilot.press("q")  # type: ignore[attr-defined]
        await pilot.pause(0.1)  # type: ignore[attr-defined]
        assert not app.is_running

    on_screen(StatusFeed(running.endpoint), act)


def test_a_silent_bus_is_seen_within_a_second(running: RunningService) -> None:
    async def act(app: MonitorScreen, pilot: object) -> None:
        await until(app, pilot, r"frames +[1-9]\d* /s")
        running.silent.set()
        try:
            assert await until(app, pilot, r"BUS SILENT: no sample for [01]\.") < 1.5
            await until(app, pilot, "INVALID")
            await until(app, pilot, "no wanted frame within the time-out")
            await until(app, pilot, r"status .*X")
        finally:
            running.silent.clear()
        await until(app, pilot, r" (VALID|DEGRADED)   by voltage")
        assert "SILENT" not in "\n".join(shown(app))

    on_screen(StatusFeed(running.endpoint), act)


def test_it_waits_for_a_service_and_connects_again(tmp_path: Path) -> None:
    folder = tmp_path / "restarted"
    folder.mkdir()
    first = RunningService(folder)

    async def act(app: MonitorScreen, pilot: object) -> None:
        await until(app, pilot, "NO ANSWER")
        with first:
            await until(app, pilot, r"SoC \d", 10.0)
        assert await until(app, pilot, r"NO ANSWER for [01]\.") < 1.5
        assert re.search(r"LAST KNOWN", "\n".join(shown(app)))
        with RunningService(folder, port=first.port):
            await until(app, pilot, r" (VALID|DEGRADED|INITIALISING)   by", 10.0)
            await until(app, pilot, r"status +.*·")  # the gap stays on the timeline

    on_screen(StatusFeed(first.endpoint), act)


def test_once_prints_a_snapshot_for_scripts(running: RunningService) -> None:
    ended = in_process("monitor", "--once", "--endpoint", running.endpoint)
    assert ended.code == 0, ended.err
    assert re.search(r"SoC +\d\d\.\d\d ± ", ended.out)
    assert "weakest cell" in ended.out
    ended = in_process("monitor", "--once", "--endpoint", "http://127.0.0.1:9")
    assert ended.code == 1
    assert "no service answers" in ended.err
    assert in_process("monitor", "--endpoint", "gopher://x").code == 2


def test_without_a_terminal_it_prints_lines(running: RunningService) -> None:
    command = Command("monitor", "--endpoint", running.endpoint)
    assert command.process.stdout is not None
    lines = [command.process.stdout.readline() for _ in range(2)]
    command.process.stdout.close()  # as `| head` does
    for line in lines:
        assert re.match(r"\d{4}-\d\d-\d\dT[\d:]+\+00:00 SoC [\d.]+ ± [\d.]+ %, \w+, ", line)
    assert command.process.wait(10.0) == 0
    assert "Traceback" not in (command.process.stderr or io.StringIO()).read()


def test_a_line_without_a_service_names_the_problem() -> None:
    feed = StatusFeed("http://127.0.0.1:9")
    feed.try_poll()
    assert re.match(r"NO ANSWER: .*Connection refused", status_line(feed.view()))
    with pytest.raises(InputError):
        StatusFeed("gopher://x").poll()


def test_the_history_is_bounded_and_keeps_its_beginning() -> None:
    now = [0.0]
    feed = StatusFeed("http://127.0.0.1:9", clock=lambda: now[0])
    for _ in range(5 * LONGEST_HISTORY):
        now[0] += 0.25
        feed._add(Point(now[0], 50.0, 1.0, "valid"))
    points = feed.view().points
    assert len(points) <= LONGEST_HISTORY
    assert points[0].time_s == 0.25
    assert all(a.time_s < b.time_s for a, b in pairwise(points))


def test_a_chart_shows_scale_gaps_and_constants() -> None:
    rows = list(chart("SoC %", [0.0, math.nan, 50.0, 100.0], 4, 1))
    assert rows[0].strip().startswith("100.0")
    assert rows[-1].strip().startswith("0.0")
    assert rows[0].endswith("█")
    assert rows[-1].endswith("▁ ██")
    constant = list(chart("A", [7.0] * 10, 4, 1))
    assert "█" not in constant[0]
    assert constant[-1].endswith("█" * 10)
    assert "".join(chart("A", [math.nan] * 3, 3, 1)).count("█") == 0


def test_a_column_shows_its_worst_status() -> None:
    points = [Point(float(at), 50.0, 0.0, "valid") for at in range(100)]
    points[50] = Point(50.0, 50.0, 0.0, "invalid")
    points[75] = Point(75.0, math.nan, math.nan, "")
    letters = timeline(in_columns(points, 100.0, 100.0, 20))
    assert letters == "V" * 10 + "X" + "V" * 4 + "·" + "V" * 4


def test_every_reason_has_words() -> None:
    assert set(reason_ids(~Reason.NONE)) <= set(_WORDS)
    assert "monitor" in COMMANDS
