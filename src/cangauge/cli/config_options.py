"""Options of the commands on a bus, made from the keys of `RunConfig`."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from cangauge.service.config import ConfigKey, config_keys

_OPTIONS: Final = {key.name: key for key in config_keys() if key.info.option}
_TYPES: Final[Mapping[str, type]] = {"number": float, "true or false": bool}


def config_parameters(*names: str) -> list[inspect.Parameter]:
    """Return the options of keys, such as "channel", as typer reads them; without names of all."""
    return [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                _type(key) | None,
                typer.Option(
                    *key.info.option.split(", "), metavar=key.info.metavar or None, help=key.help
                ),
            ],
        )
        for name, key in _OPTIONS.items()
        if not names or name in names
    ]


def _type(key: ConfigKey) -> Any:
    if key.name == "bus_options":
        return list[str]
    if key.info.is_path:
        return Path
    # Checked by the configuration, for the same message as in a file; "auto" is no number.
    return str if key.name == "initial_soc" else _TYPES.get(key.kind, str)


def config_values(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return given options as keys of a configuration; InputError if a bus option is wrong."""
    from cangauge.bus.open import parse_bus_options

    values = {name: str(v) if isinstance(v, Path) else v for name, v in options.items()}
    return values | {"bus_options": parse_bus_options(options["bus_options"] or [])}
