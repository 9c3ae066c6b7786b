"""A configuration with its model and vehicle, read at the start and at reloads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Final, Self

from cangauge.bus.open import BusAddress, bus_address, is_multicast
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import CangaugeError, InputError
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model
from cangauge.service.config import DEFAULT_VEHICLE, PublishConfig, RunConfig
from cangauge.service.output import Output
from cangauge.service.pipeline import PipelineSettings

if TYPE_CHECKING:
    from cangauge.service.run import Service

OUTPUTS: Final = {
    "cangauge.extras.live.launch": ("http", "dashboard", "mqtt"),
    "cangauge.extras.inverter.gateway": ("publish",),
    "cangauge.extras.judge.live": ("judge",),
}
"""Modules with an output, and the keys that ask for it; imported only then. In each,
`output_of(config, vehicle)` reads what the output needs (addresses, secrets) and returns what makes
it for a service, or raises InputError."""


@dataclass(frozen=True)
class Setup:
    """A configuration with the files that it names.

    `sign_cure` is what to change if the current has the wrong sign; `outputs` make what a service
    that runs serves, sends or stores.
    """

    config: RunConfig
    vehicle: Vehicle
    model: Model
    settings: PipelineSettings
    sign_cure: str
    outputs: tuple[Callable[[Service], Output], ...]

    @classmethod
    def of(cls, config: RunConfig) -> Self:
        """Read all that a configuration names, without opening a bus; may raise InputError."""
        with config.naming_keys():
            vehicle = load_vehicle(config)
            model = Model.load(config.model)
            _check_poll(config, vehicle)
            _check_publish(config)
            outputs = tuple(
                import_module(module).output_of(config, vehicle)
                for module, keys in OUTPUTS.items()
                if any(getattr(config, key) is not None for key in keys)
            )
            return cls(
                config,
                vehicle,
                model,
                pipeline_settings(config),
                _sign_cure(config, vehicle),
                outputs,
            )


def read_setup(read: Callable[[], RunConfig]) -> Setup | CangaugeError:
    """Return a configuration with its files, or why it is refused; may take seconds."""
    try:
        return Setup.of(read())
    except CangaugeError as error:
        return error
    except Exception as error:  # noqa: BLE001 - of a library that reads a file
        return InputError(f"cannot be read: {error!r}", cure="check the files")


def load_vehicle(config: RunConfig) -> Vehicle:
    """Return the vehicle of a configuration; may raise InputError."""
    preset = config.vehicle
    if preset is None and config.dbc is None and config.map is None:
        preset = DEFAULT_VEHICLE
    return Vehicle.load(
        preset,
        config.dbc,
        config.map,
        temperature_c=config.temperature,
        pair_within_s=config.pair_within_s,
    )


def pipeline_settings(config: RunConfig) -> PipelineSettings:
    """Return the settings of the estimator and its frames; may raise InputError."""
    return PipelineSettings(
        estimator=EstimatorSettings(
            method=config.method,
            initial_soc_pct=config.initial_soc,
            initial_soc_std_pct=config.initial_soc_std,
            valid_std_pct=config.valid_std,
            capacity_ah=config.capacity_ah,
            gap_s=config.max_gap_s,
            temperature_source=config.temperature_source or "unknown",
            full_charge=config.full_charge,
            long_rest=config.long_rest,
            limits=config.limits,
        ),
        time_source=config.time_source,
        ids=config.ids,
    )


def address_of(config: RunConfig) -> BusAddress:
    """Return the bus address of a configuration; may raise InputError."""
    interface = config.interface
    channel = config.channel
    if interface is None and config.wait_for_bus and channel and not is_multicast(channel):
        interface = "socketcan"  # cannot be detected while the interface is missing
    return bus_address(interface, channel, config.bus_options)


def inverter_address(publish: PublishConfig) -> BusAddress:
    """Return the address of the inverter's bus; may raise InputError."""
    return bus_address(publish.interface, publish.channel, publish.bus_options)


def _check_publish(config: RunConfig) -> None:
    """Raise InputError if an inverter cannot be told the SoC."""
    publish = config.publish
    if publish is None:
        return
    if config.time_source == "replay-clock":
        raise InputError(
            "the SoC of a replay is not the battery's",
            source=config.file,
            field="time_source",
            value=config.time_source,
            cure="remove it, or [publish]",
        )
    battery = address_of(config)
    inverter = inverter_address(publish)
    if str(battery) == str(inverter):
        problem = "is the battery's bus: a frame cannot be replaced on the bus that carries it"
        cure = "connect the inverter to a bus of its own"
    elif battery.echoes or inverter.echoes:
        problem = "a bus returns the frames sent on it: they would go round for ever"
        cure = "use SocketCAN on both buses, and remove receive_own_messages"
    else:
        return
    raise InputError(
        problem, source=config.file, field="publish.channel", value=publish.channel, cure=cure
    )


def _check_poll(config: RunConfig, vehicle: Vehicle) -> None:
    """Raise InputError if `[poll]` is given where nothing can be asked for."""
    if config.poll is None:
        return
    if not vehicle.poll_targets:
        problem = f"no reply of the vehicle {vehicle.name} can be asked for"
        cure = (
            "use the preset leaf_ze1_polled for a Leaf of 40 or 62 kWh, or state isotp = true"
            " and request_id for a message of the map file; or remove [poll]"
        )
    elif config.time_source == "replay-clock":
        problem = "a replay has no battery that answers"
        cure = "remove [poll], or time_source"
    elif config.bus_options.get("listen_only"):
        problem = "a bus that only listens sends no requests"
        cure = "remove listen_only from [bus_options], or [poll]"
    else:
        return
    raise InputError(problem, source=config.file, field="poll", cure=cure)


def _sign_cure(config: RunConfig, vehicle: Vehicle) -> str:
    if config.map is None:
        return "use the preset of this car, or a map file (`cangauge init` writes one)"
    sign = 1 if vehicle.current.codec.gain < 0.0 else -1
    return f"set sign = {sign} under [current] of {config.map}"
