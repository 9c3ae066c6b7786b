"""BMW i3 trips and cycler exports: built ones, and all the recorded ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.logs.read import read_log
from cangauge.logs.sign import charge_ah


def test_i3_current_is_negated_and_soc_may_end_early(
    tmp_path: Path, build_i3: Callable[[list[str]], bytes]
) -> None:
    rows = [f"{k / 10};0;0;391.4;-2.{k};21;22;86.9;100;90" for k in range(5)]
    rows.append("0.5;0;0;391.4;3;21;22;;;")
    (tmp_path / "TripB05.csv").write_bytes(build_i3(rows))
    log = read_log(tmp_path / "TripB05.csv")
    np.testing.assert_allclose(log.current_a, [2.0, 2.1, 2.2, 2.3, 2.4, -3.0])
    np.testing.assert_array_equal(log.soc_pct, [86.9] * 5 + [np.nan])
    assert log.temperature_source == "pack"
    assert log.temperature_c[0] == 21.0  # not the maximum
    assert log.remarks == ("current negated: i3 trips store discharge as negative",)


def test_i3_rows_without_a_value_are_dropped_with_a_remark(
    tmp_path: Path, build_i3: Callable[[list[str]], bytes]
) -> None:
    rows = [f"{k / 10};0;0;391.4;-2;21;22;86.9;100;90" for k in range(40)]
    rows[3] = "0.3;0;0;;-2;21;22;86.9;100;90"
    (tmp_path / "x.csv").write_bytes(build_i3(rows))
    log = read_log(tmp_path / "x.csv")
    assert len(log) == 39
    assert any("1 row without time, current" in text for text in log.remarks)


def test_i3_without_its_columns_is_refused(
    tmp_path: Path, build_i3: Callable[[list[str]], bytes]
) -> None:
    text = build_i3(["0;0;0;391.4;-2;21;22;86.9;100;90"]).replace(b"Battery Current", b"Amps")
    (tmp_path / "x.csv").write_bytes(text)
    with pytest.raises(InputError, match=r"current_a: no column of this file holds it \(found: "):
        read_log(tmp_path / "x.csv")


def test_set_points_are_read_from_file_names_rates_are_not(
    tmp_path: Path, every_format: dict[str, bytes]
) -> None:
    cold = tmp_path / "A123_DYN_50_N05_s1.csv"
    cold.write_bytes(every_format["A123_DYN_50_P25_s1.csv"])
    assert read_log(cold).temperature_c[0] == -5.0
    assert read_log(cold).temperature_source == "room"
    rate = tmp_path / "2C-Discharge-Bitrode-data.csv"
    rate.write_bytes(every_format["Cell-HPPC-10C.csv"])
    with pytest.raises(InputError, match="the file holds no temperature"):
        read_log(rate)
    assert read_log(rate, temperature_c=24.0).temperature_c[0] == 24.0


def test_signs_of_the_cyclers(tmp_path: Path, every_format: dict[str, bytes]) -> None:
    for name, current in (("Cell-HPPC-10C.csv", 1.0), ("module.csv", 1.0)):
        (tmp_path / name).write_bytes(every_format[name])
        log = read_log(tmp_path / name)
        assert log.current_a[0] == current
    assert log.temperature_c[0] == 22.5  # mean of two sensors
    assert any("closing line omitted: 'Total Number" in text for text in log.remarks)


def test_rows_that_bitrode_excludes_are_dropped(
    tmp_path: Path, every_format: dict[str, bytes]
) -> None:
    text = every_format["Cell-HPPC-10C.csv"].decode().split("\r\n")
    text[2] = text[2].replace("No,", "Yes,", 1)
    path = tmp_path / "Cell-HPPC-10C.csv"
    path.write_text("\r\n".join(text), newline="")
    log = read_log(path)
    np.testing.assert_array_equal(log.time_s, [1.0, 2.0, 4.0])
    assert "1 row that the cycler excludes dropped" in log.remarks


# ---- the recorded logs ---------------------------------------------------------------------


@pytest.mark.real
def test_every_i3_trip(shared_data: Path) -> None:
    paths = sorted((shared_data / "bmw_i3").glob("*.csv.gz"))
    assert len(paths) == 30
    for path in paths:
        log = read_log(path)
        assert log.temperature_source == "pack"
        assert 325.0 <= log.voltage_v.min() < log.voltage_v.max() <= 395.0
        assert np.median(np.diff(log.time_s)) == pytest.approx(0.1)
        assert charge_ah(log)[-1] > 1.0  # every trip takes charge out
        assert log.soc_pct is not None
        assert log.soc_pct[0] - np.nanmin(log.soc_pct) > 2.0
    ends_without_soc = read_log(shared_data / "bmw_i3" / "TripB18.csv.gz")
    assert ends_without_soc.soc_pct is not None
    assert np.isnan(ends_without_soc.soc_pct).sum() == 2
    assert np.isnan(ends_without_soc.soc_pct[-2:]).all()


@pytest.mark.real
def test_every_a123_script(shared_data: Path) -> None:
    paths = sorted((shared_data / "a123_lfp").glob("*.csv.gz"))
    assert len(paths) == 21
    for path in paths:
        log = read_log(path)
        assert log.temperature_source == "room"
        assert log.temperature_c[0] == float(path.name.split("_P")[1][:2])
        charge = charge_ah(log)
        if "_S1" in path.name or "_s1" in path.name:  # discharge scripts of a 2.3 Ah cell
            assert 1.9 < charge[-1] < 2.2
        if "_S3" in path.name or "_s3" in path.name:  # charge scripts
            assert -2.2 < charge[-1] < -1.9


@pytest.mark.real
def test_every_ornl_export(shared_data: Path) -> None:
    for path in sorted((shared_data / "leaf_cell_ornl").glob("*HPPC*.csv.gz")):
        log = read_log(path)
        assert log.temperature_c[0] in {10.0, 25.0, 40.0}
        assert np.ptp(charge_ah(log)) == pytest.approx(31.0, abs=2.0)  # a 33.1 Ah cell
    for rate, peak in (("1C", 30.6), ("2C", 61.2), ("3C", 91.8)):
        path = shared_data / "leaf_cell_ornl" / f"{rate}-Discharge-Bitrode-data.csv.gz"
        with pytest.raises(InputError, match="temperature_c: the file holds no temperature"):
            read_log(path)
        assert read_log(path, temperature_c=24.0).current_a.max() == peak
    for path in sorted((shared_data / "leaf_module_ornl").glob("*.csv.gz")):
        log = read_log(path)
        assert log.temperature_source == "cell"
        assert charge_ah(log)[-1] == pytest.approx(55.0, abs=0.7)
    with pytest.raises(InputError, match="not a known kind of log"):
        read_log(shared_data / "leaf_cell_ornl" / "Temperature-1C-discharge.lvm.gz")


@pytest.mark.real
def test_every_lg_hg2_drive(shared_data: Path) -> None:
    paths = sorted((shared_data / "lg_hg2").glob("*.parquet"))
    assert len(paths) == 32
    for path in paths:
        log = read_log(path)
        assert 2.2 < np.ptp(charge_ah(log)) < 3.1  # a 3 Ah cell
        assert log.remarks == ()
