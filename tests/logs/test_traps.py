"""What a reader of tables may get wrong without a word: units, doubled names, rows, zones."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.logs.log import Log

ROWS = 600


def read(folder: Path, head: str, rows: Iterable[str], columns: Any = None) -> Log:
    """Read a table of a head and its rows."""
    path = folder / "t.csv"
    path.write_text("\n".join([head, *rows, ""]))
    return read_log(path, columns=columns)


def rows_of(row: str, rows: int = ROWS) -> list[str]:
    """Return rows by a format of their number `k`, of ms, µs and amps."""
    return [row.format(k=k, ms=20 * k, us=20_000 * k, amps=k % 7) for k in range(rows)]


# ---- rows above the data


@pytest.mark.parametrize("words", ["begin of test,,,,", "-,-,-,-,-", "n/a,n/a,n/a,n/a,n/a", "---"])
@pytest.mark.parametrize(
    "head", ["time_s,current_a,voltage_v,temperature_c,soc_pct", "Time,Current,Voltage,Temp,SoC"]
)
def test_a_row_of_words_below_the_header_is_remarked(tmp_path: Path, head: str, words: str) -> None:
    log = read(tmp_path, f"{head}\n{words}", rows_of("{k},{amps},380,20,50"))
    assert len(log) == ROWS
    assert f"line below the header omitted: {words!r}" in log.remarks


def test_rows_of_units_and_of_nothing_are_not_remarked(tmp_path: Path) -> None:
    head = "Time,Current,Voltage,Temp\ns,mA,,\n,,,"
    log = read(tmp_path, head, rows_of("{k},{amps},380,20"))
    assert log.current_a[1] == pytest.approx(1e-3)
    assert not any("omitted" in remark for remark in log.remarks)


def test_named_columns_settle_units_that_contradict_the_headings(tmp_path: Path) -> None:
    head = "time_s,current_a,voltage_v,temperature_c\ns,mA,V,°C"
    log = read(tmp_path, head, rows_of("{k},{amps},380,20"), "current=current_a[mA]:1")
    assert log.current_a[1] == pytest.approx(1e-3)


# ---- units


@pytest.mark.parametrize("above", [",mA,,", "min,,,°F", "-,-,-,F", "x,mA,y,z", "h,,,"])
def test_a_preamble_with_a_word_like_a_unit_changes_no_unit(tmp_path: Path, above: str) -> None:
    """Spreadsheets fill each line of a preamble up to the cells of the header."""
    for head in (
        "Time [s],Current [A],Voltage [V],Temp [°C]",
        "time_s,current_a,voltage_v,temperature_c",
    ):
        log = read(tmp_path, f"{above}\n{head}", rows_of("{k},{amps},380,20"))
        assert (log.time_s[1], log.current_a[1], log.temperature_c[1]) == (1.0, 1.0, 20.0)


@pytest.mark.parametrize(("heading", "cell"), [("TimeMS", "{ms}"), ("TimeUS", "{us}")])
def test_a_time_of_milliseconds_or_microseconds_by_its_name(
    tmp_path: Path, heading: str, cell: str
) -> None:
    log = read(tmp_path, f"{heading},Current,Voltage,Temp", rows_of(cell + ",{amps},360,20"))
    assert log.duration_s == pytest.approx(0.02 * (ROWS - 1))


@pytest.mark.parametrize(
    ("columns", "second_s"),
    [("time=Time:0.02", 0.02), ("time=Time[ms]:20", 0.02), ("time=Time[min]:0.5", 30.0)],
)
def test_a_factor_of_time_is_that_of_its_unit(
    tmp_path: Path, columns: str, second_s: float
) -> None:
    log = read(tmp_path, "Time,Current,Voltage,Temp", rows_of("{k},{amps},360,20"), columns)
    assert log.time_s[1] == pytest.approx(second_s)


def test_a_unit_in_the_cells_of_one_probe_is_not_that_of_the_other(tmp_path: Path) -> None:
    head = "time [s],current [A],voltage [V],T1,T2"
    with pytest.raises(InputError):
        read(tmp_path, head, rows_of("{k},{amps},360,20 °C,68 °F"), "temperature=T1+T2")


@pytest.mark.parametrize(
    ("heads", "columns", "mean_c"),
    [
        ("T1 [°C],T2 [°F]", "temperature=T1+T2", None),
        ("T1,T2 [K]", "temperature=T1+T2", None),
        ("T1 [°C],T2", "temperature=T1+T2", 44.0),
        ("T1 [°C],T2 [C]", "temperature=T1+T2", 44.0),
        ("T1 [°F],T2 [°F]", "temperature=T1+T2", 20.0 / 3.0),
        ("T1 [°C],T2 [°F]", "temperature=T1+T2[°F]", 20.0 / 3.0),
    ],
)
def test_probes_that_the_user_joins_have_one_unit(
    tmp_path: Path, heads: str, columns: str, mean_c: float | None
) -> None:
    head, rows = f"Time,Current,Voltage,{heads}", rows_of("{k},{amps},360,20,68")
    if mean_c is None:
        with pytest.raises(InputError, match="the headings have different units"):
            read(tmp_path, head, rows, columns)
    else:
        np.testing.assert_allclose(read(tmp_path, head, rows, columns).temperature_c, mean_c)


@pytest.mark.parametrize(
    ("heading", "columns", "is_read"),
    [
        ("Current", "current=Current[mA]", True),
        ("Current", "current=Current", True),
        ("Current [A]", "current=Current [A][mA]", True),
        ("Current", "current=Current[A]", False),
        ("Current [A]", None, False),
    ],
)
def test_a_stated_unit_must_be_that_of_the_cells(
    tmp_path: Path, heading: str, columns: Any, is_read: bool
) -> None:
    head, rows = f"time [s],{heading},voltage [V],temp [°C]", rows_of("{k},{amps}000 mA,360,20")
    if is_read:
        log = read(tmp_path, head, rows, columns)
        np.testing.assert_allclose(log.current_a, np.arange(ROWS) % 7)
    else:
        with pytest.raises(InputError, match=r"cells have another unit than the heading .got 'mA"):
            read(tmp_path, head, rows, columns)


def test_cells_of_two_units_are_refused(tmp_path: Path) -> None:
    rows = [*rows_of("{k},{amps} A,360 V,20", 59), "59,500 mA,360 V,20"]
    with pytest.raises(InputError, match=r"Current: row 1 is not a number .got '0 A'"):
        read(tmp_path, "Time,Current,Voltage,Temp", rows)


def test_a_row_of_units_can_show_that_a_heading_is_another_quantity(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no plain heading of time"):
        read(tmp_path, "t,Current,Voltage\n°C,A,V", rows_of("{k},{amps},360"))


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("kind", [pa.timestamp, pa.duration])
def test_arrow_times_have_their_own_unit(kind: Any, unit: str) -> None:
    per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    counts = pa.array(per_second * np.arange(60), pa.int64())
    columns = {"current": np.arange(60.0) % 7, "voltage": np.full(60, 360.0)}
    frame = pa.table({"time": counts.cast(kind(unit)), **columns})
    log = Log.from_dataframe(frame, temperature_c=20.0)
    np.testing.assert_array_equal(log.time_s, np.arange(60.0))


def test_arrow_times_of_day_are_clock_times() -> None:
    counts = pa.array(86_370 + np.arange(60), pa.int32())
    clock = pa.array([k % 86_400 for k in counts.to_pylist()], pa.int32()).cast(pa.time32("s"))
    columns = {"current": np.arange(60.0) % 7, "voltage": np.full(60, 360.0)}
    log = Log.from_dataframe(pa.table({"time": clock, **columns}), temperature_c=20.0)
    np.testing.assert_array_equal(log.time_s - log.time_s[0], np.arange(60.0))


def test_a_factor_states_the_sign(tmp_path: Path) -> None:
    head = "Time,Current,Voltage,Temp"
    rows = [f"{k},{50 * (k % 2)},{360 - 5 * (k % 2)},20" for k in range(60)]
    log = read(tmp_path, head, rows, "current=Current:-1")
    assert log.current_a.min() == -50.0
    assert any(text.startswith("current looks inverted and was kept") for text in log.remarks)
    assert read(tmp_path, head, rows, "current=Current:0.5").current_a.max() == 25.0


@pytest.mark.parametrize(
    ("step", "is_read"),
    [
        ("{k}", True),
        ("{k}.5", True),
        ("{k}e-1", True),
        ("{clock_with_a_gap}", True),
        ("{sparse}", True),
        ("{sixtieth}", False),
        ("{ms}", False),
    ],
)
def test_numbers_without_a_unit_are_seconds_if_only_they_fit(
    tmp_path: Path, step: str, *, is_read: bool
) -> None:
    rows = [
        step.format(
            k=k,
            ms=20 * k,
            sixtieth=round(k / 60, 5),
            clock_with_a_gap=k % 30 + 3600 * (k // 30),
            sparse=20 * k - 15 * (k > 30),
        )
        + f",{k % 7},360,20"
        for k in range(ROWS)
    ]
    if is_read:
        log = read(tmp_path, "Time,Current,Voltage,Temp", rows)
        assert 'time = "Time" [s, assumed]' in log.assumed
    else:
        with pytest.raises(InputError, match="in seconds or another unit"):
            read(tmp_path, "Time,Current,Voltage,Temp", rows)
    read(tmp_path, "Time,Current,Voltage,Temp", rows, "time=Time[s]")


@pytest.mark.parametrize(("step_s", "per_row"), [(20.0, 20), (0.02, 20), (1.0, 1)])
def test_a_soc_tells_seconds_from_milliseconds(tmp_path: Path, step_s: float, per_row: int) -> None:
    """Of a pack of 60 Ah at 60 A, by rows of 20 s or of 20 ms."""
    rows = [
        f"{per_row * k},{60 + k % 7},360,20,{90 - 100 * step_s * k / 3600:.3f}" for k in range(60)
    ]
    if step_s == per_row:
        log = read(tmp_path, "Time,Current,Voltage,Temp,SoC", rows)
        assert log.time_s[1] - log.time_s[0] == step_s
    else:
        with pytest.raises(InputError, match="in seconds or another unit"):
            read(tmp_path, "Time,Current,Voltage,Temp,SoC", rows)


def test_stamps_of_whole_seconds_at_2_hz_are_read_and_of_whole_minutes_refused(
    tmp_path: Path,
) -> None:
    head = "Time [s],Current,Voltage,Temp"
    log = read(tmp_path, head, [f"{k // 2},{k % 7},360,20" for k in range(ROWS)])
    assert len(log) == ROWS / 2
    assert any("300 rows with the time stamp of the row before" in text for text in log.remarks)
    with pytest.raises(InputError, match="export fractions of a second"):
        read(tmp_path, head, [f"{k // 60 * 60},{k % 7},360,20" for k in range(ROWS)])


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("Time,Current (0.1A),Voltage (10mV),Temp (0.1C),SoC (0.1%)", "{k},{amps}0,36000,200,500"),
        ("Time,Current x10 (A),Voltage x100,Temp,SoC", "{k},{amps}0,36000,20,50"),
        ("Time,Current (uA),Voltage (uV),Temp (1C),SoC", "{k},{amps}000000,360000000,20,50"),
    ],
)
def test_the_unit_of_a_bit_in_the_heading(tmp_path: Path, head: str, row: str) -> None:
    log = read(tmp_path, head, rows_of(row))
    np.testing.assert_allclose(log.current_a, np.arange(ROWS) % 7)
    assert log.soc_pct is not None
    ends = [log.voltage_v[-1], log.temperature_c[-1], log.soc_pct[-1]]
    np.testing.assert_allclose(ends, [360.0, 20.0, 50.0])


def test_percents_below_one_are_read_if_the_user_says_so(tmp_path: Path) -> None:
    head, rows = "Time,Current,Voltage,Temp,SoC [%]", rows_of("{k},{amps},360,20,0.5")
    log = read(tmp_path, head, rows, "soc=SoC [%][%]")
    assert log.first_soc() == (0, 0.5)


@pytest.mark.parametrize("time", ["s", "ms", "us", "Julian day", "day since 1900"])
@pytest.mark.parametrize("amps", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("volts", [1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("kelvin", [0.0, 273.15])
def test_cures_taken_literally_lead_to_the_truth(
    tmp_path: Path, time: str, amps: float, volts: float, kelvin: float
) -> None:
    rate, start = {"s": (1, 0), "ms": (1e3, 0), "us": (1e6, 31e6)}.get(time, (1 / 86400, 45364))
    start += 2_415_020 * time.startswith("Julian")
    current = 10.37 + 10.0 * (np.arange(ROWS) % 7)
    rows = [
        f"{start + k * rate:.9f},{i * amps},{(380 - i / 10) * volts},{20 + kelvin}"
        for k, i in enumerate(current)
    ]
    columns: dict[str, str] = {}
    errors: list[str] = []
    while True:
        try:
            log = read(tmp_path, "Time,Current,Voltage,Temp", rows, columns or None)
            break
        except InputError as error:
            text = str(error)
        assert text not in errors
        errors.append(text)
        option = re.search(r"--columns '(.*?)'", text)
        assert option is not None, errors
        columns |= dict(column.split("=", 1) for column in option[1].split(","))
    assert len(errors) <= 2  # one names all units that are sure
    np.testing.assert_allclose(log.time_s - log.time_s[0], np.arange(ROWS), atol=1e-2)
    np.testing.assert_allclose(log.current_a, current)
    np.testing.assert_allclose(log.voltage_v, 380.0 - current / 10.0)
    np.testing.assert_allclose(log.temperature_c, 20.0)


# ---- a power cut


@pytest.mark.parametrize("last", ["", f"{ROWS},1", f"{ROWS},1,360,2"])
def test_zero_bytes_that_a_power_cut_leaves_are_omitted(tmp_path: Path, last: str) -> None:
    head = "Time,Current,Voltage,Temp"
    path = tmp_path / "t.csv"
    path.write_text("\n".join([head, *rows_of("{k},{amps},360,20"), last + "\0" * 4096]))
    log = read_log(path)
    assert len(log) == ROWS + (last.count(",") == head.count(","))
    assert any("zero bytes" in remark for remark in log.remarks)


# ---- daylight saving time


def local_rows(month: int, day: int) -> list[str]:
    """Return rows of Berlin's clock from three minutes before it changes in UTC."""
    start = datetime(2024, month, day, 0, 57, tzinfo=UTC)
    times = [
        (start + timedelta(seconds=k)).astimezone(ZoneInfo("Europe/Berlin")) for k in range(400)
    ]
    return [f"{time:%Y-%m-%d %H:%M:%S},{k % 7},360,20" for k, time in enumerate(times)]


