"""Presets, DBC and map files: bound signals, and errors that name field and cure."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from cangauge.bus.protection import RULES, ProtectionRule
from cangauge.bus.vehicle import PRESETS, Vehicle
from cangauge.errors import InputError

DBC = """VERSION ""

BU_: BMS

BO_ 256 BMS_Status: 8 BMS
 SG_ PackCurrent : 7|16@0- (0.1,0) [-1000|1000] "A" X
 SG_ PackVoltage : 23|16@0+ (0.1,0) [0|1000] "V" X
 SG_ CellMilliVolts : 39|16@0+ (1,0) [0|5000] "mV" X
 SG_ Counter : 51|4@0+ (1,0) [0|15] "" X
 SG_ Crc : 63|8@0+ (1,0) [0|255] "" X

BO_ 2566851454 BMS_Temps: 8 BMS
 SG_ PackTemperature : 0|8@1+ (1,-40) [-40|215] "degC" X
 SG_ CoolantKelvin : 8|16@1+ (0.1,0) [0|500] "K" X
 SG_ OddUnit : 24|16@1+ (0.1,0) [0|500] "furlong" X
 SG_ PackSoc : 40|8@1+ (0.5,0) [0|100] "%" X

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 256 20;
"""

MAP = """name = "my car"
temperature_source = "pack"
[current]
message = "BMS_Status"
signal = "PackCurrent"
sign = -1
[voltage]
signal = "PackVoltage"
[temperature]
signal = "PackTemperature"
"""


@pytest.fixture
def own(tmp_path: Path) -> Path:
    (tmp_path / "car.dbc").write_text(DBC)
    (tmp_path / "car.toml").write_text(MAP)
    return tmp_path


def load(folder: Path, text: str | None = None, **options: float) -> Vehicle:
    if text is not None:
        (folder / "car.toml").write_text(text)
    return Vehicle.load(dbc=folder / "car.dbc", map=folder / "car.toml", **options)


@pytest.mark.parametrize("name", list(PRESETS))
def test_every_preset_loads_and_wants_its_three_signals(name: str) -> None:
    temperature_c = 20.0 if PRESETS[name].lacks_temperature else None
    vehicle = Vehicle.load(name, temperature_c=temperature_c)
    assert (vehicle.current.codec.unit, vehicle.voltage.codec.unit) == ("A", "V")
    assert vehicle.soc_reference is not None
    if temperature_c is None:
        assert vehicle.temperature is not None
        assert vehicle.fixed_temperature_c is None
    else:
        assert (vehicle.fixed_temperature_c, vehicle.temperature_source) == (20.0, "unknown")
    signals = (*vehicle.signals, *vehicle.cells)
    assert set(vehicle.messages) == {signal.key for signal in signals}
    assert len(vehicle.filters) == len(vehicle.wanted_ids)
    assert vehicle.pair_within_s == 0.020


def test_presets_are_known_in_any_spelling() -> None:
    leaf = Vehicle.load("Leaf-ZE0")
    assert (leaf.name, leaf.temperature_source) == ("Nissan Leaf ZE0", "pack")
    assert leaf.messages[0x1DB][:2] == (RULES["leaf"], 0.01)
    assert (PRESETS["leaf_ze0"].periods_s, PRESETS["leaf_ze1"].periods_s) == (
        {0x5BC: 0.5}, {0x5BC: 0.1},
    )  # fmt: skip


@pytest.mark.parametrize("temperature_c", [math.nan, math.inf, 300.0, -61.0])
def test_a_fixed_temperature_must_be_plausible(temperature_c: float) -> None:
    with pytest.raises(InputError, match="--temperature"):
        Vehicle.load("leaf_ze1", temperature_c=temperature_c)


def test_a_dbc_with_a_map_file_gives_a_vehicle(own: Path) -> None:
    vehicle = load(own)
    assert vehicle.name == "my car"
    assert vehicle.wanted_ids == (256, 0x18FF0B7E)
    payload = bytes.fromhex("FF380FA000000000")
    assert vehicle.current.codec.decode(payload) == pytest.approx(20.0)  # −20 A on the bus
    assert vehicle.voltage.codec.decode(payload) == pytest.approx(400.0)
    assert vehicle.temperature is not None
    assert vehicle.temperature.is_extended
    assert vehicle.messages[256].period_s == 0.020  # as the DBC says
    assert vehicle.soc_reference is None
    corrected = load(own, MAP.replace("sign = -1", "sign = -1\nscale = 0.5\noffset = 3.0"))
    assert corrected.current.codec.decode(payload) == pytest.approx(0.5 * 20.0 + 3.0)


def test_the_map_file_may_name_dbc_files(own: Path) -> None:
    (own / "more.dbc").write_text(
        'BO_ 512 MORE: 8 X\n SG_ AmbientTemp : 0|8@1- (1,0) [0|0] "degC" X\n'
    )
    text = MAP.replace("PackTemperature", "AmbientTemp")
    assert load(own, 'dbc = "more.dbc"\n' + text).wanted_ids == (256, 512)
    (own / "car.toml").write_text('dbc = ["car.dbc", "more.dbc"]\n' + text)
    files = Vehicle.load(map=own / "car.toml").dbc_files
    assert files == (str(own / "car.dbc"), str(own / "more.dbc"))


KELVIN = bytes([0]) + (2931).to_bytes(2, "little") + bytes(5)


def test_a_map_may_begin_with_a_preset(own: Path) -> None:
    preset = Vehicle.load("leaf_aze0")
    (own / "car.toml").write_text('like = "Leaf-AZE0"\n[current]\ntimeout_s = 1.0\n')
    vehicle = Vehicle.load(map=own / "car.toml")
    checks = preset.current.checks.model_copy(update={"timeout_s": 1.0})
    assert vehicle == replace(preset, current=replace(preset.current, checks=checks))
    (own / "car.toml").write_text('like = "leaf_aze0"\n[messages.0x1DB]\nperiod_s = 0.02\n')
    slower = preset.messages[0x1DB]._replace(period_s=0.02)
    assert Vehicle.load(map=own / "car.toml").messages == preset.messages | {0x1DB: slower}
    (own / "car.toml").write_text(
        'like = "leaf_aze0"\nname = "mine"\nsoc = {signal = "PackCurrent", scale = 1}\n'
        'voltage = {signal = "voltage_v", highest = 9}\ntemperature = {fixed_c = 21.0}\n'
        '[messages.0x1DB]\nprotection = "crc_only"\n'
    )
    with pytest.raises(InputError, match=r"soc_reference\.signal.*no such signal"):
        Vehicle.load(map=own / "car.toml")
    vehicle = Vehicle.load(dbc=own / "car.dbc", map=own / "car.toml")
    assert vehicle.soc_reference is not None
    assert (vehicle.name, vehicle.soc_reference.codec.name) == ("mine", "PackCurrent")
    assert (vehicle.fixed_temperature_c, vehicle.voltage.checks.highest) == (21.0, 9.0)


def test_units_of_the_dbc_are_converted_before_the_sign(own: Path) -> None:
    text = MAP.replace("PackVoltage", "CellMilliVolts").replace("PackTemperature", "CoolantKelvin")
    vehicle = load(own, text)
    assert vehicle.voltage.codec.decode(bytes([0, 0, 0, 0, 0x0E, 0x74, 0, 0])) == pytest.approx(3.7)
    assert vehicle.temperature is not None
    assert vehicle.temperature.codec.decode(KELVIN) == pytest.approx(19.95)
    turned = load(own, text + "sign = -1\n").temperature
    assert turned is not None
    assert turned.codec.decode(KELVIN) == pytest.approx(-19.95)


def test_an_unknown_unit_is_refused(own: Path) -> None:
    text = MAP.replace("PackTemperature", "OddUnit")
    with pytest.raises(InputError, match=r"temperature\.signal.*OddUnit.*furlong") as caught:
        load(own, text)
    assert "scale" in str(caught.value.cure)
    assert load(own, text + "scale = 2\noffset = -40\n").temperature is not None


def test_the_temperature_may_be_fixed(own: Path) -> None:
    vehicle = load(own, MAP.replace('signal = "PackTemperature"', "fixed_c = 21.5"))
    assert (vehicle.temperature, vehicle.fixed_temperature_c) == (None, 21.5)
    assert load(own, temperature_c=5.0).fixed_temperature_c == 5.0
    text = MAP.replace('[temperature]\nsignal = "PackTemperature"\n', "")
    with pytest.raises(InputError, match="temperature: is missing"):
        load(own, text)
    assert load(own, text, temperature_c=20.0).fixed_temperature_c == 20.0


def test_the_map_file_adds_codes_conditions_and_rules(own: Path) -> None:
    more = "not_available = [9999]\nwhen = { Counter = 3 }\nlowest = 2\n[temperature]"
    voltage = load(own, MAP.replace("[temperature]", more)).voltage
    assert 9999 in voltage.codec.not_available
    assert [voltage.codec.is_in(bytes([*bytes(6), n, 0])) for n in (3, 2)] == [True, False]
    assert (voltage.checks.lowest, voltage.checks.highest) == (2.0, math.inf)
    message = load(own, MAP + (
        '\n[messages.0x100]\nprotection = "mine"\nperiod_s = 0.5\n'
        "[rules.mine]\npolynomial = 0x2F\ninitial = 0xFF\ncounter_bits = 4\n"
    )).messages[256]  # fmt: skip
    assert message.period_s == 0.5
    assert message.rule == ProtectionRule(polynomial=0x2F, initial=0xFF)


@pytest.mark.parametrize(
    ("old", "new", "field", "text"),
    [
        ('"BMS_Status"', '"0x101"', "current.message", "BMS_Status (0x100)"),
        ('"BMS_Status"', '"BMS_Temps"', "current.signal", "it is in BMS_Status"),
        ("sign = -1", "scale = nan", "current.scale", "finite"),
        ("sign = -1", 'scale = "a"', "current.scale", "number"),
        ("sign = -1", "singn = -1", "current.singn", "did you mean sign"),
        ("sign = -1", "when = { Nonsense = 1 }", "current.when", "no such signal"),
        ('"pack"', '"battery"', "temperature_source", "'battery'"),
        ('[voltage]\nsignal = "PackVoltage"\n', "", "voltage", "is missing"),
        ('signal = "PackTemperature"', "", "temperature", "either signal or fixed_c"),
    ],
)
def test_mistakes_in_a_map_name_field_and_cure(
    own: Path, old: str, new: str, field: str, text: str
) -> None:
    assert old in MAP
    with pytest.raises(InputError) as caught:
        load(own, MAP.replace(old, new, 1))
    assert caught.value.field == field
    assert text in str(caught.value)
    assert caught.value.source is not None
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("more", "field", "text"),
    [
        ("[messages.BMS_Status]\nperiod_s = -1", "messages.BMS_Status.period_s", "greater than 0"),
        (
            '[messages.BMS_Status]\nprotection = "r"\n[rules.r]\npolynomial = 7\ncrc_byte = 9',
            "messages.BMS_Status.protection",
            "does not fit",
        ),
        ("[rules.r]\npolynomial = 300", "rules.r.polynomial", "255"),
        ("[rules.r]\npolynomial = 7\ninitial = -1", "rules.r.initial", "at least 0"),
        ("[rules.r]\npolynomial = 7\ncounter_bits = 9", "rules.r.counter_bits", "at most 8"),
        ("[rules.r]\npolynomial = 7\ncounter_bits = 1", "rules.r", "from 2 to 8"),
        ("[rules.r]\npolynomial = 7\ncounter_shift = 5", "rules.r", "counter_shift"),
        ("[rules.r]\npolynomial = 7\ncounter_byte = -1", "rules.r", "cannot be the same"),
        ("[rules.r]\n", "rules.r.polynomial", "is missing"),
        ("[rules.r]\npolynomal = 7", "rules.r.polynomal", "mean polynomial"),
        ("[rules]\nr = 7", "rules.r", "must be a table"),
    ],
)
def test_mistakes_in_protection_name_the_field(own: Path, more: str, field: str, text: str) -> None:
    with pytest.raises(InputError) as caught:
        load(own, MAP + "\n" + more + "\n")
    assert caught.value.field == field
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"\xff\xfe\x00", "not TOML"),
        (b"[" * 5000, "not TOML"),
        (b"", "missing"),
        (b"#" * 300_000, "larger than"),
    ],
)
def test_a_file_that_is_no_map_is_refused(own: Path, content: bytes, text: str) -> None:
    (own / "car.toml").write_bytes(content)
    with pytest.raises(InputError, match=text) as caught:
        load(own)
    assert caught.value.source == str(own / "car.toml")
