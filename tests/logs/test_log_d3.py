"""ANL D3 tests: three spellings, clamps, copies from CAN, zips, incomplete rows."""

from __future__ import annotations

import io
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.logs.read import read_log


class D3(NamedTuple):
    """Headings by spelling, and a builder of files with them."""

    headers: dict[str, list[str]]
    text: Callable[..., str]


@pytest.fixture
def d3(d3_headers: dict[str, list[str]], build_d3: Callable[..., str]) -> D3:
    return D3(d3_headers, build_d3)


def expected_current(time_s: np.ndarray) -> np.ndarray:
    return np.where(np.floor(time_s) % 2 == 1, 40.0, -10.0)


def write(tmp_path: Path, text: str, name: str = "61201019 Test Data.txt") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8", newline="")
    return path


@pytest.mark.parametrize(
    ("spelling", "instrument", "soc"),
    [
        ("2012", "500 A clamp", None),
        ("2013", "HV battery channels", 90.0),
        ("later", "power analyser", 90.0),
    ],
)
def test_each_spelling_reads(
    tmp_path: Path, d3: D3, spelling: str, instrument: str, soc: float | None
) -> None:
    log = read_log(write(tmp_path, d3.text(d3.headers[spelling])))
    np.testing.assert_allclose(log.time_s, np.arange(400) / 10, atol=1e-9)
    np.testing.assert_array_equal(log.current_a, expected_current(log.time_s))
    np.testing.assert_allclose(log.voltage_v, 380.0 - 0.1 * log.current_a)
    assert log.temperature_source == "room"
    assert log.name == "61201019"
    assert (log.first_soc() or (0, None))[1] == soc
    assert {f"current_a from the {instrument}", f"voltage_v from the {instrument}"} <= set(
        log.remarks
    )
    assert "10 rows before time 0 (the wait before the test) dropped" in log.remarks
    assert any("test room" in text for text in log.remarks)


def test_headings_match_in_any_spelling(tmp_path: Path, d3: D3) -> None:
    text = d3.text(d3.headers["2013"])
    first, rest = text.split("\r\n", 1)
    first = first.replace("HV_Battery_Current[A]", "hv battery_CURRENT [A]")
    log = read_log(write(tmp_path, f"{first}\r\n{rest}"))
    np.testing.assert_array_equal(log.current_a, expected_current(log.time_s))


def test_the_200_a_clamp_is_the_second_choice(tmp_path: Path, d3: D3) -> None:
    absent = [name for name in d3.headers["2012"] if "500A" not in name]
    log = read_log(write(tmp_path, d3.text(absent)))
    assert log.current_a.max() == 20.0  # that clamp saturates
    assert "current_a from the 200 A clamp" in log.remarks

    lines = d3.text(d3.headers["2012"]).split("\r\n")
    emptied = [lines[0]]
    for line in lines[1:-1]:
        row = line.split("\t")
        row[6] = ""
        emptied.append("\t".join(row))
    log = read_log(write(tmp_path, "\r\n".join(emptied) + "\r\n"))
    assert log.current_a.max() == 20.0
    assert "HV Battery Current w/500A max clamp [A] is empty and was not used" in log.remarks


def test_two_instruments_where_none_has_both(tmp_path: Path, d3: D3) -> None:
    header = [
        name for name in d3.headers["later"] if "Volt_Hioki" not in name and "wide" not in name
    ]
    log = read_log(write(tmp_path, d3.text(header)))
    np.testing.assert_array_equal(log.current_a, expected_current(log.time_s))
    assert {"current_a from the power analyser", "voltage_v from the car's CAN"} <= set(log.remarks)


def test_a_can_copy_is_negated_where_the_data_show_it(tmp_path: Path, d3: D3) -> None:
    header = [name for name in d3.headers["later"] if "Hioki" not in name]
    log = read_log(write(tmp_path, d3.text(header, end_s=120.0)))
    np.testing.assert_array_equal(log.current_a, expected_current(log.time_s))
    assert any(text.startswith("current negated, sign found from the data") for text in log.remarks)


def test_a_can_copy_is_kept_where_the_data_are_silent(tmp_path: Path, d3: D3) -> None:
    header = [name for name in d3.headers["later"] if "Hioki" not in name]
    log = read_log(write(tmp_path, d3.text(header, end_s=3.0)))
    np.testing.assert_array_equal(log.current_a, -expected_current(log.time_s))
    assert any("kept as stored" in text for text in log.remarks)


