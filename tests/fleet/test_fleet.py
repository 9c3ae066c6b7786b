"""`cangauge fleet`: a row of each log, with the numbers of the command on that log alone."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import cangauge
from cangauge.diagnosis import diagnose
from cangauge.extras.judge.judgement import judge
from cangauge.logs.canonical import write_log
from live import in_process, refused


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drives of a pack, the last one with a fault; a model of the first two; a broken file."""
    root = tmp_path_factory.mktemp("fleet")
    for number in range(4):
        faults = ("voltage_offset:offset_v=4",) if number == 3 else ()
        drive = cangauge.simulate(*faults, seed=3, drive=number, hours=0.4)
        write_log(drive.log, root / f"drive{number}.parquet")
    healthy = [cangauge.read_log(root / f"drive{number}.parquet") for number in range(3)]
    cangauge.fit(healthy[:2], capacity_ah=60.0).model.save(root / "type.json")
    (root / "broken.parquet").write_bytes(b"PAR1")
    return root


@pytest.fixture(scope="module")
def processes() -> Iterator[ProcessPoolExecutor]:
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        yield pool


@pytest.fixture
def shared(processes: ProcessPoolExecutor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands share two processes, whose start takes longer than their work."""
    monkeypatch.setattr(
        "cangauge.extras.fleet.rows.ProcessPoolExecutor", lambda *_: nullcontext(processes)
    )


def drives(folder: Path) -> list[Path]:
    return sorted(folder.glob("drive*.parquet"))


def table_of(folder: Path, answer: str, logs: list[Path], *more: object) -> dict[str, list[Any]]:
    output = folder / f"{answer}.parquet"
    ended = in_process("fleet", answer, *logs, "-m", folder / "type.json", "-o", output, *more)
    assert ended.code == 0, ended.err
    return pq.read_table(output).to_pydict()


@pytest.fixture(scope="module")
def estimates(folder: Path) -> dict[str, Any]:
    """The table of the drives, of a broken file and of one that is not there."""
    logs = [*drives(folder), folder / "broken.parquet", folder / "absent.csv"]
    return table_of(folder, "estimate", logs)


def test_estimates_are_those_of_each_log_alone(folder: Path, estimates: dict[str, Any]) -> None:
    assert estimates["log"][2:] == [str(path) for path in drives(folder)]
    for path, error_pct in zip(drives(folder), estimates["soc_mae_pct"][2:], strict=True):
        alone = in_process(
            "estimate", path, "-m", folder / "type.json", "-o", folder / "soc.csv", "--json"
        )
        assert error_pct == alone.json["soc_mae_pct"]


def test_a_log_that_fails_is_a_row_with_its_error(estimates: dict[str, Any]) -> None:
    names = [Path(log).name for log in estimates["log"]]
    assert names[:3] == ["absent.csv", "broken.parquet", "drive0.parquet"]
    assert "no such file" in estimates["error"][0]
    assert "broken.parquet" in estimates["error"][1]
    assert estimates["error"][2:] == [None] * 4
    assert np.isfinite(estimates["soc_mae_pct"][2:]).all()
    assert estimates["soc_mae_pct"][:2] == [None, None]


def test_no_answer_at_all_fails(folder: Path) -> None:
    output = folder / "none.parquet"
    ended = in_process(
        "fleet", "estimate", folder / "absent.csv", "-m", folder / "type.json", "-o", output,
        "--json",
    )  # fmt: skip
    assert ended.code == 1
    assert ended.json["failed"] == 1
    assert output.exists()


@pytest.mark.usefixtures("shared")
def test_gaps_are_those_of_each_log_alone(folder: Path) -> None:
    *references, faulty = drives(folder)
    given = [word for path in references for word in ("--reference", path)]
    table = table_of(folder, "gap", [faulty], *given)
    model = cangauge.Model.load(folder / "type.json")
    alone = diagnose([faulty], model, references).to_json()
    assert table["gap.baseline_rmse_v"] == [alone["gap"]["baseline_rmse_v"]]


@pytest.mark.usefixtures("shared")
def test_judgements_are_those_of_each_log_alone(folder: Path) -> None:
    path = drives(folder)[3]
    table = table_of(folder, "judge", [path])
    alone = judge([path], folder / "type.json").to_dict()
    assert table["now.error_pct"] == [alone["now"]["error_pct"]]


@pytest.mark.usefixtures("shared")
def test_a_gauge_that_stands_still_is_judged(folder: Path) -> None:
    drive = cangauge.read_log(drives(folder)[3])
    shown = drive.soc_pct.copy()
    shown[len(drive) // 4 :] = shown[len(drive) // 4]
    write_log(replace(drive, soc_pct=shown), folder / "stuck.parquet")
    assert table_of(folder, "judge", [folder / "stuck.parquet"])["now.verdict"] == ["off"]


@pytest.mark.usefixtures("shared")
@pytest.mark.parametrize(
    ("answer", "shown"),
    [("estimate", "SoC MAE [%]"), ("gap", "P(none)"), ("judge", "verdict")],
)
def test_what_a_command_refuses_is_a_row_with_its_error(
    folder: Path, answer: str, shown: str
) -> None:
    drive = cangauge.read_log(drives(folder)[0])
    write_log(replace(drive, current_a=4.0 * drive.current_a), folder / "contradictory.parquet")
    ended = in_process(
        "fleet", answer, drives(folder)[0], folder / "contradictory.parquet",
        "-m", folder / "type.json", "-o", folder / "some.parquet",
    )  # fmt: skip
    assert shown in ended.out
    assert "failed: 1 × current_a: charge and SoC contradict each other" in ended.err


@pytest.mark.usefixtures("shared")
def test_a_dask_scheduler_gives_the_same_rows(folder: Path) -> None:
    distributed = pytest.importorskip("distributed")
    here = table_of(folder, "estimate", drives(folder))
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        scheduler = cluster.scheduler_address
        there = table_of(folder, "estimate", drives(folder), "--scheduler", scheduler)
    assert there | {"seconds": None} == here | {"seconds": None}


def test_references_belong_to_gap(folder: Path) -> None:
    log, model = drives(folder)[0], folder / "type.json"
    ended = in_process(
        "fleet", "judge", log, "-m", model, "-o", folder / "x.parquet", "--reference", log
    )
    refused(ended, "--reference", "judge")


@pytest.mark.usefixtures("shared")
def test_the_printed_table_has_words_and_whole_headings(folder: Path) -> None:
    arguments = ("-m", folder / "type.json", "-o", folder / "shown.parquet", "--reference")
    references = (drives(folder)[0], "--reference", drives(folder)[1])
    ended = in_process("fleet", "gap", drives(folder)[2], *arguments, *references)
    assert ended.code == 0, ended.err
    for heading in ("answer", "fault", "P(none)", "check first"):
        assert heading in ended.out
    assert not {"…", "[", "_"} & set(ended.out)
