"""Where HTTP is served, and who may ask: loopback, or a bearer token.

The token comes from a file or the environment, never from the command line, which other users of
the machine can read.

How a service is watched and what it records: the part of its configuration for operators.

Keys of the file, and options of `cangauge run` by the same names::

    record = "record/drive.log"     # .log, .csv, .blf, .mf4
    record_part_mb = 64             # a new file after so much …
    record_part_s = 3600            # … or after so long
    record_keep_mb = 2000           # the oldest files are removed beyond this

    status_socket = "auto"          # a path, or "off"
    http = "127.0.0.1:9464"         # /status, /healthz, /metrics
    http_token_file = "http-token"  # required where http is not loopback
    log_format = "json"             # or "text"
    log_level = "info"

What `cangauge run` can be told: a TOML file, and options of the command line that go before it.

Keys are the options' names, with underscores::

    model = "leaf.json"             # paths are relative to this file
    interface = "socketcan"
    channel = "can0"
    vehicle = "leaf_aze0"           # or: dbc = "car.dbc" and map = "car.toml"
    method = "ekf"                  # ekf, newton, coulomb
    initial_soc = "auto"            # or a number [%]
    valid_std = 1.5                 # a SoC less certain than this [%] is degraded
    time_source = "receive"         # or "replay-clock"
    wait_for_bus = true             # start even if it is not there yet

    [bus_options]
    bitrate = 500000

    [ids]
    soc_estimate = 0x5A0

    [messages.BATTERY_1DB]          # protection and period: as in a map file, and before it
    protection = "leaf"

    [checks.voltage]                # likewise: range, rate, how many failures, time-out
    lowest = 240
    highest = 410

    [full_charge]                   # optional: what the SoC is at some moments
    voltage_v = 402.0               # at least this …
    current_a = 3.0                 # … at no more than this, either way
    hold_s = 60

    [long_rest]
    after_s = 7200
    soc_std_pct = 2.0

How the service is watched and what it records: see `ops_config`.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final, Self

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
from cangauge._logging import LogFormat, LogLevel
from cangauge.bus.mapping import CheckMap, MessageMap, RuleMap
from cangauge.bus.open import BusAddress, bus_address, is_interface_name
from cangauge.bus.publish import FrameIds
from cangauge.bus.time_source import TimeSourceName
from cangauge.bus.vehicle import Overrides, Vehicle, load_vehicle
from cangauge.errors import InputError
from cangauge.estimate.settings import (
    VALID_STD_PCT,
    EstimatorSettings,
    FullCharge,
    LongRest,
    Method,
)
from cangauge.logs.log import TemperatureSource
from cangauge.model.delay_line import GAP_S
from cangauge.service.loop import CHECKPOINT_EVERY_S, LoopSettings
from cangauge.service.pipeline import PipelineSettings
from cangauge.service.recording import RecordLimits
from cangauge.service.state import StateSettings, state_path

# --- Where HTTP is served, and who may ask: loopback, or a bearer token

TOKEN_VARIABLE: Final = "CANGAUGE_HTTP_TOKEN"  # noqa: S105 - the variable's name, no secret
LOOPBACK: Final = "127.0.0.1"
SHORTEST_TOKEN: Final = 16
LONGEST_TOKEN: Final = 1024


@dataclass(frozen=True, slots=True)
class HttpAddress:
    """Where to listen.

    Parameters
    ----------
    host : str
        IP address, or "localhost".
    port : int
        0: any free one.
    token : str or None
        What a request must bear.
    """

    host: str
    port: int
    token: str | None = field(default=None, repr=False)

    def __str__(self) -> str:
        """Return it as it is written in a URL."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def http_address(
    text: str,
    token_file: str | PathLike[str] | None = None,
    environment: Mapping[str, str] | None = None,
) -> HttpAddress:
    """Return where to listen and the token, if the two go together.

    Parameters
    ----------
    text : str
        "9464" (on loopback), "127.0.0.1:9464", "0.0.0.0:9464", "[::1]:9464".
    token_file : path-like, optional
        By default the environment variable `TOKEN_VARIABLE`, if there is one.
    environment : mapping, optional

    Raises
    ------
    InputError
        If it is no address, the token cannot be read or is too short, or the address is not
        loopback and there is no token.
    """
    host, port = _host_and_port(text)
    token = read_token(token_file, os.environ if environment is None else environment)
    if token is None and not is_loopback_name(host):
        raise InputError(
            "this address is open to the network, and there is no token",
            field="http",
            value=text,
            cure=f"put a token into a file for --http-token-file or into {TOKEN_VARIABLE},"
            f" or listen on {LOOPBACK}:{port}",
        )
    return HttpAddress(host, port, token)


