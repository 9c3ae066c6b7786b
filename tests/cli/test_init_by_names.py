"""`cangauge init --dbc` without a capture: a map of the pack's own signals, and of no others."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from cangauge.bus.vehicle import Vehicle
from live import Ended, in_process, refused, succeeds

PACK = (
    'SG_ PackVoltage : 0|16@1+ (0.1,0) [0|0] "V"',
    'SG_ PackCurrent : 16|16@1- (0.1,0) [0|0] "A"',
)


def dbc(path: Path, messages: dict[str, tuple[str, ...]], more: str = "") -> Path:
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: GW BMS"]
    for number, (name, signals) in enumerate(messages.items(), 500):
        lines += [f"BO_ {number} {name}: 8 GW", *(f" {each} GW" for each in signals)]
    path.write_text("\n".join([*lines, more]), encoding="utf-8")
    return path


def init(path: Path, *more: object) -> Ended:
    return in_process("init", "--dbc", path, "-o", path.parent / "out", *more)


HV = 'SG_ HV_Battery_Voltage : 0|16@1+ (0.1,0) [0|0] "V"'
BATT_A = 'SG_ BattCurrent : 16|14@1+ (0.0625,-512) [0|0] "A"'
NONE: dict[str, tuple[dict[str, tuple[str, ...]], str]] = {
    "lamp": (
        {"ASSIST": ('SG_ Lampe_Rot : 16|2@1+ (1,0) [0|3] ""',), "HVB": (HV,)},
        "nothing can be the current",
    ),
    "stamp": ({"HVB": (HV, 'SG_ TIMESTAMP : 16|16@1+ (1,0) [0|0] ""')}, "nothing can be the curr"),
    "gear": ({"TCU": (HV, 'SG_ CurrentGear : 16|4@1+ (1,0) [0|8] ""')}, "of another value: gear"),
    "mode": (
        {"HVB": (PACK[1], 'SG_ tuneMode_V : 0|16@1+ (1,0) [0|0] ""')},
        "no unit",
    ),
    "light": (
        {"VCRIGHT_status": (
            'SG_ VCRIGHT_footwellLightCurrent : 16|12@1- (0.1,0) [0|0] "mA"',
            'SG_ VCRIGHT_vbatProt : 0|12@1+ (0.00544,0) [0|22.29] "V"',
        )},
        "holds up to 22.28 V",
    ),
    "12 V": (
        {"BAT11": (
            'SG_ BAT_SNSR_I : 16|16@1+ (0.01,-327) [-327|328] "A"',
            'SG_ BAT_SNSR_V : 0|16@1+ (0.001,0) [0|0] "V"',
        )},
        "holds up to 65.53 V",
    ),
    "steering": (
        {"EPAS_INFO": (
            'SG_ SteMdule_I_Est : 21|12@0+ (0.05,-64.0) [0|0] "Amps"',
            'SG_ SteMdule_U_Meas : 39|16@0+ (0.05,6.0) [0|0] "Volts"',
        )},
        "no word for a pack",
    ),
    "fan": (
        {"BMS": (PACK[0], 'SG_ FanCurrent : 16|16@1- (0.1,0) [0|0] "A"')},
        "fan",
    ),
    "its supply": (
        {"BMS": (PACK[1], 'SG_ BMS_supplyVoltage : 0|16@1+ (0.1,0) [0|0] "V"')},
        "supply",
    ),
    "another thing": (
        {"BMS": (PACK[0], 'SG_ GadgetCurrent : 16|16@1- (0.1,0) [0|0] "A"')},
        "gadget",
    ),
    "two sources": ({"HVB": (HV,), "LVB": (BATT_A,)}, "no current of its"),
    "loads": (
        {"HVEM_02": ('SG_ HVEM_IstStrom_HVVerbraucher : 0|12@1+ (0.1,-204.7) [0|0] "A"',),
         "DCDC_03": ('SG_ DC_IstSpannung_EKK_HV : 0|8@1+ (2,0) [0|508] "V"',)},
        "no word for a pack",
    ),
    "limits": (
        {"BMS": (
            'SG_ BMS_maxVoltage : 0|16@1+ (0.1,0) [0|0] "V"',
            'SG_ BMS_maxCurrent : 16|16@1- (0.1,0) [0|0] "A"',
        )},
        "of another value: max",
    ),
    "no units": (
        {"BMS": ('SG_ PackV : 0|16@1+ (0.1,0) [0|0] ""', 'SG_ PackI : 16|16@1- (0.1,0) [0|0] ""')},
        "no unit",
    ),
    "few bits": ({"BMS": (PACK[0], 'SG_ PackCurrent : 16|4@1- (10,0) [0|0] "A"')}, "4 bits"),
}  # fmt: skip


@pytest.mark.parametrize("name", list(NONE))
def test_no_map_is_made_of_other_signals(tmp_path: Path, name: str) -> None:
    messages, why = NONE[name]
    done = init(dbc(tmp_path / "car.dbc", messages))
    assert done.code == 1
    assert done.out.startswith("No map: ")
    assert why in " ".join(done.out.replace("\n", " ").split())
    assert "nothing was written" in done.err
    is_absent = "nothing can be" in done.err  # no drive would show it
    assert ("record a drive" in done.err, "docs/map-file.md" in done.err) != (is_absent, is_absent)
    assert not (tmp_path / "out").exists()


TRUE = {
    "pack": {"BMS": PACK},
    "ford": {
        "Battery_Traction_1": (
            'SG_ BattTrac_I_Actl : 0|15@1+ (0.05,-750) [0|0] "Amps"',
            'SG_ BattTrac_U_Actl : 16|10@1+ (0.5,0) [0|510.5] "Volts"',
        ),
        "Body": (BATT_A, 'SG_ BattULo_U_Actl : 0|8@1+ (0.0625,0) [0|15.9] "volt"'),
    },
    "gm": {
        "Hyb_Redundant": (
            'SG_ RdHVltBatPckCrnt : 0|13@1- (0.15,0) [0|0] "A"',
            'SG_ RdHVltBatPckVlt : 16|12@1+ (0.125,0) [0|0] "V"',
        ),
        "Battery_Voltage": ('SG_ BattCrntFltrd : 0|8@1- (0.5,0) [0|0] "A"',),
    },
    "of the message": {
        "BMS_State": (
            'SG_ ActualCurrent : 0|16@1- (0.1,0) [0|0] "A"',
            'SG_ TotalVoltage : 16|16@1+ (0.1,0) [0|0] "V"',
        ),
    },
    "two messages": {"BMS_1": (PACK[0],), "BMS_2": (PACK[1],)},
    "joined": {
        "HVBAT": (
            'SG_ hvbattcurrent : 0|16@1- (0.1,0) [0|0] "A"',
            'SG_ hvbattvoltage : 16|16@1+ (0.1,0) [0|0] "V"',
        ),
    },
}


@pytest.mark.parametrize("name", list(TRUE))
def test_the_packs_own_signals_become_a_map(tmp_path: Path, name: str) -> None:
    done = init(dbc(tmp_path / "car.dbc", TRUE[name]))
    assert done.code == 0, done.out
    answer, *_ = done.out.splitlines()
    car = Vehicle.load(map=tmp_path / "out" / "car.toml")
    own = next(iter(TRUE[name].values()))
    both = (car.current.codec.name, car.voltage.codec.name)
    assert name == "two messages" or {each.split()[1] for each in own} == {*both}
    assert f"current {car.current.message}.{both[0]} (?)" in answer
    assert "run.toml" in answer


def test_a_stated_voltage_admits_a_pack_of_48_v(tmp_path: Path) -> None:
    module = (PACK[1], 'SG_ PackVoltage : 0|16@1+ (0.001,0) [0|0] "V"')
    path = dbc(tmp_path / "car.dbc", {"BMS": module})
    assert init(path).code == 1
    assert init(path, "--nominal-voltage", 48).code == 0


def test_a_folder_is_created_with_those_above_it(tmp_path: Path) -> None:
    path = dbc(tmp_path / "car.dbc", {"BMS": PACK})
    succeeds("init", "--dbc", path, "-o", tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b" / "run.toml").is_file()
    refused(in_process("init", "--dbc", path, "-o", path / "b"), "car.dbc is a file")


def test_names_of_any_script_are_written_as_toml_allows(tmp_path: Path) -> None:
    battery = "Pack_Voltage_\U0001f50b\x7f[V]"
    names = f'BA_ "SystemSignalLongSymbol" SG_ 500 PackVoltage "{battery}";'
    names = f'BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;\n{names}'
    path = dbc(tmp_path / "car\U0001f697.dbc", {"BMS": PACK}, names)
    done = init(path)
    assert done.code == 0, done.err
    made = tomllib.loads((tmp_path / "out" / "car.toml").read_text(encoding="utf-8"))
    assert made["voltage"]["signal"] == battery
    assert made["dbc"] == str(path)
    assert Vehicle.load(map=tmp_path / "out" / "car.toml").voltage.message == "BMS"


def test_a_line_about_a_signal_that_is_gone_is_a_remark(tmp_path: Path) -> None:
    path = dbc(tmp_path / "car.dbc", {"BMS": PACK}, 'VAL_ 500 RenamedSignal 1 "on" 0 "off" ;\n')
    done = init(path)
    assert done.code == 0, done.err
    assert "note: " in done.err
    assert "of a signal that is gone: RenamedSignal" in done.err