def test_an_instrument_is_never_turned(tmp_path: Path, d3: D3) -> None:
    text = d3.text(d3.headers["2012"], end_s=120.0)
    lines = [line.split("\t") for line in text.split("\r\n")[:-1]]
    for row in lines[1:]:
        row[6] = str(-float(row[6]))
    log = read_log(write(tmp_path, "\r\n".join("\t".join(row) for row in lines) + "\r\n"))
    np.testing.assert_array_equal(log.current_a, -expected_current(log.time_s))
    assert any(text.startswith("current looks inverted and was kept") for text in log.remarks)


def test_incomplete_rows_are_dropped_up_to_a_limit(tmp_path: Path, d3: D3) -> None:
    lines = d3.text(d3.headers["2013"], start_s=0.0).split("\r\n")
    holed = [*lines]
    holed[5] = "0.4\t0\t23.5\t90\t\t381"
    log = read_log(write(tmp_path, "\r\n".join(holed)))
    assert len(log) == 399
    assert any("1 row without time, current, voltage" in text for text in log.remarks)
    for row in range(1, 60):
        cells = lines[row].split("\t")
        cells[4] = "NaN"
        holed[row] = "\t".join(cells)
    with pytest.raises(InputError, match="59 of 400 rows lack time, current, voltage"):
        read_log(write(tmp_path, "\r\n".join(holed)))


@pytest.mark.parametrize(
    ("broken", "field", "words"),
    [
        (lambda text: text.replace("HV_Battery_Current[A]", "Amps[A]"), "current_a", "no column"),
        (lambda text: text.replace("HV_Battery_Voltage[V]", "Volts[V]"), "voltage_v", "no column"),
        (lambda text: text.replace("Voltage[V]", "Voltage[furlong]"), None, "the unit is not"),
        (lambda text: text.replace("Test_Cell_Temp", "Wind"), "temperature_c", "no temperature"),
        (lambda text: text.replace("\r\n2.0000", "\r\n1.0000"), "Time[sec]", "backwards at row"),
        (lambda text: text.replace("376.0000", "x", 1), "HV_Battery_Voltage[V]", "not a number"),
        (lambda text: text.replace("\t90.0000", "", 1), None, "row .* has 5 cells"),
        (lambda text: text.split("\r\n")[0], None, "no rows below the header"),
        (lambda text: text.split("\r\n", 1)[0] + "\r\n-1\t0\t23\t9\t1\t380\r\n", None, "before"),
    ],
)
def test_what_is_broken_is_named(
    tmp_path: Path,
    d3: D3,
    broken: Callable[[str], str],
    field: str | None,
    words: str,
) -> None:
    path = write(tmp_path, broken(d3.text(d3.headers["2013"], start_s=0.0)))
    with pytest.raises(InputError, match=words) as caught:
        read_log(path)
    assert caught.value.source == str(path)
    assert caught.value.cure
    if field is not None:
        assert caught.value.field == field


def test_units_in_headings_are_converted(tmp_path: Path, d3: D3) -> None:
    text = d3.text(d3.headers["2013"]).replace("Test_Cell_Temp[C]", "Test_Cell_Temp[F]")
    log = read_log(write(tmp_path, text))
    np.testing.assert_allclose(log.temperature_c, (23.5 - 32.0) / 1.8)
    assert "Test_Cell_Temp[F]: converted from F to temperature_c" in log.remarks


def zipped(names: dict[str, str]) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in names.items():
            archive.writestr(name, text)
    return packed.getvalue()


def test_a_vehicles_zip(tmp_path: Path, d3: D3) -> None:
    text = d3.text(d3.headers["2012"])
    path = tmp_path / "leaf.zip"
    path.write_bytes(zipped({"2012 Leaf/61201019 Test Data.txt": text, "Summary.pdf": "%PDF"}))
    log = read_log(path)
    assert len(log) == 400
    assert log.name == "61201019"
    path.write_bytes(zipped({f"6120101{k} Test Data.txt": text for k in range(3)}))
    with pytest.raises(InputError, match=r"zip holds 3 files \(61201010 Test.*unpack it and name"):
        read_log(path)
    path.write_bytes(zipped({}))
    with pytest.raises(InputError):
        read_log(path)


def test_a_whole_test_reads_fast_enough_to_be_vectorised(tmp_path: Path, d3: D3) -> None:
    """90,000 rows through Python loops would take many times this limit."""
    lines = d3.text(d3.headers["2013"], start_s=0.0, end_s=9000.0)
    path = write(tmp_path, lines)
    begin = time.process_time()
    assert len(read_log(path)) == 90_000
    assert time.process_time() - begin < 0.9
