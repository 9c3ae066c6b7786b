"""The configuration: file, options, reference, and errors with source, field and value."""

from __future__ import annotations

from pathlib import Path

import pytest

from cangauge.errors import InputError
from cangauge.service.config import config_keys, load_config, reference
from cangauge.service.setup import address_of, load_vehicle, pipeline_settings
from cangauge.settings import FrameIds, PackLimits
from live import in_process, leaf_model_path


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "car.toml"
    path.write_text(text)
    return path


def test_a_whole_file(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        """
        model = "leaf.json"
        interface = "socketcan"
        channel = "can3"
        vehicle = "leaf_aze0"
        method = "newton"
        initial_soc = 81.5
        initial_soc_std = 3
        time_source = "replay-clock"
        timeout_s = 0.5
        record = "out/drive.log"
        [bus_options]
        bitrate = 500000
        fd = false
        [ids]
        soc_estimate = 0x123
        soc_health = 0x124
        [limits]
        min_voltage_v = 300
        max_charge_a = 40
        """,
    )
    config = load_config(path)
    assert config.model == str(tmp_path / "leaf.json")
    assert config.record == str(tmp_path / "out" / "drive.log")
    address = address_of(config)
    assert (address.interface, address.channel) == ("socketcan", "can3")
    assert dict(address.options) == {"bitrate": 500000, "fd": False}
    settings = pipeline_settings(config)
    assert settings.ids == FrameIds(soc_estimate=0x123, soc_health=0x124)
    assert settings.estimator.limits == PackLimits(min_voltage_v=300.0, max_charge_a=40.0)
    assert settings.time_source == "replay-clock"
    assert settings.estimator.method == "newton"
    assert settings.estimator.initial_soc_pct == 81.5
    assert config.timeout_s == 0.5
    assert load_vehicle(config).name == "Nissan Leaf AZE0"


def test_options_take_precedence_over_the_file(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        'model = "a.json"\nvehicle = "leaf_aze0"\ninitial_soc = 50\n'
        "[ids]\nsoc_estimate = 0x10\nsoc_detail = 0x11\n",
    )
    options = {"model": "b.json", "dbc": "car.dbc", "map": "car.toml", "initial_soc": "auto"}
    config = load_config(path, options | {"method": None, "ids": {"soc_detail": 0x99}})
    assert config.model == "b.json"
    assert config.vehicle is None  # the file's car is not mixed with another one's DBC
    assert config.dbc == "car.dbc"
    assert config.initial_soc is None
    assert config.method == "ekf"
    assert (config.ids.soc_estimate, config.ids.soc_detail) == (0x10, 0x99)


@pytest.mark.parametrize(
    ("text", "field", "say"),
    [
        ('model = "m"\nmetod = "ekf"', "metod", "method"),
        ('model = "m"\nmethod = "magic"', "method", "magic"),
        ('model = "m"\ninitial_soc = 130', "initial_soc", "130"),
        ('model = "m"\ninitial_soc = "full"', "initial_soc", "neither a number nor auto"),
        ('model = "m"\ntimeout_s = 0', "timeout_s", "must be greater than 0"),
        ('model = "m"\n[ids]\nsoc_detail = 0x800', "ids.soc_detail", "2047"),
        ('model = "m"\ntimeout_s = "2 s"', "timeout_s", "must be a valid number (got '2 s')"),
        ('model = "m"\ntimeout_s = nan', "timeout_s", "finite"),
        ('model = "m"\n[limits]\nmin_voltage_v = -3', "limits.min_voltage_v", "at least 0"),
        ('model = "m"\n[messages.A]\nperiod_s = 1', "messages", "unknown key"),
        ('model = "m"\n[rules.A]\npolynomial = 1', "rules", "unknown key"),
        ('model = "m"\n[checks.current]\nlowest = 1', "checks", "unknown key"),
        ('vehicle = "generic"', "model", "is missing"),
        ('modle = "x"', "modle", "did you mean model"),
        ("model = 3", "model", "must be a valid string"),
        ("model = ", None, "not TOML"),
    ],
)
def test_errors_name_file_field_and_value(
    tmp_path: Path, text: str, field: str | None, say: str
) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_config(path)
    assert caught.value.source == str(path)
    assert caught.value.field == field
    assert say in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"model": "m", "method": "magic"}, "--method"),
        ({"model": "m", "initial_soc": "x"}, "--initial-soc"),
        ({"model": "m", "initial_soc_std": -1.0}, "--initial-soc-std"),
        ({"model": "m", "ids": {"soc_estimate": -1}}, "ids.soc_estimate"),
        ({}, "-m/--model"),
    ],
)
def test_errors_of_the_command_line_name_the_option(options: dict[str, object], field: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config(None, options)
    assert caught.value.field == field


def test_equal_ids_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, 'model = "m"\n[ids]\nsoc_detail = 0x5A0\n')
    with pytest.raises(InputError, match=r"car.toml: ids.soc_detail: soc_estimate has the same id"):
        load_config(path)
    with pytest.raises(InputError, match="no such file"):
        load_config("/nowhere/car.toml")


