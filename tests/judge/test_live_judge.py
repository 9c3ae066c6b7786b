"""`[judge]`: the battery's own SoC judged while the service runs, over restarts."""

from __future__ import annotations

import json
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from cangauge._resources import shared_file
from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.estimation.offline import samples_of
from cangauge.extras.judge.live import PAGE, RESULT, LiveJudge, stored_logs
from cangauge.logs.log import Log
from cangauge.service.run import Service
from cangauge.service.status_client import Snapshot
from cangauge.types import Estimate, Reason, Status
from live import LoggedLines, leaf_model_path, waits
from running import RunningService
from synthetic import synthetic_log

NONE = Estimate(*[float("nan")] * 7, Status.VALID, Reason.NONE, 0)
DAY_S = 86400.0


JUDGE = (sys.executable, "-m", "cangauge", "judge", "-m", str(leaf_model_path()))
OPINION = {
    "now": {"verdict": "agrees", "error_pct": 0.4, "sigma_pct": 1.0},
    "text": "The gauge is right: its error is +0.4 ± 1.0 % SoC now.\nNothing to do.",
}


def printing(answer: dict[str, object], code: int = 0) -> tuple[str, ...]:
    """Return a command that prints an answer in place of `cangauge judge`."""
    return ("/bin/sh", "-c", f"printf %s '{json.dumps(answer)}'; exit {code}")


def day(number: int) -> Log:
    return synthetic_log(
        hours=0.7, rate_hz=2.0, start_pct=85.0, end_pct=50.0, noise_v=0.3, seed=number
    )


def drive(judge: LiveJudge, published: dict[str, float], number: int, error_pct: float) -> None:
    log = day(number)
    assert log.soc_pct is not None
    for sample, soc_pct in zip(samples_of(log), log.soc_pct, strict=True):
        published["soc"] = soc_pct + error_pct
        judge.on_sample(sample._replace(time_s=sample.time_s + number * DAY_S), NONE)


def test_a_gauge_that_is_off_is_said_after_the_drive(tmp_path: Path) -> None:
    published = {"soc": float("nan")}
    with (
        LoggedLines("cangauge.extras.judge") as lines,
        closing(LiveJudge(tmp_path, 2, JUDGE, lambda: published["soc"])) as judge,
    ):
        drive(judge, published, 1, 15.0)
        judge.on_snapshot(Snapshot(0.0, {}))
        assert not stored_logs(tmp_path)  # the drive goes on
        judge._came_s -= 601.0  # ten minutes of silence
        judge.on_snapshot(Snapshot(judge._came_s + 601.0, {}))
        assert waits(lambda: bool(judge.trouble), 60.0), lines.lines
        assert "% SoC too high now." in judge.trouble
    result = json.loads((tmp_path / RESULT).read_text())
    assert result["now"]["error_pct"] == pytest.approx(15.0, abs=3.0)
    assert "judge" in (tmp_path / PAGE).read_text()
    (path,) = stored_logs(tmp_path)
    kept = read_log(path)
    assert kept.soc_pct is not None
    assert np.median(np.diff(kept.time_s)) == pytest.approx(1.0)
    assert kept.duration_s == pytest.approx(day(1).duration_s, abs=2.0)


def test_a_gauge_that_is_right_is_no_trouble_and_logs_outlive_a_restart(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    command, old = printing(OPINION), tmp_path / "20200101T000000.parquet"
    published = {"soc": float("nan")}
    judge = LiveJudge(tmp_path, 1, command, lambda: published["soc"])
    drive(judge, published, 1, 0.0)
    judge.close()  # written, not judged
    assert not (tmp_path / RESULT).exists()
    (written,) = stored_logs(tmp_path)
    written.rename(old)
    with (
        caplog.at_level("INFO", "cangauge.extras.judge"),
        closing(LiveJudge(tmp_path, 1, command, lambda: published["soc"])) as again,
    ):
        assert waits((tmp_path / RESULT).is_file)  # begun at the start
        drive(again, published, 2, 0.0)
        drive(again, published, 3, 0.0)  # a pause of a night between them
        assert waits(lambda: caplog.text.count("second opinion") == 2)
        assert again.trouble == ""
    assert len(stored_logs(tmp_path)) == 1  # `keep`
    assert not old.exists()


def test_what_is_known_outlives_a_stop_and_says_since_when(tmp_path: Path) -> None:
    text = "The gauge stands still at 61.0 % since Sat 18 Nov 06:24 UTC.\nSee whether it does."
    off = OPINION | {"now": {"verdict": "off"}, "text": text}
    with (
        LoggedLines("cangauge.extras.judge") as lines,
        closing(LiveJudge(tmp_path, 2, printing(off), lambda: 50.0)) as judge,
    ):
        drive(judge, {"soc": 50.0}, 1, 0.0)
        judge._end_stretch()
        assert waits(lambda: bool(judge.trouble))
        drive(judge, {"soc": 50.0}, 2, 0.0)
    assert json.loads((tmp_path / RESULT).read_text()) == off  # the second log is judged next time
    assert any("since Sat 18 Nov 06:24 UTC. See whether" in line for line in lines.lines)
    with closing(LiveJudge(tmp_path, 2, printing(OPINION), lambda: 50.0)):
        assert waits(lambda: json.loads((tmp_path / RESULT).read_text()) == OPINION)


def test_a_judgement_that_fails_says_why(tmp_path: Path) -> None:
    command = printing({"error": {"message": "no log has the SoC"}, "exit_code": 2}, 2)
    with (
        LoggedLines("cangauge.extras.judge") as lines,
        closing(LiveJudge(tmp_path, 2, command, lambda: 50.0)) as judge,
    ):
        for sample in samples_of(day(1)):
            judge.on_sample(sample, NONE)
        judge._end_stretch()
        assert waits(lambda: any("was not judged" in line for line in lines.lines))
    assert any(line.endswith("no log has the SoC") for line in lines.lines)
    assert not (tmp_path / RESULT).exists()


def test_a_vehicle_without_a_soc_is_refused(tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text(
        '[current]\nsignal = "current_a"\n[voltage]\nsignal = "voltage_v"\n'
        "[temperature]\nfixed_c = 20\n"
    )
    with pytest.raises(InputError, match="no SoC of its own"):
        Service(
            model=str(leaf_model_path()), interface="virtual", channel="none",
            dbc=str(shared_file("dbc", "generic_pack.dbc")), map=str(tmp_path / "car.toml"),
            judge={"folder": str(tmp_path / "judge")},
        )  # fmt: skip


def test_a_service_keeps_what_it_receives(tmp_path: Path) -> None:
    with RunningService(tmp_path, '[judge]\nfolder = "opinion"\n') as running:
        judge = next(each for each in running.service._outputs if isinstance(each, LiveJudge))
        assert waits(lambda: len(judge._rows) >= 2, 20.0)
    assert (tmp_path / "opinion").is_dir()
