"""Configuration of the service: one declaration for the TOML file, the options and the reference.

Each key is declared once, as a field with its type, bounds, default, unit and help. The command
line makes its options from the same fields (`cangauge.cli.options`), and
`python -m cangauge.service.config` prints the reference of all keys as Markdown. Options take
precedence over the file; paths in a file are relative to it::

    model = "leaf.json"
    channel = "can0"
    vehicle = "leaf_aze0"           # or: map = "car.toml"
    record = "record/drive.log"

    [bus_options]
    bitrate = 500000
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    PrivateAttr,
    StrictBool,
)

from cangauge._config import read_toml, validated
from cangauge._resources import shared_file
from cangauge.errors import InputError
from cangauge.service.events import LogFormat, LogLevel
from cangauge.service.status_client import value_at
from cangauge.settings import (
    GAP_S,
    START_STD_PCT,
    STRICT,
    TEMPERATURE_SOURCES,
    VALID_STD_PCT,
    CapacityAh,
    FrameIds,
    FullCharge,
    GapSeconds,
    LongRest,
    Method,
    PackLimits,
    StartPct,
    StartStdPct,
    TemperatureSource,
    TimeSourceName,
    ValidStdPct,
    setting,
)

_PRESETS: Final = ", ".join(read_toml(shared_file("dbc", "presets.toml")))
DEFAULT_VEHICLE: Final = "generic"
"""Default of `replay` as well, so that both commands work together without options."""


def key(default: Any, text: str, option: str = "", metavar: str = "", **more: Any) -> Any:
    """Return the field of a key with its default; further arguments as of `setting`."""
    about = {"option": option, "metavar": metavar} if option else {}
    return setting(text, default=default, **about, **more)


Positive = Annotated[FiniteFloat, Field(gt=0.0, le=1e9)]
"""A number that is not zero, in any unit."""


class PollConfig(BaseModel, extra="forbid", frozen=True):
    """Requests for replies over ISO-TP; see `Poller`."""

    every_s: FiniteFloat = key(
        10.0,
        "Interval between requests for the same reply. One request is sent at a time. Without a"
        " reply, the interval doubles, up to a minute. No request is sent while another tester is"
        " active.",
        unit="s",
        ge=1.0,
        le=3600.0,
    )


_TOPIC: Final = r"^[^/+#\s\x00]+(/[^/+#\s\x00]+)*$"
"""Topic of MQTT without wildcards and empty levels."""


class MqttConfig(BaseModel, extra="forbid", frozen=True):
    """MQTT broker that takes the state."""

    broker: str = key(..., "Host name or address of the MQTT broker.", min_length=1)
    port: int | None = key(
        None, "Port of the broker.", default_text="1883, with TLS 8883", ge=1, le=65535
    )
    tls: StrictBool = key(False, "Encrypt the connection, and check the broker's certificate.")
    ca_file: str | None = key(
        None,
        "PEM file of the authority that signed the broker's certificate.",
        default_text="the system's",
        is_path=True,
    )
    user: str | None = key(None, "User name.")
    password_file: str | None = key(
        None,
        "File with the password. Alternative: environment variable CANGAUGE_MQTT_PASSWORD.",
        is_path=True,
    )
    topic_prefix: str = key(
        "cangauge", "Topics are PREFIX/DEVICE/state and PREFIX/DEVICE/availability.", pattern=_TOPIC
    )
    discovery_prefix: str = key(
        "homeassistant",
        'Prefix of the topics for Home Assistant\'s discovery. "" disables discovery.',
        pattern=f"{_TOPIC}|^$",
    )
    device: str | None = key(
        None,
        "Name of this service on the broker.",
        default_text="cangauge_HOST_CHANNEL",
        pattern=r"^[A-Za-z0-9_-]{1,64}$",
    )
    every_s: FiniteFloat = key(
        1.0, "Interval of the published states.", unit="s", ge=0.1, le=3600.0
    )


class JudgeConfig(BaseModel, extra="forbid", frozen=True):
    """A second opinion on the SoC that the battery itself publishes."""

    folder: str = key(
        ..., "Folder for the judged logs, judgement.json and judgement.html.", is_path=True
    )
    keep: int = key(30, "Number of latest logs that are kept and judged.", ge=1, le=1000)


class PublishConfig(BaseModel, extra="forbid", frozen=True):
    """A gateway to an inverter, which gets the battery's frames with the estimated SoC."""

    profile: Literal["pylontech", "victron"] = key(
        ..., "Protocol of the inverter, which defines the frame with the SoC."
    )
    interface: str | None = key(
        None, "Driver of the inverter's bus, e.g. socketcan.", default_text="as without `interface`"
    )
    channel: str = key(
        ..., "Channel of the inverter's bus, e.g. can1. It must not be that of the battery."
    )
    bus_options: dict[str, StrictBool | int | float | str] = key(
        {}, "Further arguments of the driver of the inverter's bus."
    )