def test_the_interface_of_a_missing_bus_follows_from_its_name() -> None:
    waiting = load_config(None, {"model": "a.json", "channel": "can7", "wait_for_bus": True})
    assert str(address_of(waiting)) == "socketcan can7"
    group = load_config(None, {"model": "a.json", "channel": "239.1.1.1", "wait_for_bus": True})
    assert address_of(group).interface == "udp_multicast"
    with pytest.raises(InputError, match="can7"):
        address_of(load_config(None, {"model": "a.json", "channel": "can7"}))


def test_each_key_is_described_and_each_option_declared_once() -> None:
    keys = config_keys()
    assert set(keys) > {"model", "ids.soc_estimate", "full_charge.voltage_v"}
    assert all(key["description"] for key in keys.values())
    flags = [flag for key in keys.values() if "option" in key for flag in key["option"].split(", ")]
    assert len(flags) == len(set(flags))
    (row,) = [row for row in reference().splitlines() if "`until_idle_s`" in row]
    assert row.startswith("| `until_idle_s` |  | number |  | s | > 0, ≤ 1e+09 | Stop when")


def test_the_reference_has_a_row_for_each_key() -> None:
    rows = reference().splitlines()[2:]
    assert [row.split("`")[1] for row in rows] == list(config_keys())


def test_check_reads_what_run_would_read(tmp_path: Path) -> None:
    """Without the bus, which need not be there."""
    path = write(
        tmp_path,
        f'model = "{leaf_model_path()}"\ninterface = "socketcan"\nchannel = "can3"\n'
        'vehicle = "leaf_aze0"\n[ids]\nsoc_estimate = 0x123\n',
    )
    found = in_process("check", path, "--json")
    assert found.code == 0, found.err
    assert (found.json["bus"], found.json["vehicle"]) == ("socketcan can3", "Nissan Leaf AZE0")
    assert found.json["received"] == ["0x1DB", "0x55B", "0x5C0"]
    assert found.json["published"][0] == "0x123 SOC_ESTIMATE"
    shown = in_process("check", path)
    assert (shown.code, "0x123 SOC_ESTIMATE" in shown.out) == (0, True)
    for text, say in (
        ('model = "none.json"', "none.json: no such file"),
        (
            f'model = "{leaf_model_path()}"\nvehicle = "leaf_aze0"\n[ids]\nsoc_power = 0x1DB',
            "0x1DB",
        ),
        (f'model = "{leaf_model_path()}"\nstate = "no/x.json"', "no/x.json"),
        (f'model = "{leaf_model_path()}"\nrecord = "x.csv"', "x.csv: --record: a recording is a"),
    ):
        ended = in_process("check", write(tmp_path, text))
        assert (ended.code, ended.out, len(ended.err.splitlines())) == (2, "", 1)
        assert say in ended.err
