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
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    FiniteFloat,
    PrivateAttr,
    StrictBool,
)

from cangauge._config import read_toml, validated
from cangauge._logging import LogFormat, LogLevel
from cangauge.bus.mapping import MessageMap, Overrides, RuleMap
from cangauge.bus.open import BusAddress, bus_address, is_interface_name
from cangauge.bus.publish import FrameIds
from cangauge.bus.time_source import TimeSourceName
from cangauge.bus.vehicle import PRESETS, Vehicle
from cangauge.errors import InputError
from cangauge.estimation.power import PackLimits
from cangauge.estimation.settings import (
    VALID_STD_PCT,
    EstimatorSettings,
    FullCharge,
    LongRest,
    Method,
)
from cangauge.logs.log import TEMPERATURE_SOURCES, TemperatureSource
from cangauge.model.delay_line import GAP_S
from cangauge.service.addresses import HttpAddress, http_address, read_mqtt_password
from cangauge.service.config_tables import (
    ChecksConfig,
    ConfigKey,
    FullChargeConfig,
    IdsConfig,
    LimitsConfig,
    LongRestConfig,
    MqttConfig,
    PollConfig,
    Strict,
    key,
    keys_of,
    option_info,
    own_model,
)
from cangauge.service.loop import CHECKPOINT_EVERY_S, LoopSettings
from cangauge.service.pipeline import PipelineSettings
from cangauge.service.recording import RecordLimits
from cangauge.service.state import StateSettings, state_path

if TYPE_CHECKING:
    from cangauge.extras.live.mqtt import MqttSettings

DEFAULT_VEHICLE: Final = "generic"
"""Default of `replay` as well, so that both commands work together without options."""


def _none_for_auto(value: object) -> object:
    if value == "auto":
        return None
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            raise ValueError("neither a number nor auto") from None
    return value


