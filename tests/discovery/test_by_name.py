"""Signals of a DBC are found by the names and units that public DBC files of other makes use."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest

from cangauge.bus.database import load_dbc
from cangauge.extras.discovery.by_name import named_signals
from processor import at_most

# make: signals with their units; the first two are current and voltage of the pack
PUBLIC = {
    "tesla": (
        ("BMS_packCurrent", "A"), ("BMS_packVoltage", "V"), ("BMS_maxDischargeCurrent", "A"),
        ("BMS_chargeVoltageTarget", "V"), ("DI_motorCurrent", "A"), ("PCS_dcdcLvBusVolt", "V"),
    ),
    "tesla_132": (
        ("SmoothBattCurrent132", "A"), ("BattVoltage132", "V"), ("MaxChargeCurrent252", "A"),
        ("DCDCvoltage2B4", "V"), ("DCDCcurrent2B4", "A"),
    ),
    "ford": (
        ("BattTrac_I_Actl", "Amps"), ("BattTrac_U_Actl", "Volts"), ("BattTrac_U_LimHi", "Volts"),
        ("BattTrac_U_LimLo", "Volts"), ("MtrTrac2_I_Actl", "Amps"), ("BattULo_U_Actl", "Volts"),
    ),
    "vw": (
        ("BMS_IstStrom", "Unit_Amper"), ("BMS_IstSpannung", "Unit_Volt"),
        ("BMS_MaxStrom_Laden", "Unit_Amper"), ("DCW_IstSpannung_NV", "Unit_Volt"),
    ),
    "gm": (
        ("HVBatteryCurrent", "A"), ("HVBatteryVoltage", "V"), ("HVBatteryMaxCellVoltage", "V"),
        ("AuxBatteryVoltage", "V"), ("MotorCurrentPhaseA", "A"),
    ),
    "bmw": (
        ("Battery_Current", "Amps"), ("Battery_Volts", "Volts"), ("DC_link", "Volts"),
        ("Charging_Current_Max", "Amps"), ("Discharge_Voltage_Min", "Volts"),
    ),
    "nissan": (
        ("LB_Current", "A"), ("LB_Total_Voltage", "V"), ("LB_Discharge_Power_Limit", "kW"),
        ("Cell_Voltage_Max", "V"),
    ),
    "china": (
        ("BMS_PackCurrent", "A"), ("BMS_PackVoltage", "V"), ("VCU_MaxChargeCurrent", "A"),
        ("VCU_TargetVoltage", "V"), ("BMS_Cell01_V", "V"),
    ),
    "without_units": (
        ("Pack_Current", ""), ("Pack_Voltage", ""), ("High_Cell_Volt", ""), ("Low_Cell_Volt", ""),
        ("MaxChargeCurrent", ""),
    ),
    "blank_units": (
        ("Pack_Current", " "), ("Pack_Voltage", " "), ("High_Cell_Volt", " "),
    ),
    "stellantis": (
        ("HV_BATT_REAL_CURR_HD", "A"), ("HV_BATT_REAL_VOLT_HD", "V"),
        ("HV_BATT_MAX_REAL_CURR", "A"), ("HV_BATT_NOM_CH_VOLTAGE", "V"),
        ("HV_BATT_PEAK_DISCH_CURR_HD", "A"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("make", list(PUBLIC))
def test_the_packs_signals_come_first_by_name(make: str, tmp_path: Path) -> None:
    lines = ['VERSION "1"', "NS_ :", "BS_:", "BU_: V"]
    for number, (name, unit) in enumerate(reversed(PUBLIC[make])):
        lines.append(f"BO_ {256 + number} M{number}: 8 V")
        lines.append(f' SG_ {name} : 7|16@0+ (0.1,0) [0|0] "{unit}" V')
    (tmp_path / "car.dbc").write_text("\n".join([*lines, ""]))
    found = named_signals(load_dbc(tmp_path / "car.dbc"), [])
    assert found["current"][0].signal == PUBLIC[make][0][0]
    assert found["voltage"][0].signal == PUBLIC[make][1][0]


def test_a_temperature_is_found_by_its_unit(tmp_path: Path) -> None:
    (tmp_path / "car.dbc").write_text(
        'VERSION "1"\nNS_ :\nBS_:\nBU_: V\nBO_ 256 BMS_Measure2: 8 V\n'
        ' SG_ TModMax : 7|8@0- (1,0) [0|0] "degC" V\n'
        ' SG_ TModMin : 15|8@0- (1,0) [0|0] "degC" V\n'
        ' SG_ InverterTemp : 23|8@0- (1,0) [0|0] "degC" V\n'
    )
    frames = [
        can.Message(arbitration_id=256, data=[hot, 24, 60, 0, 0, 0, 0, 0], is_extended_id=False)
        for hot in (*[25] * 3000, 31)
    ]
    found = named_signals(load_dbc(tmp_path / "car.dbc"), frames)["temperature"]
    assert [each.signal for each in found] == ["TModMax", "TModMin"]
    assert (found[0].low, found[0].high) == (25.0, 31.0)  # of the whole capture


def test_milliamperes_are_found_with_their_sign(tmp_path: Path) -> None:
    (tmp_path / "bench.dbc").write_text(
        'VERSION "1"\nNS_ :\nBS_:\nBU_: V\nBO_ 2566869221 PackMeas: 8 V\n'
        ' SG_ I_mod : 7|32@0- (1,0) [0|0] "mA" V\n SG_ U_mod : 39|32@0+ (1,0) [0|0] "mV" V\n'
    )
    frames = []
    for row, amps in enumerate(np.repeat([5, 40, -20, 0, 30, 10, -5, 20] * 5, 20).tolist()):
        data = (-1000 * amps).to_bytes(4, "big", signed=True)  # positive charges
        data += (52_000 - 30 * amps).to_bytes(4, "big")
        frames.append(can.Message(0.1 * row, arbitration_id=0x18FF50E5, data=data))
    found = named_signals(load_dbc(tmp_path / "bench.dbc"), frames)
    assert [found[role][0].signal for role in ("current", "voltage")] == ["I_mod", "U_mod"]
    assert found["current"][0].evidence > 0.9


def test_a_long_name_takes_no_longer_than_its_letters(tmp_path: Path) -> None:
    name = "hvbatt" * 20 + "xCurrent"
    (tmp_path / "car.dbc").write_text(
        'VERSION "1"\nNS_ :\nBS_:\nBU_: V\nBO_ 256 M: 8 V\n'
        f' SG_ {name} : 0|16@1+ (1,0) [0|0] "A" V\n'
    )
    with at_most(1.0):
        found = named_signals(load_dbc(tmp_path / "car.dbc"), [])
    assert [each.signal for each in found["current"]] == [name]
