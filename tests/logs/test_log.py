"""A log: its checks, tables in memory, files that read back exactly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from log_cases import CURRENT_A, SOC_PCT, TIME_S, VOLTAGE_V

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.logs.canonical import write_log, write_table
from cangauge.logs.log import Log
from cangauge.logs.read import open_log
from cangauge.settings import TEMPERATURE_SOURCES

CHANNELS = ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct")


@st.composite
def logs(draw: st.DrawFn) -> Log:
    """Random valid logs."""
    rows = draw(st.integers(1, 20))

    def channel(low: float, high: float) -> np.ndarray:
        return draw(hnp.arrays(float, rows, elements=st.floats(low, high)))

    soc = draw(st.none() | st.just(channel(2.0, 100.0)))
    if soc is not None:
        soc[draw(hnp.arrays(bool, rows))] = np.nan
    return Log(
        time_s=draw(st.floats(-1e3, 1e9)) + np.cumsum(channel(1e-3, 50.0)),
        current_a=channel(-2000.0, 2000.0),
        voltage_v=channel(1.0, 1500.0),
        temperature_c=channel(-60.0, 61.0),
        soc_pct=soc,
        temperature_source=draw(st.sampled_from(TEMPERATURE_SOURCES)),
    )


def assert_same(back: Log, log: Log) -> None:
    for channel in CHANNELS:
        if getattr(log, channel) is None:
            assert getattr(back, channel) is None
        else:
            np.testing.assert_array_equal(getattr(back, channel), getattr(log, channel))
    assert back.temperature_source == log.temperature_source


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(log=logs(), suffix=st.sampled_from([".parquet", ".csv", None]))
def test_log_reads_back_exactly(log: Log, suffix: str | None, tmp_path: Path) -> None:
    if suffix is None:
        back = Log.from_dataframe(log.to_arrow())
    else:
        write_log(log, tmp_path / f"log{suffix}")
        back = read_log(tmp_path / f"log{suffix}")
        assert back.name == "log"
    assert_same(back, log)
    assert not [text for text in back.remarks if not text.startswith("current looks inverted")]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([[], [], [], []], "the log holds no rows"),
        ([[0, 1], [1], [380, 380], [20, 20]], "current_a: has 1 values where time_s has 2"),
        ([[0, 1], [1, np.nan], [380, 380], [20, 20]], "current_a: 1 of 2 values are not finite"),
        ([[0, 0], [1, 1], [380, 380], [20, 20]], "time_s: time does not increase at row 2"),
    ],
)
def test_log_of_bad_arrays_is_refused(values: list[list[float]], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Log(*(np.array(each, dtype=float) for each in values))


def test_columns_are_shared_and_nobody_can_change_them(drive: Log) -> None:
    assert Log(drive.time_s, drive.current_a, drive.voltage_v, drive.temperature_c).time_s is (
        drive.time_s
    )
    own = np.arange(3.0)
    log = Log(own, own, own, own)
    own[:] = 7.0
    assert log.time_s.tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match="read-only"):
        log.time_s[0] = 1.0


def test_repr_of_a_log_is_a_line_of_what_it_holds(drive: Log) -> None:
    assert repr(drive) == (
        "<Log 'drive': 60 rows in 59 s; -10 … 40 A, 376 … 381 V, 21.5 … 21.5 °C, SoC 80 … 74.1 %>"
    )


# ---- tables in memory


def test_log_is_itself_a_table(drive: Log) -> None:
    table = pa.table(drive)
    assert table.column_names == list(CHANNELS)
    assert_same(Log.from_dataframe(drive), drive)


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_dataframes_give_the_log_back(drive: Log, package: str) -> None:
    library = pytest.importorskip(package)
    frame = getattr(drive, f"to_{package}")()
    assert isinstance(frame, library.DataFrame)
    back = Log.from_dataframe(frame, name="drive", temperature_source="pack")
    np.testing.assert_array_equal(back.soc_pct, drive.soc_pct)
    assert (back.name, back.temperature_source, back.remarks) == ("drive", "pack", ())
    if package == "pandas":  # its index is no column
        assert Log.from_dataframe(frame[frame["time_s"] != 5.0]).remarks == ()


def test_absent_package_is_named(drive: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "polars", None)
    with pytest.raises(InputError, match=r"polars is not installed.*pip install polars"):
        drive.to_polars()


def table(**columns: object) -> pa.Table:
    rows = {"time_s": [0.0, 1.0, 2.0], "current_a": [1.0, 2.0, 3.0],
            "voltage_v": [380.0, 379.0, 378.0], "temperature_c": [20.0, 20.0, 20.0]}  # fmt: skip
    return pa.table({name: values for name, values in (rows | columns).items() if values})


@pytest.mark.parametrize(
    ("columns", "field", "words"),
    [
        ({"temperature_c": None}, "temperature_c", "holds no temperature.*temperature_c=25$"),
        ({"current_a": [1.0, None, 3.0]}, "current_a", "1 of 3 rows lack .*first is row 2"),
        ({"current_a": [True, False, True]}, "current_a", "does not hold numbers .got 'bool'"),
        ({"temperature_source": ["cell", "room", ""]}, "temperature_source", "one word"),
    ],
)
def test_error_of_a_table_names_column_and_row(
    columns: dict[str, object], field: str, words: str
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        Log.from_dataframe(table(**columns), name="drive")
    assert (caught.value.field, caught.value.source) == (field, "drive")


def test_table_of_any_types_and_columns() -> None:
    log = Log.from_dataframe(
        pa.table(
            {
                "Voltage_V": pa.array(["380", "379", "379"]).dictionary_encode(),
                "driver": ["a", "b", "c"],
                "TIME_S": pa.array([0, 1, 1], pa.int64()),
                "current_A": pa.array([1.5, 2.5, 2.5], pa.float32()),
                "temperature_source": ["cell"] * 3,
            }
        ),
        temperature_c=21.0,
    )
    np.testing.assert_array_equal(log.voltage_v, [380.0, 379.0])
    assert set(log.temperature_c) == {21.0}
    assert log.remarks == (
        "1 other column ignored: driver",
        "temperature 21 °C as given",
        "1 row with the time stamp of the row before dropped (the first is row 3)",
    )
    with pytest.raises(InputError, match="no rows"):
        Log.from_dataframe(table().slice(0, 0))
    with pytest.raises(InputError, match="not a known temperature source"):
        Log.from_dataframe(table(), temperature_source="oven")
    with pytest.raises(InputError, match=r"not a log .got 'int'.; give a Log, the path of one"):
        Log.from_dataframe(7)
    with pytest.raises(InputError, match=r"columns: not columns .got 7.; give NAME=HEADING"):
        Log.from_dataframe(table(), columns=7)


def test_a_parquet_file_of_too_many_columns_is_refused(tmp_path: Path) -> None:
    pq.write_table(pa.table({f"c{k}": [1.0] for k in range(10_001)}), tmp_path / "x.parquet")
    with pytest.raises(InputError, match="more than the 10000 columns that a log may have"):
        open_log(tmp_path / "x.parquet").read()


@pytest.mark.parametrize("kind", ["parquet", "frame", "index"])
def test_plain_headings_of_other_tables(tmp_path: Path, kind: str) -> None:
    stamps = pa.array(1_710_374_370_000_000 + 1_000_000 * TIME_S.astype(int), pa.int64())
    columns: dict[str, Any] = {
        "__index_level_0__" if kind == "index" else "when": stamps.cast(pa.timestamp("us", "UTC")),
        "I_batt": -1e3 * CURRENT_A,
        "U_batt": VOLTAGE_V,
        "T1": np.full(60, 21.0),
        "T2": np.full(60, 22.0),
        "SoC": [f"{value:.1f}%" for value in SOC_PCT],
    }
    named = {"current": "I_batt[mA]:-1"} | ({} if kind == "index" else {"time": "when"})
    if kind == "parquet":
        pq.write_table(pa.table(columns), tmp_path / "t.parquet")
        log = read_log(tmp_path / "t.parquet", columns=named)
    else:
        log = Log.from_dataframe(pa.table(columns), columns=named)
    np.testing.assert_allclose(log.time_s - log.time_s[0], TIME_S)
    np.testing.assert_allclose(log.current_a, CURRENT_A)
    np.testing.assert_allclose(log.temperature_c, 21.5)
    np.testing.assert_allclose(log.soc_pct, SOC_PCT)


@given(
    units=st.tuples(*map(st.sampled_from, (["s", "ms", "min", "h"], ["A", "mA", "kA"],
                                           ["V", "mV", "kV"], ["°C", "K", "°F"]))),
    factor=st.sampled_from([1.0, -1.0, 0.5, -10.0]),
)  # fmt: skip
def test_units_signs_and_factors_round_trip(units: tuple[str, ...], factor: float) -> None:
    in_unit = {"s": 1.0, "ms": 1e3, "min": 1 / 60, "h": 1 / 3600, "A": 1.0, "mA": 1e3, "kA": 1e-3,
               "V": 1.0, "mV": 1e3, "kV": 1e-3}  # fmt: skip
    degrees = {"°C": 21.5, "K": 294.65, "°F": 70.7}[units[3]]
    frame = pa.table(
        {
            "a": TIME_S * in_unit[units[0]],
            "b": CURRENT_A * in_unit[units[1]] / factor,
            "c": VOLTAGE_V * in_unit[units[2]],
            "d": np.full(60, degrees),
        }
    )
    columns = {
        "time": f"a[{units[0]}]",
        "current": f"b[{units[1]}]:{factor!r}",
        "voltage": f"c[{units[2]}]",
        "temperature": f"d[{units[3]}]",
    }
    log = Log.from_dataframe(frame, columns=columns, sign="discharge")
    np.testing.assert_allclose(log.time_s, TIME_S, atol=1e-9)
    np.testing.assert_allclose(log.current_a, CURRENT_A)
    np.testing.assert_allclose(log.voltage_v, VOLTAGE_V)
    np.testing.assert_allclose(log.temperature_c, 21.5)


# ---- files


def test_no_flipped_bit_in_parquet_changes_a_value(tmp_path: Path, drive: Log) -> None:
    path = tmp_path / "drive.parquet"
    write_log(drive, path)
    intact = path.read_bytes()
    noticed = 0
    for place in range(4, len(intact) * 2 // 3, 23):
        data = bytearray(intact)
        data[place] ^= 0x10
        path.write_bytes(bytes(data))
        try:
            back = read_log(path)
        except InputError:
            noticed += 1
        else:
            np.testing.assert_array_equal(back.current_a, drive.current_a)
            np.testing.assert_array_equal(back.voltage_v, drive.voltage_v)
    assert noticed


def test_writing_needs_a_known_suffix_and_leaves_nothing(tmp_path: Path, drive: Log) -> None:
    with pytest.raises(InputError, match=r"'\.xlsx'.*\.parquet or \.csv"):
        write_log(drive, tmp_path / "x.xlsx")
    for name in ("x.bdf.csv", "x.BDF.parquet"):
        with pytest.raises(InputError, match=r"'\.bdf'.*use \.parquet or \.csv"):
            write_log(drive, tmp_path / name)
    with pytest.raises(InputError, match="folder of this file does not exist"):
        write_log(drive, tmp_path / "absent" / "x.csv")
    assert list(tmp_path.iterdir()) == []


def test_tables_of_any_columns(tmp_path: Path) -> None:
    columns = {"time_s": np.array([0.0, 1.0]), "status": pa.array(["valid", "a,b"])}
    write_table(columns | {"soc": np.array([np.nan, 0.1])}, tmp_path / "x.csv")
    assert (tmp_path / "x.csv").read_text() == 'time_s,status,soc\n0,"valid",\n1,"a,b",0.1\n'


@pytest.mark.parametrize(
    ("units", "words"),
    [
        ("s,A,V,°C,%,cell", None),
        ("[s],(A),[V],degC,,", None),
        ("f8,f8,float64,double,f4,\ns,A,V,°C,%,cell", None),
        ("s,mA,V,degC,%", "the row of units contradicts the headings .got 's,"),
        ("s,A,mV,°C,%", "the row of units contradicts the headings .got 's,"),
        ("s,A,V,K,%", "the row of units contradicts the headings .got 's,"),
        ("abc,5,300,20,50", "time_s: row 1 is not a time .got 'abc'"),
        (",mA,,,", "the row of units contradicts the headings .got ',mA,"),
    ],
)
def test_names_of_a_canonical_log_define_its_units(
    tmp_path: Path, drive: Log, units: str, words: str | None
) -> None:
    write_log(drive, tmp_path / "x.csv")
    head, rows = (tmp_path / "x.csv").read_text().split("\n", 1)
    (tmp_path / "x.csv").write_text(f"{head}\n{units}\n{rows}", encoding="utf-8")
    if words is None:
        assert_same(read_log(tmp_path / "x.csv"), drive)
    else:
        with pytest.raises(InputError, match=words):
            read_log(tmp_path / "x.csv")


@pytest.mark.parametrize(
    ("headings", "scale", "kind"),
    [("cell_{:02d}_v", 1.0, "csv"), ("Cell {} [V]", 1.0, "csv"), ("Zelle {} (mV)", 1e3, "parquet")],
)  # fmt: skip
def test_cells_beside_a_log(
    tmp_path: Path, drive: Log, headings: str, scale: float, kind: str
) -> None:
    cells = 3.3 + 0.01 * np.arange(16) + 0.001 * drive.current_a[:, None]
    columns = {"Time [s]": drive.time_s, "Current [A]": drive.current_a,
               "Voltage [V]": drive.voltage_v, "Temp [°C]": drive.temperature_c}  # fmt: skip
    if "cell_" in headings:
        columns = dict(zip(CHANNELS, columns.values(), strict=False))
    columns |= {headings.format(k + 1): scale * cells[:, k] for k in range(16)}
    path = tmp_path / f"home.{kind}"
    write_table(columns, path)
    log = read_log(path)
    np.testing.assert_array_equal(log.voltage_v, drive.voltage_v)
    found = open_log(path).cells(log.time_s[3:])
    assert found is not None
    assert (found.first, found.count) == (1, 16)
    np.testing.assert_allclose(found.voltage_v, cells[3:])
    later = open_log(path).cells(log.time_s + 0.25)
    assert later is not None
    assert np.isnan(later.voltage_v).all()
    del columns[headings.format(5)]
    write_table(columns, path)
    with pytest.raises(InputError, match="cell_5_v: the cells must be numbered"):
        open_log(path).cells(log.time_s)


def test_log_without_cells_or_with_one_has_none(tmp_path: Path, drive: Log) -> None:
    for columns in (drive.to_arrow(), drive.to_arrow().append_column("cell_1_v", [[3.7] * 60])):
        write_table(columns, tmp_path / "x.csv")
        assert open_log(tmp_path / "x.csv").cells(drive.time_s) is None
