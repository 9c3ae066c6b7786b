"""Configuration of the service: one model for the TOML file, the command line and the reference.

Each key is declared once, as a field of `RunConfig` with its type, bounds, default, unit and help.
The TOML file has the same keys; `cangauge.cli.config_options` makes the options of the command
line from them, which take precedence over the file; `python -m cangauge.service.config` prints the
reference of all keys as Markdown. Paths in a file are relative to it::

    model = "leaf.json"
    channel = "can0"
    vehicle = "leaf_aze0"           # or: dbc = "car.dbc" and map = "car.toml"
    record = "record/drive.log"

    [bus_options]
    bitrate = 500000

    [checks.voltage]                # as in a map file, and before it
    lowest = 240
    highest = 410
"""

from __future__ import annotations

import os
import re
import socket
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self, get_args, get_origin

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    PrivateAttr,
    StrictBool,
)
from pydantic.fields import FieldInfo

from cangauge._config import read_toml, validated
from cangauge._logging import LogFormat, LogLevel
from cangauge.bus.mapping import CheckMap, MessageMap, Overrides, RuleMap
from cangauge.bus.open import BusAddress, bus_address, is_interface_name
from cangauge.bus.publish import FrameIds
from cangauge.bus.time_source import TimeSourceName
from cangauge.bus.vehicle import PRESETS, Vehicle
from cangauge.errors import InputError
from cangauge.estimation.power import PackLimits
from cangauge.estimation.settings import (
    VALID_STD_PCT,
    EstimatorSettings,
    Filter,
    FullCharge,
    LongRest,
    Method,
)
from cangauge.logs.log import TEMPERATURE_SOURCES, TemperatureSource
from cangauge.model.delay_line import GAP_S
from cangauge.service.addresses import HttpAddress, http_address, read_mqtt_password
from cangauge.service.loop import CHECKPOINT_EVERY_S, LoopSettings
from cangauge.service.pipeline import PipelineSettings
from cangauge.service.recording import RecordLimits
from cangauge.service.state import StateSettings, state_path

if TYPE_CHECKING:
    from cangauge.service.mqtt import MqttSettings

DEFAULT_VEHICLE: Final = "generic"
"""Default of `replay` as well, so that both commands work together without options."""


@dataclass(frozen=True)
class OptionInfo:
    """Data of a key for the command line and the reference.

    Parameters
    ----------
    metavar : str
        Placeholder of the value in help texts; "" for a key of the file only.
    flags : tuple of str
        Option names; empty: the key's name with dashes.
    unit : str
    default : str
        Default in words, where the field's own default is not enough.
    needs_restart : bool
        A reload does not apply a change of this key.
    is_path : bool
        A path, relative to the file that it is in.
    """

    metavar: str = ""
    flags: tuple[str, ...] = ()
    unit: str = ""
    default: str = ""
    needs_restart: bool = False
    is_path: bool = False


def _key(
    default: Any,
    text: str,
    metavar: str = "",
    *flags: str,
    unit: str = "",
    default_text: str = "",
    needs_restart: bool = False,
    is_path: bool = False,
    **bounds: float | str,
) -> Any:
    info = OptionInfo(metavar, flags, unit, default_text, needs_restart, is_path)
    field: FieldInfo = Field(default, description=text, **bounds)  # type: ignore[call-overload] # bounds are numbers or patterns
    field.metadata.append(info)
    return field


def option_info(field: FieldInfo) -> OptionInfo:
    """Return the option data of a key's field."""
    return next((each for each in field.metadata if isinstance(each, OptionInfo)), OptionInfo())


def _none_for_auto(value: object) -> object:
    if value == "auto":
        return None
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            raise ValueError("neither a number nor auto") from None
    return value


