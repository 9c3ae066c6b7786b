"""Tables as other tools pack, encode and label them; files that only other tools read."""

from __future__ import annotations

import bz2
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.logs.read import read_log
from cangauge.model.coulomb_counting import difference_from_reference

TIME_S = np.arange(200.0)
CURRENT_A = np.where(TIME_S % 4 < 2, 40.0, -4.0)
VOLTAGE_V = 380.0 - 0.1 * CURRENT_A - 0.02 * TIME_S
SOC_PCT = 90.0 - np.cumsum(CURRENT_A) / 360.0


def table(head: str, *columns: np.ndarray) -> str:
    rows = zip(*(each.tolist() for each in columns), strict=True)
    return head + "\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows)


def plain() -> str:
    columns = (TIME_S, CURRENT_A, VOLTAGE_V, np.full(200, 21.0), SOC_PCT)
    return table("Time [s],Current [A],Voltage [V],Temperature [°C],SoC [%]", *columns)


def read(tmp_path: Path, content: bytes, name: str = "drive.csv") -> Log:
    path = tmp_path / name
    path.write_bytes(content)
    return read_log(path)


@pytest.mark.parametrize(
    "pack",
    [
        lambda text: bz2.compress(text.encode()),
        lambda text: text.encode("utf-16-le"),
        lambda text: text.encode("utf-16-be"),
        lambda text: text.encode("cp1252"),
        lambda text: bz2.compress(text.encode("utf-16")),
    ],
    ids=["bzip2", "utf-16-le", "utf-16-be", "cp1252", "bzip2 of utf-16"],
)
def test_packing_and_encoding_do_not_change_a_log(
    tmp_path: Path, pack: Callable[[str], bytes]
) -> None:
    log = read(tmp_path, pack(plain()))
    np.testing.assert_array_equal(log.current_a, CURRENT_A)
    np.testing.assert_array_equal(log.voltage_v, VOLTAGE_V)


def test_bzip2_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cut off or damaged"):
        read(tmp_path, bz2.compress(plain().encode())[:-200])


@pytest.mark.parametrize(
    ("magic", "words"),
    [
        (b"ARROW1\0\0", r"Feather.*read_feather"),
        (b"\x89HDF\r\n\x1a\n", r"HDF5.*read_hdf"),
        (b"MATLAB 5.0 MAT-file, Platform", "loadmat"),
        (b"SQLite format 3\0", r"SQLite.*sqlite3 -csv"),
        (b"BIO-LOGIC MODULAR FILE\x1a", r"mpr.*galvani"),
        (b"NEWARE\0", r"\.nda.*NewareNDA"),
        (b"\0\1\0\0Standard Jet DB\0", r"Arbin.*mdb-export"),
        (b"\xfd7zXZ\0", "unxz"),
        (b"\x28\xb5\x2f\xfd", "unzstd"),
        (b'{"time":0.0,"current":1.0}\n', "read_json"),
    ],
)
def test_file_of_another_tool_is_named_with_its_cure(
    tmp_path: Path, magic: bytes, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        read(tmp_path, magic + b"\0\1\2" * 100)


def test_neware_archive_is_named_with_its_cure(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "cell.ndax", "w") as archive:
        archive.writestr("VersionInfo.xml", "<x/>")
        archive.writestr("data.ndc", b"\0" * 64)
    with pytest.raises(InputError, match="NewareNDA"):
        read_log(tmp_path / "cell.ndax")


@pytest.mark.parametrize("heading", ["Cell_Temp_C", "T_batt", "tcell", "Zelltemperatur [°C]"])
def test_any_plain_temperature_beside_canonical_names(tmp_path: Path, heading: str) -> None:
    head = f"time_s,current_a,voltage_v,{heading}"
    log = read(
        tmp_path, table(head, TIME_S, CURRENT_A, VOLTAGE_V, np.full(200, 21.0)).encode("cp1252")
    )
    assert log.temperature_c[0] == 21.0
    assert any(heading in each for each in log.assumed)


def test_missing_temperature_shows_the_columns_found(tmp_path: Path) -> None:
    text = table("time_s,current_a,voltage_v,Sonde 3", TIME_S, CURRENT_A, VOLTAGE_V, TIME_S)
    with pytest.raises(InputError, match=r"Sonde 3\).*--columns temperature"):
        read(tmp_path, text.encode())


def test_row_of_units_wins_over_the_units_of_headings(tmp_path: Path) -> None:
    head = "Time,Cell_Temp_C,Pack_V,Pack_I,SOC\ns,degC,V,mA,1"
    columns = (TIME_S, np.full(200, 21.0), VOLTAGE_V, 1e3 * CURRENT_A, SOC_PCT / 100.0)
    log = read(tmp_path, table(head, *columns).encode())
    np.testing.assert_allclose(log.current_a, CURRENT_A)
    assert log.soc_pct is not None
    np.testing.assert_allclose(log.soc_pct, SOC_PCT)


@pytest.mark.parametrize("stored_sign", [1.0, -1.0])
def test_soc_against_the_charge_is_left_out_with_a_remark(
    tmp_path: Path, stored_sign: float
) -> None:
    head = "Time [s],Current [A],Voltage [V],Temperature [°C],SoC [%]"
    columns = (TIME_S, stored_sign * CURRENT_A, VOLTAGE_V, np.full(200, 21.0), 100.0 - SOC_PCT)
    log = read(tmp_path, table(head, *columns).encode())
    np.testing.assert_array_equal(log.current_a, CURRENT_A)
    assert log.soc_pct is None
    assert any(each.startswith("SoC left out") for each in log.remarks)


def test_dates_of_a_spreadsheet_are_named_as_days(tmp_path: Path) -> None:
    head = "Time,Current [A],Voltage [V],Temperature [°C]"
    columns = (45_364.0 + TIME_S / 86_400.0, CURRENT_A, VOLTAGE_V, np.full(200, 21.0))
    text = table(head, *columns).encode()
    with pytest.raises(InputError, match=r"time=Time\[d\]"):
        read(tmp_path, text)
    log = read_log(tmp_path / "drive.csv", columns="time=Time[d]")
    np.testing.assert_allclose(np.diff(log.time_s), 1.0, atol=1e-5)


def test_frozen_soc_is_told(tmp_path: Path) -> None:
    head = "Time [s],Current [A],Voltage [V],Temperature [°C],SoC [%]"
    columns = (TIME_S, CURRENT_A, VOLTAGE_V, np.full(200, 21.0), np.full(200, 50.0))
    log = read(tmp_path, table(head, *columns).encode())
    told = difference_from_reference(log, capacity_ah=5.0)
    assert told is not None
    assert "stays at 50 %" in told
    assert difference_from_reference(log, capacity_ah=500.0) is None