@pytest.mark.parametrize(("month", "day"), [(3, 31), (10, 27)])
def test_a_stated_zone_tells_the_hours_that_a_clock_skips_or_repeats(
    tmp_path: Path, month: int, day: int
) -> None:
    columns = "time=Time[Europe/Berlin]"
    log = read(tmp_path, "Time,Current,Voltage,Temp", local_rows(month, day), columns)
    np.testing.assert_array_equal(log.time_s - log.time_s[0], np.arange(400.0))
    assert log.time_s[0] == datetime(2024, month, day, 0, 57, tzinfo=UTC).timestamp()


@pytest.mark.parametrize("is_long", [False, True])
def test_without_a_zone_a_change_of_the_clock_is_said(tmp_path: Path, *, is_long: bool) -> None:
    def read_local(month: int, day: int) -> Log:
        rows = local_rows(month, day)
        if not is_long:
            return read(tmp_path, "Time,Current,Voltage,Temp", rows)
        series = (("current", 5), ("voltage", 360), ("temperature", 20))
        times = [row.partition(",")[0] for row in rows]
        values = [f"bms {name},{value},{time}" for time in times for name, value in series]
        return read(tmp_path, "name,value,time", values)

    cure = "UTC" if is_long else r"--columns 'time=Time\[Europe/Berlin\]'"
    said = f"skips an hour after 2024-03-31 01:59:59: .*{cure}"
    assert sum(bool(re.search(said, remark)) for remark in read_local(3, 31).remarks) == 1
    with pytest.raises(InputError, match=f"repeats an hour after 2024-10-27 02:59:59; .*{cure}"):
        read_local(10, 27)


