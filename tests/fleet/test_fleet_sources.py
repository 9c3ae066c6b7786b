"""Globs and manifests → logs with their vehicles; logs of other storage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import fsspec
import pytest

from cangauge.errors import InputError
from cangauge.extras.fleet.sources import ABSENT, FleetLog, ReadOptions, find_logs, local_file
from cangauge.logs.column_map import ColumnMap

HEAD = "time_s,current_a,voltage_v,temperature_c\n"


def test_a_glob_finds_the_logs_of_each_folder(folder: Path) -> None:
    found = find_logs([f"{folder}/*/trip*.parquet"])
    assert [log.vehicle for log in found] == [f"car{k}" for k in range(4) for _ in range(2)]
    assert [Path(log.url).stem for log in found[:2]] == ["trip0", "trip1"]


def test_the_folder_of_a_log_names_its_vehicle(tmp_path: Path) -> None:
    for folder in ("A17", "vehicle=B 4"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "may.csv").write_text(HEAD)
    assert [log.vehicle for log in find_logs([f"{tmp_path}/*/may.csv"])] == ["A17", "B 4"]
    fsspec.filesystem("memory").pipe_file("/may.csv", HEAD.encode())
    with pytest.raises(InputError, match="names its vehicle"):
        find_logs(["memory://may.csv"])


def test_a_manifest_orders_by_start_and_names_what_is_absent(tmp_path: Path) -> None:
    (tmp_path / "b.csv").write_text(HEAD)
    (tmp_path / "a.csv").write_text(HEAD)
    (tmp_path / "manifest.csv").write_text(
        "log,vehicle,start,initial_soc_pct,healthy\n"
        "a.csv,X,2024-05-02T08:00:00Z,90,yes\nb.csv,X,2024-05-01T08:00:00Z,,\ngone.csv,Y,,,\n"
    )
    found = find_logs([str(tmp_path / "manifest.csv")])
    assert [Path(log.url).name for log in found] == ["b.csv", "a.csv", "gone.csv"]
    assert (found[1].initial_soc_pct, found[1].healthy, found[0].healthy) == (90.0, True, False)
    assert found[2].stamp == ABSENT
    assert ABSENT not in {found[0].stamp, found[1].stamp}


@pytest.mark.parametrize("codec", ["utf-8-sig", "cp1252", "utf-16"])
def test_a_manifest_is_read_as_a_german_spreadsheet_writes_it(tmp_path: Path, codec: str) -> None:
    (tmp_path / "a.csv").write_text(HEAD)
    text = '"log";vehicle;initial_soc_pct\r\na.csv;Käfer;90,5\r\n'
    (tmp_path / "manifest.csv").write_bytes(text.encode(codec))
    (log,) = find_logs([str(tmp_path / "manifest.csv")])
    assert (Path(log.url).name, log.vehicle, log.initial_soc_pct) == ("a.csv", "Käfer", 90.5)


@pytest.mark.parametrize("content", [b"log of a17\rt;I;U\r0;1;380\r", b"\x1f\x8b\x08\r\x00,\r"])
def test_a_table_of_one_line_is_a_log(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    (log,) = find_logs([str(tmp_path / "a.csv")])
    assert Path(log.url).name == "a.csv"


def test_a_manifest_may_end_its_lines_by_cr_only(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(HEAD)
    (tmp_path / "manifest.csv").write_bytes(b"log,vehicle\ra.csv,X\r")
    (log,) = find_logs([str(tmp_path / "manifest.csv")])
    assert (Path(log.url).name, log.vehicle) == ("a.csv", "X")


def test_rows_without_a_cell_are_left_out_of_a_manifest(tmp_path: Path) -> None:
    manifest = tmp_path / "manifest.csv"
    manifest.write_text('log;vehicle;start\n;;\n\na.csv;"X\nY";\n ; ;\nb.csv;Z;soon\n')
    with pytest.raises(InputError, match=r"line 7.*soon"):
        find_logs([str(manifest)])
    manifest.write_text(manifest.read_text().replace("soon", "") + ";;\n")
    assert [log.vehicle for log in find_logs([str(manifest)])] == ["X\nY", "Z"]


def test_a_manifest_and_a_path_name_the_same_log(tmp_path: Path) -> None:
    for folder in ("A", "m"):
        (tmp_path / folder).mkdir()
    (tmp_path / "A" / "x.csv").write_text(HEAD)
    (tmp_path / "m" / "manifest.csv").write_text("log\n../A/x.csv\n")
    manifest = str(tmp_path / "m" / "manifest.csv")
    urls = {
        find_logs([given])[0].url
        for given in (manifest, f"{tmp_path}/A/x.csv", f"{tmp_path}/m/../A/*.csv")
    }
    assert urls == {f"{tmp_path}/A/x.csv"}
    assert find_logs([manifest])[0].stamp != ABSENT
    with pytest.raises(InputError, match="named twice"):
        find_logs([manifest, f"{tmp_path}/A/x.csv"])


def test_a_file_that_is_named_like_a_glob_is_found(tmp_path: Path) -> None:
    for name in ("t[1].csv", "t1.csv"):
        (tmp_path / name).write_text(HEAD)
    (log,) = find_logs([f"{tmp_path}/t[1].csv"])
    assert Path(log.url).name == "t[1].csv"
    assert len(find_logs([f"{tmp_path}/t*.csv"])) == 2
    assert Path(find_logs([f"{tmp_path}/t[12].csv"])[0].url).name == "t1.csv"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("log,colour\na.csv,red\n", "line 2: colour: unknown key"),
        ("log,start\na.csv,yesterday\n", "line 2.*yesterday"),
        ("log,initial_soc_pct\na.csv,140\n", "initial_soc_pct.*at most 100"),
        ("log;initial_soc_pct\na.csv;full\n", "initial_soc_pct.*a valid number"),
        ("log,healthy\na.csv,perhaps\n", "healthy.*a valid boolean"),
        ("log,vehicle\n,X\n", "log: is missing"),
        ("log,vehicle\na.csv,X\na.csv,X\n", "named twice"),
        ("log,vehicle\nzip://a.csv::b.zip,X\n", "line 2.*a chain of URLs"),
        (f"log,vehicle\na.csv,{'X' * 300}\n", "a.csv.*300 characters"),
        (f'log,vehicle\na.csv,"{"X" * 200_000}\n', "not a table: field larger"),
    ],
)
def test_a_wrong_manifest_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "manifest.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        find_logs([str(tmp_path / "manifest.csv")])


def test_nothing_found_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no log is named"):
        find_logs([f"{tmp_path}/*.csv"])
    with pytest.raises(InputError, match="no such file"):
        find_logs([f"{tmp_path}/log.csv"])
    with pytest.raises(InputError, match="is a folder"):
        find_logs([str(tmp_path)])


def test_the_stamp_changes_with_the_content(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text(HEAD)
    (before,) = find_logs([str(path)])
    assert find_logs([str(path)]) == [before]
    path.write_text(f"{HEAD}0,1,380,20\n")
    (after,) = find_logs([str(path)])
    assert after.stamp != before.stamp


def test_a_remote_log_is_read_as_a_local_one(logs: list[FleetLog]) -> None:
    remote = fsspec.filesystem("memory")
    remote.pipe_file("/remote/car9/trip.parquet", Path(logs[0].url).read_bytes())
    (found,) = find_logs(["memory://remote/*/*.parquet"])
    assert found.vehicle == "car9"
    local = Path(logs[0].url)
    with local_file(found.url) as path:
        copied = ReadOptions().read(found, path)
    assert not path.exists()
    assert copied.source == found.url
    assert copied.voltage_v.tolist() == ReadOptions().read(logs[0], local).voltage_v.tolist()


def test_a_log_begins_with_the_soc_of_the_manifest(logs: list[FleetLog]) -> None:
    stated = replace(logs[1], initial_soc_pct=42.0)
    path = Path(stated.url)
    assert ReadOptions().read(stated, path).first_soc() == (0, 42.0)
    assert ReadOptions().read(logs[1], path).first_soc() != (0, 42.0)


def test_a_table_of_other_headings_is_read_by_its_columns(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    rows = "\n".join(f"{k},{2 * k % 7 - 3},{380 - 0.1 * (2 * k % 7)},21" for k in range(20))
    path.write_text(f"t,I,U,Temp\n{rows}\n")
    columns = ColumnMap.of("time=t[s],current=I[A],voltage=U[V],temperature=Temp[°C]")
    log = ReadOptions(columns=columns).read(FleetLog("x", "v", "s"), path)
    assert len(log) == 20