def is_loopback_name(host: str) -> bool:
    """Return whether a host is this machine's loopback: "localhost", 127.…, ::1."""
    host = host.removeprefix("[").removesuffix("]").lower()
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _host_and_port(text: str) -> tuple[str, int]:
    host, colon, port = text.strip().rpartition(":")
    if not colon:
        host = LOOPBACK
    host = host.removeprefix("[").removesuffix("]")
    try:
        if host.lower() != "localhost":
            ipaddress.ip_address(host)
        number = int(port)
    except ValueError:
        number = -1
    if not 0 <= number <= 65535:
        raise InputError(
            "no address of HOST:PORT, the host an IP address or localhost",
            field="http",
            value=text,
            cure=f"write it as {LOOPBACK}:9464",
        )
    return host, number


def read_token(path: str | PathLike[str] | None, environment: Mapping[str, str]) -> str | None:
    """Return the token in a file, or in the environment; None if there is neither.

    Raises
    ------
    InputError
        If it cannot be read, or is too short or no printable text.
    """
    if path is None:
        given = environment.get(TOKEN_VARIABLE)
        return None if given is None else _checked(given, TOKEN_VARIABLE)
    try:
        with Path(path).open("rb") as file:
            content = file.read(LONGEST_TOKEN + 2).decode("utf-8")
    except FileNotFoundError as error:
        raise InputError(
            "no such file", source=path, field="http_token_file", cure="check the path"
        ) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise InputError(
            f"cannot be read: {reason}", source=path, field="http_token_file"
        ) from error
    return _checked(content, str(path))


def _checked(content: str, source: str) -> str:
    token = content.strip()
    if not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN or not token.isascii() or " " in token:
        # The value is a secret, if a bad one: it is not repeated.
        raise InputError(
            f"a token is {SHORTEST_TOKEN} to {LONGEST_TOKEN} printable characters without spaces",
            source=source,
            field="http_token",
            cure="make one: python -c 'import secrets; print(secrets.token_urlsafe())'",
        )
    return token


# --- How a service is watched and what it records: the part of its configuration for operators

OPS_PATHS: Final = ("record", "http_token_file")
"""Keys that are paths, relative to the file that they stand in."""

Megabytes = Annotated[FiniteFloat, Field(gt=0.0, le=1e9)]
PartSeconds = Annotated[FiniteFloat, Field(ge=1.0, le=1e9)]


