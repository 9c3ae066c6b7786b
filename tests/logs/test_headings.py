"""Headings as public exporters, data sets and parsers spell them: which column is what."""

from __future__ import annotations

import pytest

from cangauge.logs.column_map import ColumnMap
from cangauge.logs.columns import UnknownColumnsError, choose_columns
from cangauge.logs.headings import charge_scale, meaning_of, parse_heading

SPELLINGS = {
    "Arbin": (
        "Data Point,Date Time,Test Time (s),Step Time (s),Cycle Index,Step Index,TC_Counter1,"
        "Current (A),Voltage (V),Power (W),Charge Capacity (Ah),ACR (Ohm),dV/dt (V/s),"
        "Internal Resistance (Ohm),Aux_Temperature_1 (C),Aux_dT/dt_1 (C/s)",
        "Test Time (s)|Current (A)|Voltage (V)|Aux_Temperature_1 (C)|",
    ),
    "Arbin workbook": (
        "Date_Time,Test_Time(s),Step_Time(s),Voltage(V),Current(A),Charge_Capacity(Ah),"
        "Aux_Voltage(V)_1,Aux_Temperature(°)_1,Aux_Temperature(°)_2",
        "Test_Time(s)|Current(A)|Voltage(V)|Aux_Temperature(°)_1+Aux_Temperature(°)_2|",
    ),
    "Neware": (
        "Record ID,Step ID,Cycle ID,Realtime,Time(h:min:s.ms),Current(mA),Voltage(V),"
        "Capacity(mAh),Min-T(C),Max-T(C),Avg-T(C),Power(mW),dQ/dV(mAh/V),DCIR(O)",
        "Realtime|Current(mA)|Voltage(V)|Avg-T(C)|",
    ),
    "Neware with slashes": (
        "Record,Cycle-Index,Step-Index,StepTime/Sec,TestTime/Sec,Voltage/V,Current/mA,Capacity/mAh",
        "TestTime/Sec|Current/mA|Voltage/V||",
    ),
    "Land": (
        "Record Index,Cycle,Step,Relative Time(h:min:s.ms),Absolute Time,Cur(mA),Voltage(V),"
        "CapaCity(mAh)",
        "Relative Time(h:min:s.ms)|Cur(mA)|Voltage(V)||",
    ),
    "Maccor as CSV": (
        "Cyc#,Step,TestTime(s),StepTime(s),Capacity(Ah),Watt-hr,Current(A),Voltage(V),DPt Time,"
        "ACR,DCIR,Temp 1,EV Temp",
        "TestTime(s)|Current(A)|Voltage(V)|Temp 1|",
    ),
    "Novonix": (
        "Date and Time,Cycle Number,Step Type,Run Time (h),Step Time (h),Current (A),Potential (V),"
        "Capacity (Ah),Temperature (°C),dIdt (A/h),dVdt (V/h)",
        "Run Time (h)|Current (A)|Potential (V)|Temperature (°C)|",
    ),
    "BioLogic": (
        "mode,ox/red,error,control changes,time/s,control/V/mA,Ewe/V,I/mA,dq/mA.h,(Q-Qo)/mA.h,"
        "Ece/V,P/W,control/V,control/mA,Ewe-Ece/V",
        "time/s|I/mA|Ewe-Ece/V||",
    ),
    "Basytec": (
        "~Time[h],DataSet,Date,Time,t-Step[h],t-Set[h],Line,Command,U[V],I[A],Ah[Ah],T1[°C],R-DC",
        "~Time[h]|I[A]|U[V]|T1[°C]|",
    ),
    "Battery Data Format": (
        "Test Time / s,Voltage / V,Current / A,Unix Time / s,Cycle Count / 1,"
        "Surface Temperature / degC,Ambient Temperature / degC",
        "Test Time / s|Current / A|Voltage / V|Surface Temperature / degC|",
    ),
    "PyBaMM": (
        "Time [s],Current [A],Terminal voltage [V],Battery voltage [V],Discharge capacity [A.h]",
        "Time [s]|Current [A]|Battery voltage [V]||",
    ),
    "NASA ageing": (
        "Voltage_measured,Current_measured,Temperature_measured,Current_load,Voltage_load,Time",
        "Time|Current_measured|Voltage_measured|Temperature_measured|",
    ),
    "electric buses": (
        "TIME,CHARGE_STATUS,SPEED,SUM_MILE,SUM_VOLTAGE,SUM_CURRENT,SOC,MAX_CELL_VOLT,MAX_TEMP",
        "TIME|SUM_CURRENT|SUM_VOLTAGE||SOC",
    ),
    "car scanner": (
        "seconds,HV Battery Current,HV Battery Voltage,battery_celsius,Disp SoC,Disp Temp",
        "seconds|HV Battery Current|HV Battery Voltage|battery_celsius|Disp SoC",
    ),
    "a unit as the heading": ("seconds,amps,volts,celsius", "seconds|amps|volts|celsius|"),
    "Torque": (
        "GPS Time,Device Time,Longitude,GPS Speed (Meters/second),HV Battery Current(A),"
        "HV Battery Voltage(V),State of Charge(%)",
        "Device Time|HV Battery Current(A)|HV Battery Voltage(V)||State of Charge(%)",
    ),
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_headings_of_public_exporters(name: str) -> None:
    text, expected = SPELLINGS[name]
    headings = text.split(",")
    choice = choose_columns(headings)
    found = [
        "+".join(headings[place] for place in choice.chosen[quantity].places)
        if quantity in choice.chosen
        else ""
        for quantity in ("time", "current", "voltage", "temperature", "soc")
    ]
    assert "|".join(found) == expected


@pytest.mark.parametrize(
    "heading",
    ["Motor Current [A]", "Current [%]", "Step Time", "Max Cell Voltage", "12V Battery Volts",
     "Charge Time", "Amp-hr", "dV/dt (V/s)", "Voltage Setpoint [V]", "Inverter Temp"],
)  # fmt: skip
def test_other_quantities_are_not_taken(heading: str) -> None:
    assert not choose_columns([heading]).chosen


def test_several_of_a_kind_are_left_to_the_user() -> None:
    headings = ["Time [s]", "Battery Current [A]", "Battery Current [A]", "Voltage 1", "Voltage 2"]
    choice = choose_columns(headings)
    assert set(choice.chosen) == {"time"}
    unknown = UnknownColumnsError("x.csv", headings, choice, None)
    error = str(unknown.proposing(lambda _: True))
    assert "--columns 'time=Time [s],current=?,voltage=?'" in error
    assert error.endswith("; current is #2 or #3; voltage is Voltage 1 or Voltage 2")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("current=I, pack [A]", ("I, pack [A]", "A", 1.0)),
        ("current=I, pack [A]:-1", ("I, pack [A]", "A", -1.0)),
        ("current=I, pack [A][mA]:-0.5", ("I, pack [A]", "mA", -0.5)),
        ("current=#2", ("I, pack [A]", "A", 1.0)),
        ("current=ratio 1:2", ("ratio 1:2", "", 1.0)),
        ("current=RATIO  1:2[mA]", ("ratio 1:2", "mA", 1.0)),
    ],
)
def test_heading_unit_and_factor_are_told_apart(
    text: str, expected: tuple[str, str, float]
) -> None:
    headings = ["Time [s]", "I, pack [A]", "ratio 1:2", "U [V]"]
    column = choose_columns(headings, (), ColumnMap.of(text)).chosen["current"]
    assert (headings[column.places[0]], column.unit, column.factor) == expected


