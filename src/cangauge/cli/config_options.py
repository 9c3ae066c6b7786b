"""Options of the commands on a bus, made from the keys of `RunConfig`.

The keys are read from a table beside this file, so that a help page needs neither pydantic nor the
bus: `python -m cangauge.cli.config_options > src/cangauge/cli/config_options.json` writes it.
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import typer
from typer.core import TyperCommand

from cangauge.errors import InputError


class OptionKey(NamedTuple):
    """What the command line needs of a key of the configuration (`ConfigKey`)."""

    name: str
    option: str
    kind: str
    help: str
    metavar: str
    is_path: bool
    bare: str


_FILE: Final = Path(__file__).with_suffix(".json")


def option_table() -> str:
    """Return the options as JSON, made from `RunConfig`, which is slow to import."""
    from cangauge.service.config import config_keys

    keys = [
        OptionKey(
            key.name, key.option, key.kind, key.help,
            key.info.metavar, key.info.is_path, key.info.bare,
        )
        for key in config_keys()
        if key.option
    ]  # fmt: skip
    rows = [json.dumps(key._asdict(), ensure_ascii=False) for key in keys]
    return "[\n" + ",\n".join(rows) + "\n]\n"


def _kept_keys() -> Iterator[OptionKey]:
    for row in json.loads(_FILE.read_text(encoding="utf-8")):
        yield OptionKey(**row)


_KEYS: Final = {key.name: key for key in _kept_keys()}
_TYPES: Final[Mapping[str, type]] = {"number": float, "true or false": bool}


_BARE: Final = {key.option: key.bare for key in _KEYS.values() if key.bare}


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


def config_option(name: str) -> Any:
    """Return the typer option of a key, such as "ids.soc_detail"."""
    key = _KEYS[name]
    return typer.Option(*key.option.split(", "), metavar=key.metavar or None, help=key.help)


def config_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the `**options` of a command by one option for each key of the configuration."""
    signature = inspect.signature(command, eval_str=True)
    own = [each for each in signature.parameters.values() if each.kind is not each.VAR_KEYWORD]
    made = [
        inspect.Parameter(
            _parameter(name),
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[_type(key) | None, config_option(name)],
        )
        for name, key in _KEYS.items()
    ]

    def with_options(**values: Any) -> None:
        command(**values)

    with_options.__doc__ = command.__doc__
    with_options.command_class = ConfigCommand  # type: ignore[attr-defined] # read by the app
    parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in own]
    with_options.__signature__ = inspect.Signature(parameters + made)  # type: ignore[attr-defined] # read by typer
    with_options.__annotations__ = {each.name: each.annotation for each in parameters + made}
    return with_options


def config_values(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return given options as the keys of a configuration, for `load_config`.

    Raises
    ------
    InputError
        If a bus option is not K=V, or an id is not a number.
    """
    from cangauge.bus.open import parse_bus_options

    values = {name: options[_parameter(name)] for name in _KEYS if "." not in name}
    values = {name: str(v) if isinstance(v, Path) else v for name, v in values.items()}
    values["bus_options"] = parse_bus_options(values["bus_options"] or [])
    names = [name.removeprefix("ids.") for name in _KEYS if name.startswith("ids.")]
    return {**values, "ids": frame_ids(**{name: options[f"{name}_id"] for name in names})}


def frame_ids(**given: str | None) -> dict[str, int]:
    """Return the given ids by key; "0x…" is hexadecimal.

    Raises
    ------
    InputError
        If one is not a number.
    """
    ids = {}
    for key, text in given.items():
        if text is None:
            continue
        try:
            ids[key] = int(text, 0)
        except ValueError as error:
            raise InputError(
                "not a CAN id",
                field=_KEYS[f"ids.{key}"].option,
                value=text,
                cure="write it as 0x5A0",
            ) from error
    return ids


def _parameter(name: str) -> str:
    return f"{name.removeprefix('ids.')}_id" if name.startswith("ids.") else name


def _type(key: OptionKey) -> Any:
    if key.name == "bus_options":
        return list[str]
    if key.is_path:
        return Path
    # Checked by the configuration, for the same message as in a file; "auto" is no number.
    return str if key.name == "initial_soc" else _TYPES.get(key.kind, str)


InterfaceOption = Annotated[str | None, config_option("interface")]
ChannelOption = Annotated[str | None, config_option("channel")]
BusOptionOption = Annotated[list[str] | None, config_option("bus_options")]
BusVehicleOption = Annotated[str | None, config_option("vehicle")]
BusDbcOption = Annotated[Path | None, config_option("dbc")]
BusMapOption = Annotated[Path | None, config_option("map")]
BusTemperatureOption = Annotated[float | None, config_option("temperature")]
EstimateIdOption = Annotated[str | None, config_option("ids.soc_estimate")]
DetailIdOption = Annotated[str | None, config_option("ids.soc_detail")]
ClockIdOption = Annotated[str | None, config_option("ids.replay_clock")]


if __name__ == "__main__":
    sys.stdout.write(option_table())