# ---- the choice of columns


@pytest.mark.parametrize("columns", ["current=A+B", "voltage=Voltage+A,current=B", "soc=A+B"])
def test_only_times_and_temperatures_are_joined(tmp_path: Path, columns: str) -> None:
    with pytest.raises(InputError, match="no column has this heading"):
        read(tmp_path, "Time,A,B,Voltage,Temp", rows_of("{k},{amps},5,360,20"), columns)


@pytest.mark.parametrize("name", ["time_s", "current_a", "soc_pct"])
def test_doubled_canonical_names_are_refused(tmp_path: Path, name: str) -> None:
    head = f"time_s,current_a,voltage_v,temperature_c,soc_pct,{name}"
    with pytest.raises(InputError, match=name):
        read(tmp_path, head, rows_of("{k},{amps},360,20,50,{k}"))
    columns = [np.arange(9.0)] * 6
    with pytest.raises(InputError, match=name):
        Log.from_dataframe(pa.Table.from_arrays(list(map(pa.array, columns)), head.split(",")))


@pytest.mark.parametrize("kind", ["csv", "parquet", "frame"])
@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("time_s,current_a,voltage_v,temperature_c,Voltage_V", "2 columns have this name"),
        ("Time [s],Current [A],Voltage [V],Temp [C],Voltage [V]", "no plain heading of voltage"),
        ("Time [s],Current [A],Voltage [V],Temp [C],Temp [C]", "holds no temperature"),
        ("Time [s],Current [A],Voltage [V],Temp [C],Time [s]", "2 columns have this name"),
        ("Time [s],Current [A],Voltage [V],Temp [C],x,x", ""),
        ("time_s,current_a,voltage_v,temperature_c,x,x", ""),
    ],
)
def test_doubled_headings_never_choose_a_column(
    tmp_path: Path, kind: str, head: str, words: str
) -> None:
    headings = head.split(",")
    values = [np.arange(60.0), np.arange(60.0) % 7.0, np.full(60, 360.0), np.full(60, 20.0)]
    values += [np.full(60, 300.0)] * (len(headings) - 4)
    frame = pa.Table.from_arrays([pa.array(each) for each in values], headings)

    def log() -> Log:
        if kind == "frame":
            return Log.from_dataframe(frame)
        if kind == "parquet":
            pq.write_table(frame, tmp_path / "t.parquet")
            return read_log(tmp_path / "t.parquet")
        rows = [",".join(map(str, row)) for row in zip(*values, strict=True)]
        return read(tmp_path, head, rows)

    if words and not (kind == "csv" and headings[0] == headings[-1]):
        with pytest.raises(InputError, match=words):
            log()
    elif words:  # in a text the first time is taken: it increases
        assert log().duration_s == 59.0
    else:
        assert log().voltage_v[0] == 360.0
        assert "2 other columns ignored: x, x" in log().remarks


