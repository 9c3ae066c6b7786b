"""What `cangauge run` can be told: a TOML file, and options of the command line that go before it.

Keys are the options' names, with underscores::

    model = "leaf.json"             # paths are relative to this file
    interface = "socketcan"
    channel = "can0"
    vehicle = "leaf_aze0"           # or: dbc = "car.dbc" and map = "car.toml"
    method = "ekf"                  # ekf, newton, coulomb
    initial_soc = "auto"            # or a number [%]
    time_source = "receive"         # or "replay-clock"

    [bus_options]
    bitrate = 500000

    [ids]
    soc_estimate = 0x5A0

How the service is watched and what it records: see `ops_config`.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, StrictBool

from cangauge.bus.open import BusAddress, bus_address
from cangauge.bus.publish import FrameIds
from cangauge.bus.time_source import TimeSourceName
from cangauge.bus.validation import read_toml, validated
from cangauge.bus.vehicle import Vehicle, load_vehicle
from cangauge.errors import InputError
from cangauge.estimate.estimator import EstimatorSettings, Method
from cangauge.logs.log import TemperatureSource
from cangauge.model.delay_line import GAP_S
from cangauge.service.gauge import GaugeSettings
from cangauge.service.loop import LoopSettings
from cangauge.service.ops_config import OPS_PATHS, OpsConfig

DEFAULT_VEHICLE: Final = "generic"
"""What `replay` sends by default, so that both commands find each other without options."""

_PATHS: Final = ("model", "dbc", "map", "output", *OPS_PATHS)

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
    output : str, optional
        File to write the estimates to.
    duration_s, until_idle_s : float, optional
        When to end by itself [s].
    """

    model: str
    interface: str | None = None
    channel: str | None = None
    bus_options: dict[str, StrictBool | int | float | str] = Field(default_factory=dict)
    vehicle: str | None = None
    dbc: str | None = None
    map: str | None = None
    temperature: Annotated[FiniteFloat, Field(ge=-60.0, le=120.0)] | None = None
    temperature_source: TemperatureSource | None = None
    method: Method = "ekf"
    initial_soc: Annotated[Percent | None, BeforeValidator(_none_for_auto)] = None
    initial_soc_std: Percent = 1.0
    capacity_ah: Annotated[FiniteFloat, Field(ge=1e-3, le=1e5)] | None = None
    max_gap_s: Annotated[FiniteFloat, Field(ge=1e-3, le=3600.0)] = GAP_S
    pair_within_s: Annotated[FiniteFloat, Field(ge=0.0, le=1.0)] | None = None
    time_source: TimeSourceName = "receive"
    timeout_s: Seconds = 2.0
    ids: IdsConfig = IdsConfig()
    output: str | None = None
    duration_s: Seconds | None = None
    until_idle_s: Seconds | None = None

    def address(self) -> BusAddress:
        """Return which bus; may raise InputError."""
        return bus_address(self.interface, self.channel, self.bus_options)

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
        )

    def gauge_settings(self) -> GaugeSettings:
        """Return what the gauge needs; may raise InputError."""
        return GaugeSettings(
            estimator=EstimatorSettings(
                method=self.method,
                initial_soc_pct=self.initial_soc,
                initial_soc_std_pct=self.initial_soc_std,
                capacity_ah=self.capacity_ah,
                gap_s=self.max_gap_s,
                temperature_source=self.temperature_source or "unknown",
            ),
            time_source=self.time_source,
            ids=FrameIds(**self.ids.model_dump()),
        )

    def loop_settings(self) -> LoopSettings:
        """Return when the service calls its input stale, and when it ends."""
        return LoopSettings(
            timeout_s=self.timeout_s,
            duration_s=self.duration_s,
            until_idle_s=self.until_idle_s,
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
    return validated(RunConfig, merged, path)


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