@pytest.mark.parametrize(
    ("heading", "quantity"),
    [("Current SoC [%]", "soc"), ("Time of Voltage [V]", "voltage"), ("x" * 300, None)],
)
def test_current_may_be_an_adjective_and_time_the_instant_of_anything(
    heading: str, quantity: str | None
) -> None:
    meaning = meaning_of(heading)
    assert (meaning and meaning.quantity) == quantity


@pytest.mark.parametrize(
    ("heading", "parts"),
    [
        ("max. SoC [%)", ("max. SoC", "%", "")),
        ("HVBatt_SOC_CAN5__per", ("HVBatt_SOC_CAN5_", "per", "")),
        ("Aux_Temperature_1 (F)", ("Aux_Temperature_1", "F", "")),
        (
            "HV Battery Current w/200A max clamp [A]",
            ("HV Battery Current w/200A max clamp", "A", ""),
        ),
        ("Dis-Charging I/mA", ("Dis-Charging I", "mA", "Dis-Charging")),
        ("step_index", ("step_index", "", "")),
    ],
)
def test_parts_of_a_heading(heading: str, parts: tuple[str, str, str]) -> None:
    assert parse_heading(heading) == parts


@pytest.mark.parametrize(
    ("heading", "scale"),
    [("dq/mA.h", 1e-3), ("Consumed Ah", 1.0), ("AmpHours", 1.0), ("Q (mAh)", 1e-3), ("Hr", None)],
)
def test_units_of_charge(heading: str, scale: float | None) -> None:
    assert charge_scale(heading) == scale


def test_unit_of_another_quantity_refutes_a_heading() -> None:
    assert meaning_of("Current", "km/h") is not None  # the row of units is not always one
    assert meaning_of("Current [km/h]") is None
    meaning = meaning_of("Current", "mA")
    assert meaning is not None
    assert meaning.unit == "mA"