def test_a_canonical_time_that_wraps_is_not_replaced_by_another_column(tmp_path: Path) -> None:
    head = "time_s,current_a,voltage_v,temperature_c,timestamp"
    rows = [f"{k % 300},{k % 7},360,20,{1.7e9 + k}" for k in range(ROWS)]
    with pytest.raises(InputError, match="runs backwards at row 301"):
        read(tmp_path, head, rows)


def test_a_time_of_something_else_replaces_none(tmp_path: Path) -> None:
    rows = [f"{k % 30},{k},{k % 7},360,20" for k in range(60)]
    with pytest.raises(InputError, match="runs backwards at row 31"):
        read(tmp_path, "Time [s],Charge Time [s],Current,Voltage,Temp", rows)


@pytest.mark.parametrize(
    "head",
    ["Test Time [s],Time [ms],Current,Voltage,Temp",
     "Test Time,Time,Current,Voltage,Temp\ns,ms,A,V,degC"],
)  # fmt: skip
def test_a_time_that_wraps_is_replaced_by_another_in_its_own_unit(
    tmp_path: Path, head: str
) -> None:
    log = read(tmp_path, head, [f"{k % 30},{20 * k},{k % 7},360,20" for k in range(60)])
    np.testing.assert_allclose(log.time_s, 0.02 * np.arange(60))
    log = read(tmp_path, head, [f"{k},{20 * k},{k % 7},360,20" for k in range(60)])
    np.testing.assert_array_equal(log.time_s, np.arange(60.0))