_NO_FILE: Final = "the configuration"


def _none_for_auto(value: object) -> object:
    if value == "auto":
        return None
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            raise ValueError("neither a number nor auto") from None
    return value


class RunConfig(BaseModel):
    """Configuration of the service; each field describes itself."""

    model_config = ConfigDict(**STRICT, frozen=True)

    model: str = key(..., "Model file of `cangauge fit`.", "-m, --model", "MODEL", is_path=True)
    interface: str | None = key(
        None,
        "python-can interface: socketcan, udp_multicast, pcan, slcan and others. A udp_multicast"
        " bus accepts packets from every machine that reaches its port; only the default bus"
        " drops packets from other machines.",
        "--interface",
        "I",
        restart=True,
        default_text="socketcan if there is a vcan0, else udp_multicast on this machine",
    )
    channel: str | None = key(
        None,
        "Channel, e.g. can0.",
        "--channel",
        "C",
        default_text="vcan0, or 239.74.163.2",
        restart=True,
    )
    bus_options: dict[str, StrictBool | int | float | str] = key(
        {},
        "Further argument of the bus driver, e.g. bitrate=500000.",
        "--bus-option",
        "K=V",
        restart=True,
    )
    wait_for_bus: StrictBool = key(
        False,
        "Start even if the bus is not available yet, and wait for it. A bus that is lost later is"
        " always reconnected.",
        restart=True,
    )
    vehicle: str | None = key(
        None,
        f"Vehicle preset: {_PRESETS}.",
        "--vehicle",
        "PRESET",
        default_text=f"{DEFAULT_VEHICLE}, without a map",
    )
    dbc: str | None = key(
        None,
        "DBC file of another vehicle. It is searched before the DBC files that the map names.",
        "--dbc",
        "FILE",
        is_path=True,
    )
    map: str | None = key(
        None,
        "Map file of another vehicle (TOML). It names the DBC, and the signals of current,"
        " voltage and temperature with sign and scale.",
        "--map",
        "FILE",
        is_path=True,
    )
    temperature: FiniteFloat | None = key(
        None,
        "Constant temperature, instead of a temperature from the bus.",
        "--temperature",
        "C",
        unit="°C",
        ge=-60.0,
        le=120.0,
    )
    temperature_source: TemperatureSource | None = key(
        None,
        "Location of the temperature sensor, if the vehicle does not define it:"
        f" {', '.join(TEMPERATURE_SOURCES)}.",
    )
    method: Method = key(
        "ekf",
        "Method that computes the published SoC. ekf: Kalman filter with voltage and charge;"
        " newton: inverse of the voltage model; coulomb: Coulomb counting.",
        "--method",
        "ekf|newton|coulomb",
    )
    initial_soc: Annotated[StartPct | None, BeforeValidator(_none_for_auto)] = None
    initial_soc_std: StartStdPct = START_STD_PCT
    valid_std: ValidStdPct = VALID_STD_PCT
    capacity_ah: CapacityAh | None = None
    max_gap_s: GapSeconds = GAP_S
    pair_within_s: FiniteFloat | None = key(
        None,
        "Largest time between the current and the voltage of one sample.",
        unit="s",
        default_text="0.02",
        ge=0.0,
        le=1.0,
    )
    time_source: TimeSourceName = key(
        "receive",
        "Source of the bus time. receive: receive timestamps of the frames; replay-clock: log"
        " time that `cangauge replay` sends at speeds other than 1.",
        "--time-source",
        "receive|replay-clock",
        restart=True,
    )
    timeout_s: Positive = key(
        2.0, "Time without a sample after which the input is stale.", unit="s"
    )
    ids: FrameIds = key(FrameIds(), "Ids of the published frames.")
    record: str | None = key(
        None,
        "Record the received frames (candump .log or .log.gz). `cangauge estimate` on the"
        " recording gives the live estimates bit for bit, if the keys that are not options of"
        " `estimate` have their defaults (docs/service.md). A kill loses the last half second. A"
        " full disk costs frames of the recording, but does not stop the estimate. An existing"
        " recording is kept: the next run writes FILE-0001, FILE-0002, …",
        "--record",
        "FILE",
        restart=True,
        is_path=True,
    )
    record_part_mb: Positive | None = key(
        None,
        "Largest size of a file of the recording. The files are named NAME-RUN-PART; commands"
        " accept NAME-RUN for all parts.",
        unit="MB",
        restart=True,
    )
    record_keep_mb: Positive | None = key(
        None,
        "Largest total size of the recording. Above it, the oldest files are removed.",
        unit="MB",
        restart=True,
    )
    duration_s: Positive | None = key(None, "Stop after this time.", unit="s")
    until_idle_s: Positive | None = key(
        None, "Stop when no sample has come for this time, after the first sample.", unit="s"
    )
    state: str | None = key(
        None,
        "Save SoC, its standard deviation and the delay line in this file, or in a file in this"
        " folder, and continue from them after a restart.",
        "--state",
        "FILE",
        restart=True,
        is_path=True,
        default_text="systemd's StateDirectory, if there is one",
    )
    state_max_age_s: Positive = key(
        7.0 * 86400.0, "Age above which a saved state is not used.", unit="s", restart=True
    )
    state_every_s: FiniteFloat = key(
        # A service that is killed and restarts within three seconds misses less than half a minute
        # of charge; 20 kB per write make 0.2 GB a day.
        10.0,
        "Interval between writes of the state.",
        unit="s",
        ge=0.1,
        le=86400.0,
    )
    full_charge: FullCharge | None = key(None, "Set the SoC when the pack is full.")
    long_rest: LongRest | None = key(None, "Correct the SoC by the voltage of long rests.")
    limits: PackLimits = key(PackLimits(), "Limits of the possible currents.")
    poll: PollConfig | None = key(
        None, "Ask the battery controller for its replies over ISO-TP: the service then sends."
    )
    publish: PublishConfig | None = key(
        None,
        "Hand the battery's frames on to an inverter, with the estimated SoC in them.",
        restart=True,
    )
    judge: JudgeConfig | None = key(
        None,
        "Judge the SoC that the battery itself publishes, at the end of each drive or charge.",
        restart=True,
    )
    http: str | None = key(
        None,
        "Address of /status, /healthz and /metrics (extra `metrics`), e.g. 127.0.0.1:9464. An"
        " address other than loopback needs a token.",
        "--http",
        "HOST:PORT",
        restart=True,
    )
    http_token_file: str | None = key(
        None,
        "File with the bearer token that requests need. Alternative: environment variable"
        " CANGAUGE_HTTP_TOKEN.",
        restart=True,
        is_path=True,
    )
    mqtt: MqttConfig | None = key(
        None, "MQTT broker that takes the state (extra `mqtt`).", restart=True
    )
    dashboard: str | None = key(
        None,
        "Address of the live page (extra `live`). A port alone, such as 8642, serves this machine"
        " only. An address other than loopback needs a token, as with --http.",
        "--dashboard",
        "HOST:PORT",
        restart=True,
    )
    live: Literal["child", "unit"] = key(
        "child",
        "Process that serves `dashboard`, `http` and `mqtt`. child: child process of the service;"
        " unit: `cangauge live CONFIG`, started separately.",
        restart=True,
    )
    status_socket: str = key(
        "auto",
        "Unix socket for `cangauge status`. auto: a socket in the user's runtime folder.",
        "--status-socket",
        "PATH|auto|off",
        restart=True,
    )
    log_format: LogFormat = key(
        "text", "Format of the events on stderr, one event per line.", restart=True
    )
    log_level: LogLevel = key("info", "Lowest level of the events that are logged.", restart=True)
    _file: str = PrivateAttr(_NO_FILE)
    _options: frozenset[str] = PrivateAttr(frozenset())

    @property
    def file(self) -> str:
        """File that messages name."""
        return self._file

    def named(self, file: str | PathLike[str], options: Iterable[str] = ()) -> Self:
        """Set the file that messages name, and the keys given as options; return self."""
        self._file, self._options = str(file), frozenset(options)
        return self

    @contextmanager
    def naming_keys(self) -> Iterator[None]:
        """Let errors of the values name file and key, not the option that was not given."""
        try:
            yield
        except InputError as error:
            key = (error.field or "").removeprefix("--").replace("-", "_")
            if error.source is not None or key in self._options or self._file == _NO_FILE:
                raise
            raise InputError(
                error.problem,
                source=self._file,
                field=key,
                value=error.value,
                cure=error.cure and re.sub("--([a-z][a-z-]*)", _as_key, error.cure),
            ) from error


