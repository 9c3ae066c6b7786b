"""Options of the commands on a bus, made from the keys of `RunConfig`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand

from cangauge.cli.options import with_signature
from cangauge.errors import InputError
from cangauge.service.config import ConfigKey, config_keys

_KEYS: Final = {key.name: key for key in config_keys()}
_OPTIONS: Final = {name: key for name, key in _KEYS.items() if key.info.option}
_BARE: Final = {key.info.option: key.info.bare for key in _KEYS.values() if key.info.bare}
_TYPES: Final[Mapping[str, type]] = {"number": float, "true or false": bool}


class ConfigCommand(TyperCommand):
    """A command some of whose options may stand without a value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, with the usual values where none are given."""
        return super().parse_args(ctx, list(_with_values(args)))


def _with_values(arguments: Sequence[str]) -> Iterator[str]:
    for word, following in zip_longest(arguments, arguments[1:], fillvalue="-"):
        yield word
        if word in _BARE and following.startswith("-"):
            yield _BARE[word]


def _option(name: str, *flags: str) -> Any:
    """Return the option of a key, such as "ids.soc_detail"; by default with its own flags."""
    key = _KEYS[name]
    names = flags or key.info.option.split(", ")
    return typer.Option(*names, metavar=key.info.metavar or None, help=key.help)


def _type(key: ConfigKey) -> Any:
    if key.name == "bus_options":
        return list[str]
    if key.info.is_path:
        return Path
    # Checked by the configuration, for the same message as in a file; "auto" is no number.
    return str if key.name == "initial_soc" else _TYPES.get(key.kind, str)


def config_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the `**options` of a command by the options that the configuration declares."""
    named = inspect.Parameter.KEYWORD_ONLY
    given = inspect.signature(command, eval_str=True).parameters.values()
    own = [each.replace(kind=named) for each in given if each.kind is not each.VAR_KEYWORD]
    made = [
        inspect.Parameter(
            name, named, default=None, annotation=Annotated[_type(key) | None, _option(name)]
        )
        for name, key in _OPTIONS.items()
    ]

    def with_options(**values: Any) -> None:
        command(**values)

    with_options.command_class = ConfigCommand  # type: ignore[attr-defined] # read by the app
    return with_signature(with_options, command, own + made)


def config_values(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return given options as the keys of a configuration; InputError if a bus option is wrong."""
    from cangauge.bus.open import parse_bus_options

    values = {name: options[name] for name in _OPTIONS}
    values["bus_options"] = parse_bus_options(values["bus_options"] or [])
    return {name: str(v) if isinstance(v, Path) else v for name, v in values.items()}


def frame_ids(**given: str | None) -> dict[str, int]:
    """Return the given ids by key, "0x…" hexadecimal; InputError if one is not a number."""
    ids: dict[str, int] = {}
    for key, text in given.items():
        try:
            ids |= {} if text is None else {key: int(text, 0)}
        except ValueError as error:
            option = f"--{key.replace('_', '-')}-id"
            raise InputError(
                "not a CAN id", field=option, value=text, cure="write it as 0x5A0"
            ) from error
    return ids


InterfaceOption = Annotated[str | None, _option("interface")]
ChannelOption = Annotated[str | None, _option("channel")]
BusOptionOption = Annotated[list[str] | None, _option("bus_options")]
BusVehicleOption = Annotated[str | None, _option("vehicle")]
BusDbcOption = Annotated[Path | None, _option("dbc")]
BusMapOption = Annotated[Path | None, _option("map")]
BusTemperatureOption = Annotated[float | None, _option("temperature")]
EstimateIdOption = Annotated[str | None, _option("ids.soc_estimate", "--soc-estimate-id")]
DetailIdOption = Annotated[str | None, _option("ids.soc_detail", "--soc-detail-id")]
ClockIdOption = Annotated[str | None, _option("ids.replay_clock", "--replay-clock-id")]
