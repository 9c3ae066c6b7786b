"""Presets, DBC and map files: bound signals, and errors that name field and cure."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from cangauge.bus.protection import LEAF_RULE
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
    assert vehicle.current.codec.unit == "A"
    assert vehicle.voltage.codec.unit == "V"
    assert vehicle.soc_reference is not None
    if temperature_c is None:
        assert vehicle.temperature is not None
        assert math.isnan(vehicle.fixed_temperature_c)
    else:
        assert vehicle.fixed_temperature_c == temperature_c
        assert vehicle.temperature_source == "unknown"
    cells = () if vehicle.cells is None else vehicle.cells.keys
    assert set(vehicle.messages) == {*(signal.key for signal in vehicle.signals), *cells}
    assert len(vehicle.filters) == len(vehicle.wanted_ids)
    assert vehicle.pair_within_s == 0.020


def test_presets_are_known_in_any_spelling() -> None:
    assert Vehicle.load("Leaf-ZE0").name == "Nissan Leaf ZE0"
    assert Vehicle.load("leaf_ze0").messages[0x1DB].rule is LEAF_RULE


def test_a_car_without_temperature_on_its_bus_asks_for_one() -> None:
    with pytest.raises(InputError, match="no pack temperature") as caught:
        Vehicle.load("leaf_ze1")
    assert caught.value.field == "--vehicle"
    assert "--temperature" in str(caught.value.cure)


@pytest.mark.parametrize("temperature_c", [math.nan, math.inf, 300.0, -61.0])
def test_a_fixed_temperature_must_be_plausible(temperature_c: float) -> None:
    with pytest.raises(InputError, match="--temperature"):
        Vehicle.load("leaf_ze1", temperature_c=temperature_c)


def test_an_unknown_vehicle_suggests_the_closest() -> None:
    with pytest.raises(InputError, match="did you mean leaf_ze0") as caught:
        Vehicle.load("leafze0")
    assert caught.value.value == "leafze0"
    with pytest.raises(InputError, match="known are generic, leaf_ze0"):
        Vehicle.load("tesla")


def test_incomplete_or_contradictory_options_are_refused(own: Path) -> None:
    with pytest.raises(InputError, match="no vehicle is given"):
        Vehicle.load()
    with pytest.raises(InputError, match=r"--map.*does not name the signals"):
        Vehicle.load(dbc=own / "car.dbc")
    with pytest.raises(InputError, match=r"dbc: is missing"):
        Vehicle.load(map=own / "car.toml")
    with pytest.raises(InputError, match="given together"):
        Vehicle.load("generic", dbc=own / "car.dbc")


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


def test_the_map_file_may_name_the_dbc(own: Path) -> None:
    (own / "car.toml").write_text('dbc = "car.dbc"\n' + MAP)
    assert Vehicle.load(map=own / "car.toml").dbc_files == (str(own / "car.dbc"),)


def test_signals_may_come_from_two_dbc_files(own: Path) -> None:
    (own / "more.dbc").write_text(
        'BO_ 512 MORE: 8 X\n SG_ AmbientTemp : 0|8@1- (1,0) [0|0] "degC" X\n'
    )
    text = 'dbc = ["more.dbc"]\n' + MAP.replace("PackTemperature", "AmbientTemp")
    assert load(own, text).wanted_ids == (256, 512)


def test_units_of_the_dbc_are_converted(own: Path) -> None:
    text = MAP.replace("PackVoltage", "CellMilliVolts").replace("PackTemperature", "CoolantKelvin")
    vehicle = load(own, text)
    assert vehicle.voltage.codec.decode(bytes([0, 0, 0, 0, 0x0E, 0x74, 0, 0])) == pytest.approx(3.7)
    assert vehicle.temperature is not None
    assert vehicle.temperature.codec.decode(
        bytes([0]) + (2931).to_bytes(2, "little") + bytes(5)
    ) == pytest.approx(19.95)


def test_the_sign_applies_after_conversion(own: Path) -> None:
    text = MAP.replace("PackTemperature", "CoolantKelvin") + "sign = -1\n"
    temperature = load(own, text).temperature
    assert temperature is not None
    payload = bytes([0]) + (2931).to_bytes(2, "little") + bytes(5)
    assert temperature.codec.decode(payload) == pytest.approx(-19.95)


def test_an_unknown_unit_is_refused(own: Path) -> None:
    text = MAP.replace("PackTemperature", "OddUnit")
    with pytest.raises(InputError, match=r"temperature\.signal.*OddUnit.*furlong") as caught:
        load(own, text)
    assert "scale" in str(caught.value.cure)
    assert load(own, text + "scale = 2\noffset = -40\n").temperature is not None


def test_the_map_file_corrects_sign_and_scale(own: Path) -> None:
    text = MAP.replace("sign = -1", "sign = -1\nscale = 0.5\noffset = 3.0")
    payload = bytes.fromhex("FF380FA000000000")
    assert load(own, text).current.codec.decode(payload) == pytest.approx(0.5 * 20.0 + 3.0)


def test_the_map_file_may_fix_the_temperature(own: Path) -> None:
    vehicle = load(own, MAP.replace('signal = "PackTemperature"', "fixed_c = 21.5"))
    assert vehicle.temperature is None
    assert vehicle.fixed_temperature_c == 21.5
    assert load(own, temperature_c=5.0).fixed_temperature_c == 5.0


def test_the_map_file_adds_codes_and_conditions(own: Path) -> None:
    text = MAP.replace(
        "[temperature]", "not_available = [9999]\nwhen = { Counter = 3 }\n\n[temperature]"
    )
    voltage = load(own, text).voltage.codec
    assert 9999 in voltage.not_available
    assert voltage.is_in(bytes([0, 0, 0, 0, 0, 0, 3, 0]))
    assert not voltage.is_in(bytes([0, 0, 0, 0, 0, 0, 2, 0]))


def test_the_map_file_defines_protection_rules(own: Path) -> None:
    text = MAP + (
        '\n[messages.0x100]\nprotection = "mine"\nperiod_s = 0.5\n'
        "[rules.mine]\npolynomial = 0x2F\ninitial = 0xFF\ncounter_bits = 4\n"
    )
    message = load(own, text).messages[256]
    assert message.period_s == 0.5
    assert message.rule is not None
    assert (message.rule.polynomial, message.rule.counter_byte) == (0x2F, -2)


@pytest.mark.parametrize(
    ("old", "new", "field", "text"),
    [
        ('signal = "PackCurrent"', 'signal = "PackCurent"', "current.signal", "mean PackCurrent"),
        ('"PackVoltage"', '"PackTension"', "voltage.signal", "no such signal"),
        ('"BMS_Status"', '"BMS_Stats"', "current.message", "mean BMS_Status"),
        ('"BMS_Status"', '"0x101"', "current.message", "BMS_Status (0x100)"),
        ('"BMS_Status"', '"BMS_Temps"', "current.signal", "it is in BMS_Status"),
        ("sign = -1", "sign = 2", "current.sign", "must be 1 or -1"),
        ("sign = -1", "scale = 0", "current.scale", "must be greater than 0"),
        ("sign = -1", "scale = nan", "current.scale", "finite"),
        ("sign = -1", 'scale = "a"', "current.scale", "number"),
        ("sign = -1", "singn = -1", "current.singn", "did you mean sign"),
        ("sign = -1", "when = { Nonsense = 1 }", "current.when", "no such signal"),
        ("[voltage]", "[volts]", "volts", "did you mean voltage"),
        ('[voltage]\nsignal = "PackVoltage"\n', "", "voltage", "is missing"),
        ('"pack"', '"battery"', "temperature_source", "'battery'"),
        (
            'name = "my car"',
            "pair_within_s = 5",
            "pair_within_s",
            "must be at most 1",
        ),
        ('signal = "PackTemperature"', "", "temperature", "either signal or fixed_c"),
        ('signal = "PackTemperature"', "fixed_c = 900", "temperature.fixed_c", "120"),
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
        ('[messages.BMS_Status]\nprotection = "laef"', "messages.BMS_Status.protection", "known"),
        ('[messages.Nonsense]\nprotection = "leaf"', "messages.Nonsense", "no such message"),
        ("[messages.BMS_Status]\nperiod_s = -1", "messages.BMS_Status.period_s", "greater than 0"),
        (
            '[messages.BMS_Status]\nprotection = "r"\n[rules.r]\npolynomial = 7\ncrc_byte = 9',
            "messages.BMS_Status.protection",
            "does not fit",
        ),
        ("[rules.r]\npolynomial = 300", "rules.r.polynomial", "255"),
        ("[rules.r]\n", "rules.r.polynomial", "is missing"),
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
        (b"a = ", "not TOML"),
        (b"\xff\xfe\x00", "not TOML"),
        (b"[" * 5000, "not TOML"),
        (b"", "missing"),
    ],
)
def test_a_file_that_is_no_map_is_refused(own: Path, content: bytes, text: str) -> None:
    (own / "car.toml").write_bytes(content)
    with pytest.raises(InputError, match=text) as caught:
        load(own)
    assert caught.value.source == str(own / "car.toml")


def test_a_large_or_absent_map_is_refused(own: Path) -> None:
    (own / "car.toml").write_bytes(b"#" * 300_000)
    with pytest.raises(InputError, match="larger than"):
        load(own)
    with pytest.raises(InputError, match="no such file"):
        Vehicle.load(dbc=own / "car.dbc", map=own / "absent.toml")


def test_a_map_without_temperature_asks_for_one(own: Path) -> None:
    text = MAP.replace('[temperature]\nsignal = "PackTemperature"\n', "")
    with pytest.raises(InputError, match="temperature: is missing"):
        load(own, text)
    assert load(own, text, temperature_c=20.0).fixed_temperature_c == 20.0