class RunConfig(Strict):
    """Configuration of the service; each field describes itself."""

    model: str = key(..., "Model file of `cangauge fit`.", "MODEL", "-m", "--model", is_path=True)
    interface: str | None = key(
        None,
        "python-can interface: socketcan, udp_multicast, pcan, slcan and others. On udp_multicast"
        " whoever reaches its port may send; only the default bus drops what other machines send.",
        "I",
        default_text="socketcan if there is a vcan0, else udp_multicast on this machine",
        needs_restart=True,
    )
    channel: str | None = key(
        None,
        "Channel, e.g. can0.",
        "C",
        default_text="vcan0, or 239.74.163.2",
        needs_restart=True,
    )
    bus_options: dict[str, StrictBool | int | float | str] = key(
        {},
        "Further argument of the bus driver, e.g. bitrate=500000.",
        "K=V",
        "--bus-option",
        needs_restart=True,
    )
    wait_for_bus: StrictBool = key(
        False,
        "Start even if the bus is not available yet. A bus lost later is always reconnected.",
        "",
        "--wait-for-bus/--need-bus",
        needs_restart=True,
    )
    vehicle: str | None = key(
        None,
        f"Vehicle preset: {', '.join(PRESETS)}.",
        "PRESET",
        default_text=f"{DEFAULT_VEHICLE}, without --dbc and --map",
    )
    dbc: str | None = key(None, "DBC file of another vehicle; needs --map.", "FILE", is_path=True)
    map: str | None = key(
        None,
        "TOML file: which signals are current, voltage and temperature, with sign and scale.",
        "FILE",
        is_path=True,
    )
    temperature: FiniteFloat | None = key(
        None, "Constant temperature, instead of the bus's.", "C", unit="°C", ge=-60.0, le=120.0
    )
    temperature_source: TemperatureSource | None = key(
        None,
        "Location of the temperature sensor, if the vehicle does not define it:"
        f" {', '.join(TEMPERATURE_SOURCES)}.",
        "SOURCE",
    )
    method: Method = key(
        "ekf",
        "Published SoC: fusion (ekf), the inverse of the voltage model (newton), or Coulomb"
        " counting (coulomb).",
        "ekf|newton|coulomb",
    )
    initial_soc: Annotated[FiniteFloat | None, BeforeValidator(_none_for_auto)] = key(
        None,
        "SoC at the first sample, or auto: by the first voltages.",
        "P|auto",
        unit="%",
        default_text="auto",
        ge=0.0,
        le=100.0,
    )
    initial_soc_std: FiniteFloat = key(
        1.0, "Standard deviation of the initial SoC.", "X", unit="%", ge=0.0, le=100.0
    )
    valid_std: FiniteFloat = key(
        VALID_STD_PCT,
        "Standard deviation above which the SoC is published as degraded.",
        "X",
        unit="%",
        ge=0.01,
        le=100.0,
    )
    capacity_ah: FiniteFloat | None = key(
        None, "Capacity.", "A", unit="Ah", default_text="the model's", ge=1e-3, le=1e5
    )
    max_gap_s: FiniteFloat = key(
        GAP_S, "Longest step between samples that is not a gap.", "S", unit="s", ge=1e-3, le=3600.0
    )
    pair_within_s: FiniteFloat | None = key(
        None,
        "Largest time between current and voltage of one sample.",
        "S",
        unit="s",
        default_text="0.02",
        ge=0.0,
        le=1.0,
    )
    time_source: TimeSourceName = key(
        "receive",
        "Bus time: the receive stamps of the frames, or the log time that `cangauge replay` sends"
        " at speeds other than 1.",
        "receive|replay-clock",
        needs_restart=True,
    )
    timeout_s: FiniteFloat = key(
        2.0, "Time without a sample after which the input is stale.", "S", unit="s", gt=0.0, le=1e9
    )
    ids: IdsConfig = key(IdsConfig(), "Ids of the published frames.")
    messages: dict[str, MessageMap] = key(
        {}, "Protection and period of messages, by name or id; before those of the vehicle."
    )
    rules: dict[str, RuleMap] = key({}, "Further protection rules.")
    checks: ChecksConfig = key(
        ChecksConfig(), "Plausibility checks by signal; before those of the vehicle."
    )
    record: str | None = key(
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
    record_part_mb: FiniteFloat | None = key(
        None,
        "Size of a part of the recording: NAME-RUN-PART. NAME-RUN denotes all its parts.",
        "MB",
        unit="MB",
        needs_restart=True,
        gt=0.0,
        le=1e9,
    )
    record_part_s: FiniteFloat | None = key(
        None,
        "Duration of a part of the recording.",
        "S",
        unit="s",
        needs_restart=True,
        ge=1.0,
        le=1e9,
    )
    record_keep_mb: FiniteFloat | None = key(
        None,
        "Total size of the recording; the oldest files are removed.",
        "MB",
        unit="MB",
        needs_restart=True,
        gt=0.0,
        le=1e9,
    )
    output: str | None = key(
        None,
        "Table of the estimates, .csv or .parquet.",
        "FILE",
        "-o",
        "--output",
        needs_restart=True,
        is_path=True,
    )
    duration_s: FiniteFloat | None = key(
        None, "Stop after this time.", "S", "--duration", unit="s", gt=0.0, le=1e9
    )
    until_idle_s: FiniteFloat | None = key(
        None,
        "Stop when no sample came for this time, after the first.",
        "S",
        "--until-idle",
        unit="s",
        gt=0.0,
        le=1e9,
    )
    state: str | None = key(
        None,
        "Keep SoC, its uncertainty and the delay line over restarts in this file, or in a file in"
        " this folder.",
        "FILE",
        default_text="systemd's StateDirectory, if there is one",
        needs_restart=True,
        is_path=True,
    )
    state_max_age_s: FiniteFloat = key(
        7.0 * 86400.0,
        "Age above which the state is refused.",
        "S",
        "--state-max-age",
        unit="s",
        needs_restart=True,
        gt=0.0,
        le=1e9,
    )
    state_every_s: FiniteFloat = key(
        CHECKPOINT_EVERY_S,
        "Interval between writes of the state.",
        "S",
        "--state-every",
        unit="s",
        ge=0.1,
        le=86400.0,
    )
    full_charge: FullChargeConfig | None = key(None, "Set the SoC when the pack is full.")
    long_rest: LongRestConfig | None = key(None, "Correct the SoC by the voltage of long rests.")
    limits: LimitsConfig = key(LimitsConfig(), "Limits of the possible currents.")
    poll: PollConfig | None = key(
        None, "Ask the battery controller for its replies over ISO-TP: the service then sends."
    )
    http: str | None = key(
        None,
        "Serve /status, /healthz and /metrics (extra `metrics`) there, e.g. 127.0.0.1:9464. An"
        " address beyond loopback needs a token.",
        "HOST:PORT",
        needs_restart=True,
    )
    http_token_file: str | None = key(
        None,
        "File with the bearer token that requests need; or in CANGAUGE_HTTP_TOKEN.",
        "FILE",
        needs_restart=True,
        is_path=True,
    )
    mqtt: MqttConfig | None = key(None, "MQTT broker that takes the state (extra `mqtt`).")
    dashboard: str | None = key(
        None,
        "Serve the live page there; on the command line alone: at 127.0.0.1:8642. An address beyond"
        " loopback needs a token, as with --http. The page can begin and end a recording: that of"
        " `record`, else candump files in the working folder.",
        "HOST:PORT",
        needs_restart=True,
        bare="127.0.0.1:8642",
    )
    status_socket: str = key(
        "auto",
        "Unix socket for `cangauge status`; auto: in the user's runtime folder.",
        "PATH|auto|off",
        needs_restart=True,
    )
    log_format: LogFormat = key(
        "text", "Format of the events on stderr, one a line.", "text|json", needs_restart=True
    )
    log_level: LogLevel = key(
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
        from cangauge.extras.live.mqtt import MqttSettings  # noqa: PLC0415

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
        elif isinstance(value, Mapping) and (inner := own_model(field)) is not None:
            found[name] = _in_folder(inner, value, folder)
    return found


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
    for name in ("ids", "bus_options"):
        if name in data and name in given:
            given[name] = {**data[name], **given[name]}
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


def config_keys() -> list[ConfigKey]:
    """Return all keys of the configuration with option, type, default, unit, bounds and help."""
    return list(keys_of(RunConfig))


def reference() -> str:
    """Return the reference of all keys as a Markdown table."""
    head = ("Key", "Option", "Type", "Default", "Unit", "Bounds", "Meaning")
    rows: list[tuple[str, ...]] = [head, tuple("---" for _ in head)]
    for item in config_keys():
        option = ", ".join(f"`{each}`" for each in item.option.split(", ") if each)
        cells = (
            f"`{item.name}`", option, item.kind, item.default, item.unit, item.bounds, item.text,
        )  # fmt: skip
        rows.append(tuple(each.replace("|", "\\|") for each in cells))
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


if __name__ == "__main__":
    sys.stdout.write(reference())