def _as_key(option: re.Match[str]) -> str:
    return option[1].replace("-", "_") + " ="


def load_config(
    path: str | PathLike[str] | None, overrides: Mapping[str, Any] | None = None
) -> RunConfig:
    """Read a configuration; options of the command line take precedence over the file.

    `overrides` are values by key (None: not given); ids and bus options are merged with those of
    the file. An InputError names the file (or the option), the key and the value.
    """
    given = {name: value for name, value in (overrides or {}).items() if value not in (None, {})}
    data = {} if path is None else read_toml(path)
    for place in [name for name, key in config_keys().items() if key.get("is_path")]:
        table, _, name = place.rpartition(".")
        values = data.get(table) if table else data
        if isinstance(values, dict) and isinstance(file := values.get(name), str):
            values[name] = str(Path(path or "").parent / file)
    if given.keys() & {"vehicle", "dbc", "map"}:  # replaces the file's vehicle as a whole
        data = {name: data[name] for name in data if name not in {"vehicle", "dbc", "map"}}
    merged = data | given
    for name in given.keys() & {"ids", "bus_options"}:
        if isinstance(data.get(name), dict):
            merged[name] = data[name] | given[name]
    try:
        # Any name in place of a missing model: first what is wrong in the file.
        config = validated(RunConfig, {"model": "-"} | merged, path or "")
    except InputError as error:
        field = error.field or ""
        if value_at(given, field) is None:
            raise
        option = config_keys().get(field, {}).get("option", field).rpartition(", ")[2]
        raise InputError(error.problem, field=option, value=error.value, cure=error.cure) from error
    if "model" not in merged:
        raise InputError(
            "is missing",
            source=path,
            field="-m/--model" if path is None else "model",
            cure="give -m MODEL (made by `cangauge fit`)",
        )
    return config if path is None else config.named(path, given)