_TOPIC: Final = r"^[^/+#\s\x00]+(/[^/+#\s\x00]+)*$"
"""Topic of MQTT without wildcards and empty levels."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class IdsConfig(_Strict):
    """Standard ids of the published frames and of the replay clock."""

    soc_estimate: int = _key(
        0x5A0, "Id of SOC_ESTIMATE.", "ID", "--soc-estimate-id", ge=0, le=0x7FF
    )
    soc_detail: int = _key(0x5A1, "Id of SOC_DETAIL.", "ID", "--soc-detail-id", ge=0, le=0x7FF)
    replay_clock: int = _key(
        0x5AF, "Id of REPLAY_CLOCK.", "ID", "--replay-clock-id", ge=0, le=0x7FF, needs_restart=True
    )
    soc_health: int = _key(0x5A2, "Id of SOC_HEALTH.", "ID", "--soc-health-id", ge=0, le=0x7FF)
    soc_power: int = _key(0x5A3, "Id of SOC_POWER.", "ID", "--soc-power-id", ge=0, le=0x7FF)
    soc_cells: int = _key(
        0x5A4,
        "Id of SOC_CELLS, sent where the vehicle gives cell voltages.",
        "ID",
        "--soc-cells-id",
        ge=0,
        le=0x7FF,
    )


class ChecksConfig(_Strict):
    """Plausibility checks by signal, as in a map file; see `CheckMap`."""

    current: CheckMap = _key(CheckMap(), "Plausibility check of the current.")
    voltage: CheckMap = _key(CheckMap(), "Plausibility check of the voltage.")
    temperature: CheckMap = _key(CheckMap(), "Plausibility check of the temperature.")
    soc_reference: CheckMap = _key(CheckMap(), "Plausibility check of the vehicle's own SoC.")


class FullChargeConfig(_Strict):
    """Condition of a full pack; see `FullCharge`."""

    voltage_v: FiniteFloat = _key(..., "Least voltage.", unit="V", gt=0.0, le=1e4)
    current_a: FiniteFloat = _key(..., "Largest absolute current.", unit="A", ge=0.0, le=5e3)
    hold_s: FiniteFloat = _key(60.0, "Duration of both.", unit="s", ge=0.0, le=86400.0)
    soc_pct: FiniteFloat = _key(100.0, "SoC then.", unit="%", ge=0.0, le=100.0)
    soc_std_pct: FiniteFloat = _key(0.5, "Its standard deviation.", unit="%", ge=0.01, le=100.0)


class LongRestConfig(_Strict):
    """Condition of an open-circuit voltage at rest; see `LongRest`."""

    after_s: FiniteFloat = _key(
        7200.0, "Least duration of the rest.", unit="s", ge=60.0, le=30.0 * 86400.0
    )
    soc_std_pct: FiniteFloat = _key(
        2.0, "Standard deviation of the SoC by its voltage.", unit="%", ge=0.01, le=100.0
    )


def _limit(text: str, default_text: str, *, unit: str, le: float = 1e4) -> Any:
    return _key(None, text, unit=unit, default_text=default_text, ge=0.0, le=le)


class PollConfig(_Strict):
    """Requests for replies over ISO-TP; see `Poller`."""

    every_s: FiniteFloat = _key(
        10.0,
        "Interval between requests for the same reply. One is sent at a time; without an answer"
        " the interval doubles, up to a minute; while another tester asks, none is sent.",
        unit="s",
        ge=1.0,
        le=3600.0,
    )


class LimitsConfig(_Strict):
    """Limits for the possible currents and the energy left; see `PackLimits`."""

    min_voltage_v: FiniteFloat | None = _limit(
        "Lowest pack voltage.", "the pseudo-OCV at the lower end of the identified SoC", unit="V"
    )
    max_voltage_v: FiniteFloat | None = _limit(
        "Highest pack voltage.", "the pseudo-OCV at the upper end of the identified SoC", unit="V"
    )
    max_discharge_a: FiniteFloat | None = _limit(
        "Largest discharge current.", "the largest that the model was identified on", unit="A"
    )
    max_charge_a: FiniteFloat | None = _limit(
        "Largest charge current, positive.",
        "the largest that the model was identified on",
        unit="A",
    )
    cutoff_soc_pct: FiniteFloat | None = _limit(
        "SoC at which the energy ends; it also ends at the lowest voltage.",
        "the lower end of the identified SoC",
        unit="%",
        le=100.0,
    )


class MqttConfig(_Strict):
    """MQTT broker that takes the state; see `MqttSettings`."""

    broker: str = _key(
        ..., "Host name or address of the MQTT broker.", needs_restart=True, min_length=1
    )
    port: int | None = _key(
        None,
        "Its port.",
        default_text="1883, with TLS 8883",
        needs_restart=True,
        ge=1,
        le=65535,
    )
    tls: StrictBool = _key(False, "Encrypt, and check its certificate.", needs_restart=True)
    ca_file: str | None = _key(
        None,
        "PEM file of the authority that signed it.",
        default_text="the system's",
        needs_restart=True,
        is_path=True,
    )
    user: str | None = _key(None, "User name.", needs_restart=True)
    password_file: str | None = _key(
        None,
        "File with the password; or in CANGAUGE_MQTT_PASSWORD.",
        needs_restart=True,
        is_path=True,
    )
    topic_prefix: str = _key(
        "cangauge",
        "Topics are PREFIX/DEVICE/state and PREFIX/DEVICE/availability.",
        needs_restart=True,
        pattern=_TOPIC,
    )
    discovery_prefix: str = _key(
        "homeassistant",
        'Home Assistant\'s prefix of discovery; "" without discovery.',
        needs_restart=True,
        pattern=f"{_TOPIC}|^$",
    )
    device: str | None = _key(
        None,
        "Name of this service among those of the broker.",
        default_text="cangauge_HOST_CHANNEL",
        needs_restart=True,
        pattern=r"^[A-Za-z0-9_-]{1,64}$",
    )
    every_s: FiniteFloat = _key(
        1.0, "Interval of the states.", unit="s", needs_restart=True, ge=0.1, le=3600.0
    )


class RunConfig(_Strict):
    """Configuration of the service; each field describes itself."""

    model: str = _key(..., "Model file of `cangauge fit`.", "MODEL", "-m", "--model", is_path=True)
    interface: str | None = _key(
        None,
        "python-can interface: socketcan, udp_multicast, pcan, slcan and others. On udp_multicast"
        " whoever reaches its port may send; only the default bus drops what other machines send.",
        "I",
        default_text="socketcan if there is a vcan0, else udp_multicast on this machine",
        needs_restart=True,
    )
    channel: str | None = _key(
        None,
        "Channel, e.g. can0.",
        "C",
        default_text="vcan0, or 239.74.163.2",
        needs_restart=True,
    )
    bus_options: dict[str, StrictBool | int | float | str] = _key(
        {},
        "Further argument of the bus driver, e.g. bitrate=500000.",
        "K=V",
        "--bus-option",
        needs_restart=True,
    )
    wait_for_bus: StrictBool = _key(
        False,
        "Start even if the bus is not available yet. A bus lost later is always reconnected.",
        "",
        "--wait-for-bus/--need-bus",
        needs_restart=True,
    )
    vehicle: str | None = _key(
        None,
        f"Vehicle preset: {', '.join(PRESETS)}.",
        "PRESET",
        default_text=f"{DEFAULT_VEHICLE}, without --dbc and --map",
    )
    dbc: str | None = _key(None, "DBC file of another vehicle; needs --map.", "FILE", is_path=True)
    map: str | None = _key(
        None,
        "TOML file: which signals are current, voltage and temperature, with sign and scale.",
        "FILE",
        is_path=True,
    )
    temperature: FiniteFloat | None = _key(
        None, "Constant temperature, instead of the bus's.", "C", unit="°C", ge=-60.0, le=120.0
    )
    temperature_source: TemperatureSource | None = _key(
        None,
        "Location of the temperature sensor, if the vehicle does not define it:"
        f" {', '.join(TEMPERATURE_SOURCES)}.",
        "SOURCE",
    )
    method: Method = _key(
        "ekf",
        "Published SoC: fusion (ekf), the inverse of the voltage model (newton), or Coulomb"
        " counting (coulomb).",
        "ekf|newton|coulomb",
    )
    filter: Filter = _key(
        "own",
        "Arithmetic of the Kalman filter: our own, or filterpy's (reference), slower, to check it.",
        "own|reference",
    )
    initial_soc: Annotated[FiniteFloat | None, BeforeValidator(_none_for_auto)] = _key(
        None,
        "SoC at the first sample, or auto: by the first voltages.",
        "P|auto",
        unit="%",
        default_text="auto",
        ge=0.0,
        le=100.0,
    )
    initial_soc_std: FiniteFloat = _key(
        1.0, "Standard deviation of the initial SoC.", "X", unit="%", ge=0.0, le=100.0
    )
    valid_std: FiniteFloat = _key(
        VALID_STD_PCT,
        "Standard deviation above which the SoC is published as degraded.",
        "X",
        unit="%",
        ge=0.01,
        le=100.0,
    )
    capacity_ah: FiniteFloat | None = _key(
        None, "Capacity.", "A", unit="Ah", default_text="the model's", ge=1e-3, le=1e5
    )
    max_gap_s: FiniteFloat = _key(
        GAP_S, "Longest step between samples that is not a gap.", "S", unit="s", ge=1e-3, le=3600.0
    )
    pair_within_s: FiniteFloat | None = _key(
        None,
        "Largest time between current and voltage of one sample.",
        "S",
        unit="s",
        default_text="0.02",
        ge=0.0,
        le=1.0,
    )
    time_source: TimeSourceName = _key(
        "receive",
        "Bus time: the receive stamps of the frames, or the log time that `cangauge replay` sends"
        " at speeds other than 1.",
        "receive|replay-clock",
        needs_restart=True,
    )
    timeout_s: FiniteFloat = _key(
        2.0, "Time without a sample after which the input is stale.", "S", unit="s", gt=0.0, le=1e9
    )
    ids: IdsConfig = _key(IdsConfig(), "Ids of the published frames.")
    messages: dict[str, MessageMap] = _key(
        {}, "Protection and period of messages, by name or id; before those of the vehicle."
    )
    rules: dict[str, RuleMap] = _key({}, "Further protection rules.")
    checks: ChecksConfig = _key(
        ChecksConfig(), "Plausibility checks by signal; before those of the vehicle."
    )
    record: str | None = _key(
        None,
        "Record the received frames (.log, .csv, .blf, .mf4, .mcap): `cangauge estimate` on them"
        " gives the live numbers, bit for bit; an .mcap also holds the estimates. A kill loses the"
        " last half second, the last 64 KiB of an .mcap, or a whole part of an .mf4. A full disk"
        " costs frames of the recording, never the estimate. An existing recording is kept: the"
        " next run is FILE-0001, FILE-0002, …",
        "FILE",
        needs_restart=True,
        is_path=True,
    )
    record_part_mb: FiniteFloat | None = _key(
        None,
        "Size of a part of the recording: NAME-RUN-PART. NAME-RUN denotes all its parts.",
        "MB",
        unit="MB",
        needs_restart=True,
        gt=0.0,
        le=1e9,
    )
    record_part_s: FiniteFloat | None = _key(
        None,
        "Duration of a part of the recording.",
        "S",
        unit="s",
        needs_restart=True,
        ge=1.0,
        le=1e9,
    )
    record_keep_mb: FiniteFloat | None = _key(
        None,
        "Total size of the recording; the oldest files are removed.",
        "MB",
        unit="MB",
        needs_restart=True,
        gt=0.0,
        le=1e9,
    )
    output: str | None = _key(
        None,
        "Table of the estimates, .csv or .parquet.",
        "FILE",
        "-o",
        "--output",
        needs_restart=True,
        is_path=True,
    )
    duration_s: FiniteFloat | None = _key(
        None, "Stop after this time.", "S", "--duration", unit="s", gt=0.0, le=1e9
    )
    until_idle_s: FiniteFloat | None = _key(
        None,
        "Stop when no sample came for this time, after the first.",
        "S",
        "--until-idle",
        unit="s",
        gt=0.0,
        le=1e9,
    )
    state: str | None = _key(
        None,
        "Keep SoC, its uncertainty and the delay line over restarts in this file, or in a file in"
        " this folder.",
        "FILE",
        default_text="systemd's StateDirectory, if there is one",
        needs_restart=True,
        is_path=True,
    )
    state_max_age_s: FiniteFloat = _key(
        7.0 * 86400.0,
        "Age above which the state is refused.",
        "S",
        "--state-max-age",
        unit="s",
        needs_restart=True,
        gt=0.0,
        le=1e9,
    )
    state_every_s: FiniteFloat = _key(
        CHECKPOINT_EVERY_S,
        "Interval between writes of the state.",
        "S",
        "--state-every",
        unit="s",
        ge=0.1,
        le=86400.0,
    )
    full_charge: FullChargeConfig | None = _key(None, "Set the SoC when the pack is full.")
    long_rest: LongRestConfig | None = _key(None, "Correct the SoC by the voltage of long rests.")
    limits: LimitsConfig = _key(LimitsConfig(), "Limits of the possible currents.")
    poll: PollConfig | None = _key(
        None, "Ask the battery controller for its replies over ISO-TP: the service then sends."
    )
    http: str | None = _key(
        None,
        "Serve /status, /healthz and /metrics (extra `metrics`) there, e.g. 127.0.0.1:9464. An"
        " address beyond loopback needs a token.",
        "HOST:PORT",
        needs_restart=True,
    )
    http_token_file: str | None = _key(
        None,
        "File with the bearer token that requests need; or in CANGAUGE_HTTP_TOKEN.",
        "FILE",
        needs_restart=True,
        is_path=True,
    )
    mqtt: MqttConfig | None = _key(None, "MQTT broker that takes the state (extra `mqtt`).")
    dashboard: str | None = _key(
        None,
        "Serve the live page there, e.g. 127.0.0.1:8642. An address beyond loopback needs a token,"
        " as with --http.",
        "HOST:PORT",
        needs_restart=True,
    )
    status_socket: str = _key(
        "auto",
        "Unix socket for `cangauge status`; auto: in the user's runtime folder.",
        "PATH|auto|off",
        needs_restart=True,
    )
    log_format: LogFormat = _key(
        "text", "Format of the events on stderr, one a line.", "text|json", needs_restart=True
    )
    log_level: LogLevel = _key(
        "info",
        "Lowest level of the events.",
        "debug|info|warning|error",
        needs_restart=True,
    )
    _file: str = PrivateAttr("the configuration")

    def named(self, file: str | PathLike[str]) -> Self:
        """Set the file that messages name; return self."""
        self._file = str(file)
        return self

    def address(self) -> BusAddress:
        """Return the bus address; may raise InputError."""
        interface = self.interface
        if interface is None and self.wait_for_bus and is_interface_name(self.channel):
            interface = "socketcan"  # cannot be detected while the interface is missing
        return bus_address(interface, self.channel, self.bus_options)

    def load_vehicle(self) -> Vehicle:
        """Return the vehicle; may raise InputError."""
        preset = self.vehicle
        if preset is None and self.dbc is None and self.map is None:
            preset = DEFAULT_VEHICLE
        return Vehicle.load(
            preset,
            self.dbc,
            self.map,
            temperature_c=self.temperature,
            pair_within_s=self.pair_within_s,
            overrides=Overrides(self._file, self.messages, self.rules, dict(self.checks)),
        )

    def pipeline_settings(self) -> PipelineSettings:
        """Return the settings of the estimator and its frames; may raise InputError."""
        full, rest = self.full_charge, self.long_rest
        return PipelineSettings(
            estimator=EstimatorSettings(
                method=self.method,
                filter=self.filter,
                initial_soc_pct=self.initial_soc,
                initial_soc_std_pct=self.initial_soc_std,
                valid_std_pct=self.valid_std,
                capacity_ah=self.capacity_ah,
                gap_s=self.max_gap_s,
                temperature_source=self.temperature_source or "unknown",
                full_charge=None if full is None else FullCharge(**full.model_dump()),
                long_rest=None if rest is None else LongRest(**rest.model_dump()),
                limits=PackLimits(**self.limits.model_dump()),
            ),
            time_source=self.time_source,
            ids=FrameIds(**self.ids.model_dump()),
        )

    def http_address(self) -> HttpAddress | None:
        """Return the address of HTTP, None without; may raise InputError."""
        return None if self.http is None else http_address(self.http, self.http_token_file)

    def mqtt_settings(self, bus: str) -> MqttSettings | None:
        """Return the MQTT broker for a bus of this name, None without; may raise InputError."""
        if self.mqtt is None:
            return None
        # An optional dependency: the import raises the error if it is missing.
        from cangauge.service.mqtt import MqttSettings  # noqa: PLC0415

        given = self.mqtt.model_dump(exclude={"password_file"})
        given["port"] = self.mqtt.port or (8883 if self.mqtt.tls else 1883)
        given["device"] = self.mqtt.device or re.sub(
            r"[^A-Za-z0-9_-]+", "_", f"cangauge_{socket.gethostname()}_{bus}"
        )
        password = read_mqtt_password(self.mqtt.password_file, os.environ)
        if password is not None and self.mqtt.user is None:
            raise InputError(
                "is missing", field="mqtt.user", cure="name the user whose password is given"
            )
        return MqttSettings(**given, password=password)

    def dashboard_address(self) -> HttpAddress | None:
        """Return the address of the live page, None without; may raise InputError."""
        if self.dashboard is None:
            return None
        return http_address(self.dashboard, self.http_token_file, field="dashboard")

    def unix_path(self) -> Path | None:
        """Return the path of the unix socket, if one is given."""
        return None if self.status_socket in {"auto", "off"} else Path(self.status_socket)

    def record_limits(self) -> RecordLimits:
        """Return size and number of the recording's parts; may raise InputError."""
        part_mb, keep_mb = self.record_part_mb, self.record_keep_mb
        return RecordLimits(
            part_bytes=None if part_mb is None else int(part_mb * 1e6),
            part_s=self.record_part_s,
            keep_bytes=None if keep_mb is None else int(keep_mb * 1e6),
        )

    def state_settings(self, environment: Mapping[str, str]) -> StateSettings | None:
        """Return where the state is kept, None if it is not; may raise InputError."""
        path = state_path(self.state, environment)
        if path is None:
            return None
        for other in (self.model, self.record, self.output, self.dbc, self.map):
            if other is not None and os.path.realpath(other) == os.path.realpath(path):
                raise InputError("is another file of this service", field="--state", value=other)
        return StateSettings(path, self.state_max_age_s, self.state_every_s)

    def loop_settings(self) -> LoopSettings:
        """Return time-outs, ends and intervals of the receive loop."""
        return LoopSettings(
            timeout_s=self.timeout_s,
            duration_s=self.duration_s,
            until_idle_s=self.until_idle_s,
            checkpoint_every_s=self.state_every_s,
            poll_every_s=None if self.poll is None else self.poll.every_s,
        )

    def check_poll(self, vehicle: Vehicle) -> None:
        """Raise InputError if `[poll]` is given where nothing can be asked for."""
        if self.poll is None:
            return
        problem = cure = ""
        if not vehicle.poll_targets:
            problem = f"no reply of the vehicle {vehicle.name} can be asked for"
            cure = (
                "use the preset leaf_ze1_polled for a Leaf of 40 or 62 kWh, or state isotp = true"
                " and request_id for a message of the map file; or remove [poll]"
            )
        elif self.time_source == "replay-clock":
            problem = "a replay has no battery that answers"
            cure = "remove [poll], or time_source"
        elif self.bus_options.get("listen_only"):
            problem = "a bus that only listens sends no requests"
            cure = "remove listen_only from [bus_options], or [poll]"
        if problem:
            raise InputError(problem, source=self._file, field="poll", cure=cure)