@pytest.mark.parametrize(
    ("current", "voltage", "ends"),
    [
        ("1,800", "380.5", (1800.0, 380.5)),  # one mark is decimal in this table
        ("1.800", "380,5", (1800.0, 380.5)),
        ("1,800", "380", None),  # nothing tells
        ("1,800", "380.500", (1800.0, 380.5)),  # no battery has 380,500 V …
        ("1,800", "380,500", (1.8, 380.5)),
        ("1,80", "380.5", (1.8, 380.5)),  # each column its own
        ("1.800;20,5", "380.5", (1.8, 380.5)),  # both are decimal
    ],
)
def test_a_mark_separates_thousands_if_the_other_is_decimal(
    tmp_path: Path, current: str, voltage: str, ends: tuple[float, float] | None
) -> None:
    stamp = "13.03.2024;23:59:{k:02d}"
    current, _, celsius = current.partition(";")
    rows = rows_of(f"{stamp};{current};{voltage};{celsius or 20}", 60)
    if ends is None:
        with pytest.raises(InputError, match=r"Strom: it may be 1\.800 or 1800: .*decimal point"):
            read(tmp_path, "Datum;Zeit;Strom;Spannung;Temperatur", rows)
        return
    log = read(tmp_path, "Datum;Zeit;Strom;Spannung;Temperatur", rows)
    assert (log.current_a[0], log.voltage_v[0]) == ends
    assert log.time_s[0] == 1_710_374_340.0