# --- Description of the keys


@cache
def config_keys() -> dict[str, dict[str, Any]]:
    """Return all keys by their dotted names, such as "ids.soc_detail".

    Each is its JSON schema, with what `setting` states of it.
    """
    schema = RunConfig.model_json_schema()
    return dict(_keys(schema, schema["$defs"]))


def _keys(
    table: dict[str, Any], tables: dict[str, Any], prefix: str = "", *, restart: bool = False
) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, field in table["properties"].items():
        # The type of an optional key is one of two; the other one is null.
        kind = field.get("anyOf", [field])[0]
        inner = tables.get(kind.get("$ref", "").rpartition("/")[2], {})
        key = {"restart": restart} | kind | field
        if "properties" in inner:
            yield from _keys(inner, tables, f"{prefix}{name}.", restart=key["restart"])
        else:
            yield prefix + name, key


def default_of(key: Mapping[str, Any]) -> str:
    """Return the default of a key in words, "" for none."""
    default = key.get("default")
    text = key.get("default_text", "")
    if text or default is None or isinstance(default, dict):
        return str(text)
    if isinstance(default, bool):
        return str(default).lower()
    if key.get("metavar") == "ID":
        return f"0x{default:X}"
    return f"{default:.10g}" if isinstance(default, float) else str(default)


_KINDS: Final = {
    "boolean": "true or false",
    "number": "number",
    "integer": "whole number",
    "string": "text",
}
_BOUNDS: Final = {"exclusiveMinimum": ">", "minimum": "≥", "maximum": "≤"}


def reference() -> str:
    """Return the reference of all keys as a Markdown table."""
    rows = [("Key", "Option", "Type", "Default", "Unit", "Bounds", "Meaning"), ("---",) * 7]
    for name, key in config_keys().items():
        flags = [f"`{flag}`" for flag in key.get("option", "").split(", ") if flag]
        kind = _KINDS.get(key.get("type", ""), "table")
        if "enum" in key:
            kind = f"one of {', '.join(key['enum'])}"
        bounds = [f"{sign} {key[bound]:g}" for bound, sign in _BOUNDS.items() if bound in key]
        about = (default_of(key), key.get("unit", ""), ", ".join(bounds), key["description"])
        rows.append((f"`{name}`", ", ".join(flags), kind, *about))
    cells = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in cells)


if __name__ == "__main__":
    sys.stdout.write(reference())