def _in_folder(model: type[BaseModel], data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return data of a file with its paths relative to the file's folder."""
    found = dict(data)
    for name in data.keys() & model.model_fields.keys():
        field, value = model.model_fields[name], data[name]
        if option_info(field).is_path and isinstance(value, str):
            found[name] = str(folder / value)
        elif isinstance(value, Mapping) and (inner := _own_model(field)) is not None:
            found[name] = _in_folder(inner, value, folder)
    return found


def _own_model(field: FieldInfo) -> type[BaseModel] | None:
    """Return the model of a key that is a table of further keys."""
    return next(
        (each for each in (field.annotation, *get_args(field.annotation)) if _is_own(each)), None
    )


def load_config(
    path: str | PathLike[str] | None, overrides: Mapping[str, Any] | None = None
) -> RunConfig:
    """Read a configuration; options of the command line take precedence over the file.

    Parameters
    ----------
    path : path-like, optional
        TOML file.
    overrides : mapping, optional
        Values by key; None: not given. Ids and bus options are merged with those of the file.

    Raises
    ------
    InputError
        Names the file (or the option), the key and the value.
    """
    given = {key: value for key, value in (overrides or {}).items() if value not in (None, {})}
    # Checked separately, so that an error names the source of the value.
    _check_options(given)
    if path is None:
        if "model" not in given:
            raise InputError(
                "is missing", field="-m/--model", cure="give -m MODEL (made by `cangauge fit`)"
            )
        return RunConfig.model_validate(given)
    data = read_toml(path)
    validated(RunConfig, _with_model(data), path)
    data = _in_folder(RunConfig, data, Path(path).parent)
    if given.keys() & {"vehicle", "dbc", "map"}:
        # A vehicle given as an option replaces the file's as a whole.
        data = {key: value for key, value in data.items() if key not in {"vehicle", "dbc", "map"}}
    for key in ("ids", "bus_options"):
        if key in data and key in given:
            given[key] = {**data[key], **given[key]}
    merged = {**data, **given}
    if "model" not in merged:
        raise InputError("is missing", source=path, field="model", cure="add it, or give -m MODEL")
    return validated(RunConfig, merged, path).named(path)


def _check_options(given: Mapping[str, Any]) -> None:
    try:
        validated(RunConfig, _with_model(given), "")
    except InputError as error:
        key = error.field or ""
        option = f"--{key.replace('_', '-')}"
        for each in config_keys():
            if each.name == key and each.option:
                option = each.option.rpartition(", ")[2].partition("/")[0]
        raise InputError(error.problem, field=option, value=error.value, cure=error.cure) from error


def _with_model(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return data with a model, which may come from elsewhere."""
    return {"model": "-", **data}


# --- Reference


@dataclass(frozen=True)
class ConfigKey:
    """A key of the configuration, for the reference and the command line.

    Parameters
    ----------
    name : str
        Dotted key of the TOML file, such as "ids.soc_detail".
    option : str
        Option names, such as "-m, --model"; "" for a key of the file only.
    kind : str
        Type in words.
    default, unit, bounds, text : str
    info : OptionInfo
    """

    name: str
    option: str
    kind: str
    default: str
    unit: str
    bounds: str
    text: str
    info: OptionInfo

    @property
    def help(self) -> str:
        """Help text of the option, with unit and default."""
        first, dot, rest = self.text.partition(". ")
        unit = f" [{self.unit}]" if self.unit else ""
        text = f"{first}{unit}. {rest}" if dot else f"{first.removesuffix('.')}{unit}."
        return f"{text} Default: {self.default}." if self.default else text


def config_keys() -> list[ConfigKey]:
    """Return all keys of the configuration with option, type, default, unit, bounds and help."""
    return list(_keys(RunConfig, ""))


def _keys(model: type[BaseModel], prefix: str) -> Iterator[ConfigKey]:
    for name, field in model.model_fields.items():
        if (inner := _own_model(field)) is not None:
            yield from _keys(inner, f"{prefix}{name}.")
            continue
        info = option_info(field)
        flags = info.flags or ((f"--{name.replace('_', '-')}",) if info.metavar else ())
        yield ConfigKey(
            name=prefix + name,
            option=", ".join(flags),
            kind=_kind(field.annotation),
            default=info.default or _default(field, info),
            unit=info.unit,
            bounds=_bounds(field),
            text=field.description or "",
            info=info,
        )


def _is_own(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, _Strict)


def _kind(annotation: Any) -> str:
    if get_origin(annotation) is Annotated:
        return _kind(get_args(annotation)[0])
    if get_origin(annotation) is Literal:
        return "one of " + ", ".join(map(str, get_args(annotation)))
    if get_origin(annotation) is dict:
        return "table"
    if isinstance(annotation, type):
        names = {bool: "true or false", float: "number", int: "whole number", str: "text"}
        return names.get(annotation, "table")
    return next(_kind(each) for each in get_args(annotation) if each is not type(None))


def _default(field: FieldInfo, info: OptionInfo) -> str:
    value = field.default
    if field.is_required() or value is None or isinstance(value, dict | BaseModel):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if info.metavar == "ID":
        return f"0x{value:X}"
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _bounds(field: FieldInfo) -> str:
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = [
        f"{sign} {getattr(part, name):g}"
        for part in field.metadata
        for name, sign in signs.items()
        if isinstance(getattr(part, name, None), int | float)
    ]
    return ", ".join(found)


def reference() -> str:
    """Return the reference of all keys as a Markdown table."""
    head = ("Key", "Option", "Type", "Default", "Unit", "Bounds", "Meaning")
    rows: list[tuple[str, ...]] = [head, tuple("---" for _ in head)]
    for key in config_keys():
        option = ", ".join(f"`{each}`" for each in key.option.split(", ") if each)
        cells = (f"`{key.name}`", option, key.kind, key.default, key.unit, key.bounds, key.text)
        rows.append(tuple(each.replace("|", "\\|") for each in cells))
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


if __name__ == "__main__":
    sys.stdout.write(reference())