# ---- directions of current


@pytest.mark.parametrize(
    ("heading", "charge", "discharge", "is_read"),
    [
        ("State", "C", "D", True),
        ("Step Type", "CC Chg", "CC DChg", True),
        ("Mode", "Charging", "discharging", True),
        ("Status", "CHA", "DCH", True),
        ("Direction", "1", "2", False),
        ("Mode", "CHA", "7", None),
        ("Comment", "C", "D", None),
    ],
)
def test_an_unsigned_current_has_the_direction_of_its_state(
    tmp_path: Path, heading: str, charge: str, discharge: str, *, is_read: bool | None
) -> None:
    head = f"Time [s],Current [A],Voltage [V],Temp [°C],{heading}"
    amps = np.arange(ROWS) % 7 - 3.0
    words = {-1.0: charge, 0.0: "R", 1.0: discharge}
    rows = [f"{k},{abs(a)},{360 - a},20,{words[np.sign(a)]}" for k, a in enumerate(amps)]
    if is_read is False:
        with pytest.raises(InputError, match="Direction: row 1 does not say whether the unsigned"):
            read(tmp_path, head, rows)
        return
    log = read(tmp_path, head, rows)
    np.testing.assert_array_equal(log.current_a, amps if is_read else np.abs(amps))
    assert (f'current charges where "{heading}" says so' in log.assumed) is bool(is_read)


@pytest.mark.parametrize(
    ("charge", "discharge", "factor"),
    [
        ("Charge Current (A)", "Discharge Current (A)", 1.0),
        ("Battery charging current (mA)", "Battery discharging current (mA)", 1e-3),
        ("Chg Current", "DisChg Current", -1.0),
    ],
)
def test_currents_of_each_direction_are_joined(
    tmp_path: Path, charge: str, discharge: str, factor: float
) -> None:
    amps = np.arange(ROWS) % 7 - 3.0
    rows = [
        f"{k},{max(-a, 0) / factor},{max(a, 0) / abs(factor)},360,20" for k, a in enumerate(amps)
    ]
    log = read(tmp_path, f"Time [s],{charge},{discharge},Voltage,Temp", rows)
    np.testing.assert_allclose(log.current_a, amps)
    assert any(text.startswith(f'current = "{discharge} − {charge}"') for text in log.assumed)


@pytest.mark.parametrize(
    ("others", "found"),
    [
        ("Charge Current Limit [A],Discharge Current Limit [A]", "no plain heading of current"),
        ("Charge Current [A],Discharge Current [A],Current [A]", '"Current .A."'),
        ("Charge Current [A],Discharge Current [mA]", "no plain heading of current"),
        ("Current [A],Charge Current [A]", '"Current .A."'),
    ],
)
def test_other_pairs_of_currents_are_not_joined(tmp_path: Path, others: str, found: str) -> None:
    rows = rows_of("{k},360,20," + ",".join(["{amps}"] * (1 + others.count(","))))
    head = f"Time [s],Voltage [V],Temp [°C],{others}"
    if found.startswith("no"):
        with pytest.raises(InputError, match=found):
            read(tmp_path, head, rows)
    else:
        assert re.search(found, " ".join(read(tmp_path, head, rows).assumed))