class OpsConfig(BaseModel):
    """The keys for operators.

    Parameters
    ----------
    record : str, optional
        File to record the frames into.
    record_part_mb, record_part_s : float, optional
        A new file is begun after so many megabytes, or seconds.
    record_keep_mb : float, optional
        The oldest files of the recording are removed beyond so many megabytes.
    http : str, optional
        Where to serve HTTP.
    http_token_file : str, optional
        File with the token that requests must bear.
    status_socket : str
        Path of the unix socket for `cangauge status`; "auto", "off".
    log_format : {"text", "json"}
    log_level : {"debug", "info", "warning", "error"}
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    record: str | None = None
    record_part_mb: Megabytes | None = None
    record_part_s: PartSeconds | None = None
    record_keep_mb: Megabytes | None = None
    http: str | None = None
    http_token_file: str | None = None
    status_socket: str = "auto"
    log_format: LogFormat = "text"
    log_level: LogLevel = "info"

    def http_address(self) -> HttpAddress | None:
        """Return where HTTP is served, None if it is not; may raise InputError."""
        return None if self.http is None else http_address(self.http, self.http_token_file)

    def unix_path(self) -> Path | None:
        """Return the path of the unix socket where one is named."""
        return None if self.status_socket in {"auto", "off"} else Path(self.status_socket)

    def record_limits(self) -> RecordLimits:
        """Return when the recording begins a new file, and what it keeps; may raise InputError."""
        return RecordLimits(
            part_bytes=_bytes(self.record_part_mb),
            part_s=self.record_part_s,
            keep_bytes=_bytes(self.record_keep_mb),
        )


def _bytes(megabytes: float | None) -> int | None:
    return None if megabytes is None else int(megabytes * 1e6)


# --- What `cangauge run` can be told: a TOML file, and options of the command line that go b…

DEFAULT_VEHICLE: Final = "generic"
"""What `replay` sends by default, so that both commands find each other without options."""

_PATHS: Final = ("model", "dbc", "map", "output", "state", *OPS_PATHS)

Percent = Annotated[FiniteFloat, Field(ge=0.0, le=100.0)]
Seconds = Annotated[FiniteFloat, Field(gt=0.0, le=1e9)]
StandardId = Annotated[int, Field(ge=0, le=0x7FF)]


def _none_for_auto(value: object) -> object:
    if value == "auto":
        return None
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            raise ValueError("neither a number nor auto") from None
    return value


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class IdsConfig(_Strict):
    """Standard ids of the published frames and of the clock."""

    soc_estimate: StandardId = 0x5A0
    soc_detail: StandardId = 0x5A1
    replay_clock: StandardId = 0x5AF


class ChecksConfig(_Strict):
    """When values are believed, by signal; see `CheckMap`."""

    current: CheckMap = CheckMap()
    voltage: CheckMap = CheckMap()
    temperature: CheckMap = CheckMap()
    soc_reference: CheckMap = CheckMap()


class FullChargeConfig(_Strict):
    """When the pack is full; see `FullCharge`."""

    voltage_v: Annotated[FiniteFloat, Field(gt=0.0, le=1e4)]
    current_a: Annotated[FiniteFloat, Field(ge=0.0, le=5e3)]
    hold_s: Annotated[FiniteFloat, Field(ge=0.0, le=86400.0)] = 60.0
    soc_pct: Percent = 100.0
    soc_std_pct: Annotated[FiniteFloat, Field(ge=0.01, le=100.0)] = 0.5


class LongRestConfig(_Strict):
    """When the voltage is the open-circuit voltage; see `LongRest`."""

    after_s: Annotated[FiniteFloat, Field(ge=60.0, le=30.0 * 86400.0)] = 7200.0
    soc_std_pct: Annotated[FiniteFloat, Field(ge=0.01, le=100.0)] = 2.0


class RunConfig(OpsConfig):
    """All that `cangauge run` can be told; defaults are those of the command line.

    The keys for operators are those of `OpsConfig`.

    Parameters
    ----------
    model : str
        Model file.
    interface, channel : str, optional
        By default SocketCAN's vcan0 where there is one, else `udp_multicast`.
    bus_options : mapping
        Further arguments of the bus's driver.
    wait_for_bus : bool
        Start even if the bus is not there yet.
    vehicle, dbc, map : str, optional
        Preset, or DBC and map file; by default what `replay` sends.
    temperature : float, optional
        Constant temperature instead of the bus's [°C].
    temperature_source : str, optional
        What the temperature is measured on, where the vehicle does not say it.
    method : {"ekf", "newton", "coulomb"}
    initial_soc : float or None
        [%]; None, "auto" in the file: from the first voltages.
    initial_soc_std : float
        Its standard deviation [%].
    valid_std : float
        A SoC with a larger standard deviation is published as degraded [%].
    capacity_ah : float, optional
        Instead of the model's [Ah].
    max_gap_s : float
        A longer step between samples is a gap [s].
    pair_within_s : float, optional
        Current and voltage at most this far apart belong together [s].
    time_source : {"receive", "replay-clock"}
    timeout_s : float
        Without a sample for so long the estimate is published as stale [s].
    ids : IdsConfig
    messages : dict of str to MessageMap
        Protection and period of messages, by name or id, before those of the vehicle.
    rules : dict of str to RuleMap
        Protection rules of one's own.
    checks : ChecksConfig
        When values are believed, before what the vehicle's mapping states.
    output : str, optional
        File to write the estimates to.
    duration_s, until_idle_s : float, optional
        When to end by itself [s].
    state : str, optional
        File, or folder of one, that the state is kept in over restarts.
    state_max_age_s, state_every_s : float
        An older state is refused; how often it is written [s].
    full_charge, long_rest : optional
        Rules that say what the SoC is at some moments.
    """

    model: str
    interface: str | None = None
    channel: str | None = None
    bus_options: dict[str, StrictBool | int | float | str] = Field(default_factory=dict)
    wait_for_bus: StrictBool = False
    vehicle: str | None = None
    dbc: str | None = None
    map: str | None = None
    temperature: Annotated[FiniteFloat, Field(ge=-60.0, le=120.0)] | None = None
    temperature_source: TemperatureSource | None = None
    method: Method = "ekf"
    initial_soc: Annotated[Percent | None, BeforeValidator(_none_for_auto)] = None
    initial_soc_std: Percent = 1.0
    valid_std: Annotated[FiniteFloat, Field(ge=0.01, le=100.0)] = VALID_STD_PCT
    capacity_ah: Annotated[FiniteFloat, Field(ge=1e-3, le=1e5)] | None = None
    max_gap_s: Annotated[FiniteFloat, Field(ge=1e-3, le=3600.0)] = GAP_S
    pair_within_s: Annotated[FiniteFloat, Field(ge=0.0, le=1.0)] | None = None
    time_source: TimeSourceName = "receive"
    timeout_s: Seconds = 2.0
    ids: IdsConfig = IdsConfig()
    messages: dict[str, MessageMap] = Field(default_factory=dict)
    rules: dict[str, RuleMap] = Field(default_factory=dict)
    checks: ChecksConfig = ChecksConfig()
    output: str | None = None
    duration_s: Seconds | None = None
    until_idle_s: Seconds | None = None
    state: str | None = None
    state_max_age_s: Seconds = 7.0 * 86400.0
    state_every_s: Annotated[FiniteFloat, Field(ge=0.1, le=86400.0)] = CHECKPOINT_EVERY_S
    full_charge: FullChargeConfig | None = None
    long_rest: LongRestConfig | None = None
    _file: str = PrivateAttr("the configuration")

    def named(self, file: str | PathLike[str]) -> Self:
        """Note which file it came from, for messages; return itself."""
        self._file = str(file)
        return self

    def address(self) -> BusAddress:
        """Return which bus; may raise InputError."""
        interface = self.interface
        if interface is None and self.wait_for_bus and is_interface_name(self.channel):
            interface = "socketcan"  # which cannot be seen from what is there now
        return bus_address(interface, self.channel, self.bus_options)

    def load_vehicle(self) -> Vehicle:
        """Return the vehicle; may raise InputError."""
        preset = self.vehicle
        if preset is None and self.dbc is None and self.map is None:
            preset = DEFAULT_VEHICLE
        return load_vehicle(
            preset,
            self.dbc,
            self.map,
            temperature_c=self.temperature,
            pair_within_s=self.pair_within_s,
            overrides=Overrides(self._file, self.messages, self.rules, dict(self.checks)),
        )

    def gauge_settings(self) -> PipelineSettings:
        """Return what the gauge needs; may raise InputError."""
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
            ),
            time_source=self.time_source,
            ids=FrameIds(**self.ids.model_dump()),
        )

    def state_settings(self, environment: Mapping[str, str]) -> StateSettings | None:
        """Return where the state is kept, if anywhere; may raise InputError."""
        path = state_path(self.state, environment)
        if path is None:
            return None
        for other in (self.model, self.record, self.output, self.dbc, self.map):
            if other is not None and os.path.realpath(other) == os.path.realpath(path):
                raise InputError("is another file of this service", field="--state", value=other)
        return StateSettings(path, self.state_max_age_s, self.state_every_s)

    def loop_settings(self) -> LoopSettings:
        """Return when the service calls its input stale, and when it ends."""
        return LoopSettings(
            timeout_s=self.timeout_s,
            duration_s=self.duration_s,
            until_idle_s=self.until_idle_s,
            checkpoint_every_s=self.state_every_s,
        )


def load_config(
    path: str | PathLike[str] | None, overrides: Mapping[str, Any] | None = None
) -> RunConfig:
    """Read a configuration; options of the command line go before the file.

    Parameters
    ----------
    path : path-like, optional
        TOML file.
    overrides : mapping, optional
        By the file's keys; None stands for an option that was not given. Given ids and bus
        options join those of the file.

    Raises
    ------
    InputError
        Names the file (or the command line), the key and the value that are wrong.
    """
    given = {key: value for key, value in (overrides or {}).items() if value not in (None, {})}
    # Checked on their own first, so that an error names where the value came from.
    _check_options(given)
    if path is None:
        if "model" not in given:
            raise InputError(
                "is missing", field="-m/--model", cure="give -m MODEL (made by `cangauge fit`)"
            )
        return RunConfig.model_validate(given)
    data = read_toml(path)
    validated(RunConfig, _with_model(data), path)
    folder = Path(path).parent
    data |= {key: str(folder / data[key]) for key in _PATHS if isinstance(data.get(key), str)}
    if given.keys() & {"vehicle", "dbc", "map"}:
        # A car named on the command line is not mixed with the file's.
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
        key = (error.field or "").split(".")
        option = "-".join([*key[1:], "id"]) if key[0] == "ids" else key[0]
        raise InputError(
            error.problem,
            field=f"--{option.replace('_', '-')}",
            value=error.value,
            cure=error.cure,
        ) from error


def _with_model(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return data with a model, so that only what is given is judged."""
    return {"model": "-", **data}