def test_currents_of_both_signs_are_not_of_one_direction(tmp_path: Path) -> None:
    rows = [f"{k},{k % 3 - 1},{k % 2},360,20" for k in range(ROWS)]
    with pytest.raises(InputError, match="Discharge Current − Charge Current: these are no"):
        read(tmp_path, "Time [s],Charge Current,Discharge Current,Voltage,Temp", rows)


# ---- rows


def test_rows_in_errors_are_those_of_the_file(tmp_path: Path) -> None:
    stamps = [(k if k < 60 else k - 30) // 5 for k in range(100)]  # each second logged five times
    with pytest.raises(InputError, match="row 61"):
        read(
            tmp_path, "time_s,current_a,voltage_v,temperature_c", [f"{t},1,360,20" for t in stamps]
        )


def test_a_first_row_without_a_time_is_a_row(tmp_path: Path) -> None:
    head, rows = "Time,Current,Voltage,Temp", [",1,360,20", *rows_of("{k},{amps},360,20", 59)]
    log = read(tmp_path, head, rows)
    assert any("1 row without time" in text and "is row 1)" in text for text in log.remarks)
    with pytest.raises(InputError, match="row 61 is not a number"):
        read(tmp_path, head, [*rows, "59,x,360,20"])


def test_held_temperature_begins_with_its_first_value(tmp_path: Path) -> None:
    rows = [
        f"{k},,380,\n{k}.4,{k % 3},,\n{k}.5,,,{20 + k / 10 if k > 4 else ''}" for k in range(20)
    ]
    log = read(tmp_path, "Time,Current,Voltage,Temp", rows)
    assert log.temperature_c[:8].tolist() == [20.5] * 7 + [20.6]


def test_a_history_may_have_rows_without_an_entity(tmp_path: Path) -> None:
    each = ["battery_current,{k}", "battery_voltage,380", "battery_temperature,20", ",7"]
    rows = [f"{row.format(k=k)},2024-03-01T00:00:{k:02d}Z" for k in range(60) for row in each]
    assert len(read(tmp_path, "entity_id,state,last_changed", rows)) == 60


def test_values_of_a_history_hold_until_they_change_while_it_is_recorded(tmp_path: Path) -> None:
    rows = ["battery_temperature,20,2024-03-01T00:00:00Z"]
    for k in range(60 * 12):
        if 200 <= k < 420:
            continue  # the recorder was off
        stamp = f"2024-03-01T{k // 60:02d}:{k % 60:02d}:00Z"
        rows.append(f"battery_voltage,{52 + k % 3},{stamp}")
        if k % 50 == 0:
            rows.append(f"battery_current,{10 + k % 100},{stamp}")
        if k == 570:
            rows.append(f"battery_current,unavailable,{stamp}")
    log = read(tmp_path, "entity_id,state,last_changed", rows)
    minutes = np.round((log.time_s - log.time_s[0]) / 60.0).astype(int)
    assert minutes.tolist() == [*range(200), *range(450, 570), *range(600, 720)]
    assert log.current_a[49:51].tolist() == [10.0, 60.0]


# ---- zones


def test_dates_without_a_time_have_their_zone(tmp_path: Path) -> None:
    rows = [f"2024-03-01+00:{59 - k:02d},{k % 7},360,20" for k in range(60)]
    log = read(tmp_path, "Date,Current,Voltage,Temp", rows)
    assert log.assumed[0] == 'time = "Date" [date with zone]'
    np.testing.assert_array_equal(log.time_s, 1_709_251_200.0 + 60.0 * (np.arange(60) - 59.0))


def test_offsets_of_dates_are_taken_into_account(tmp_path: Path) -> None:
    stamps = ["2024-03-31T01:59:58+01:00", "2024-03-31T01:59:59+0100", "2024-03-31T03:00:00+02"]
    rows = [f"{stamp},{amps},380,20" for stamp, amps in zip(stamps, (1, 2, 3), strict=True)]
    log = read(tmp_path, "Time,Current,Voltage,Temp", rows)
    np.testing.assert_array_equal(log.time_s, 1_711_846_798.0 + np.arange(3.0))
    assert "date with zone" in log.assumed[0]


def test_an_order_of_days_and_months_is_that_of_fewer_days(tmp_path: Path) -> None:
    stamps = ["03/04/2024 23:59:58", "03/04/2024 23:59:59", "04/04/2024 00:00:00"]
    rows = [f"{stamp},{k},360,20" for k, stamp in enumerate(stamps)]
    log = read(tmp_path, "Time,Current,Voltage,Temp", rows)
    assert log.duration_s == 2.0
    assert log.assumed[0] == 'time = "Time" [date (day first, assumed) without zone]'


@pytest.mark.parametrize("mark", [" ", ","])
def test_local_dates_of_a_zone_are_seconds_since_1970(tmp_path: Path, mark: str) -> None:
    """In spring an hour is missing: it is no gap of the log."""
    heading = "Day,Clock" if mark == "," else "Stamp"
    stamps = ["2024-03-31 01:59:58", "2024-03-31 01:59:59", "2024-03-31 03:00:00"]
    rows = [f"{stamp.replace(' ', mark)},{k},360,20" for k, stamp in enumerate(stamps)]
    columns = f"time={heading.replace(',', '+')}[Europe/Berlin]"
    log = read(tmp_path, f"{heading},Current,Voltage,Temp", rows, columns)
    np.testing.assert_array_equal(log.time_s, 1_711_846_798.0 + np.arange(3.0))


# ---- numbers first, spellings where that fails


@pytest.mark.parametrize(
    ("cell", "amps"),
    [("\u22127", -7.0), ("7 A", 7.0), ("1'800", 1800.0), ("Current", np.nan), ("n/a", np.nan)],
)
def test_a_spelling_far_below_the_first_rows(tmp_path: Path, cell: str, amps: float) -> None:
    rows = [f"{k},{k % 7},360,20" for k in range(ROWS)]
    if cell.endswith("A"):
        rows = [f"{k},{k % 7} A,360,20" for k in range(ROWS)]
    rows[500] = f"500,{cell},360,20"
    log = read(tmp_path, "Time [s],Current,Voltage [V],Temp [°C]", rows, "current=Current:1.0001")
    at = np.flatnonzero(log.time_s == 500.0)
    np.testing.assert_allclose(log.current_a[at], [] if np.isnan(amps) else [amps], rtol=1e-3)
    assert len(log) == ROWS - int(np.isnan(amps))


def test_marks_of_one_column_tell_those_of_another(tmp_path: Path) -> None:
    rows = [f'{k},"{1000 + k:,}",{360 + k % 5 / 10},20' for k in range(ROWS)]
    log = read(tmp_path, "Time [s],Current [mA],Voltage [V],Temp [°C]", rows)
    np.testing.assert_allclose(log.current_a, 1.0 + 1e-3 * np.arange(ROWS))


@pytest.mark.parametrize("stamp", ["%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M:%SZ", "%d.%m.%Y %H:%M:%S"])
def test_dates_are_read_alike_however_they_are_spelled(tmp_path: Path, stamp: str) -> None:
    start = datetime(2024, 3, 13, 23, 55, tzinfo=UTC)
    rows = [f"{start + timedelta(seconds=k):{stamp}},{k % 7},360,20" for k in range(ROWS)]
    log = read(tmp_path, "Time,Current [A],Voltage [V],Temp [°C]", rows)
    np.testing.assert_array_equal(log.time_s, start.timestamp() + np.arange(ROWS))


def test_infinite_time_is_a_row_without_time(tmp_path: Path) -> None:
    rows = [f"{'inf' if k == 7 else k},{10 * (k % 2)},{380 - k % 2},21" for k in range(60)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["Time,Current,Voltage,Temp", *rows, ""]), encoding="utf-8")
    with warnings.catch_warnings(action="error"):
        log = read_log(path)
    assert len(log) == 59


def test_a_first_row_with_nothing_but_a_soc_is_not_dropped_in_silence(tmp_path: Path) -> None:
    head = "time_s,current_a,voltage_v,temperature_c,soc_pct\n,,,,80"
    log = read(tmp_path, head, rows_of("{k},{amps},380,20,"))
    assert any(remark.startswith("1 row without time, current") for remark in log.remarks)
