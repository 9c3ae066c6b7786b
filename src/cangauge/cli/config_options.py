"""Options of the commands on a bus, made from the keys of `RunConfig`."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from cangauge.service.config import ConfigKey, config_keys


def config_parameters(*names: str) -> list[inspect.Parameter]:
    """Return the options of keys, such as "channel", as typer reads them; without names of all."""
    keys = [key for key in config_keys() if key.option]
    return [_parameter(key) for key in keys if not names or key.name in names]


def _parameter(key: ConfigKey) -> inspect.Parameter:
    kind: Any = Path if key.is_path else float if key.kind == "number" else str
    if key.name == "bus_options":
        kind = list[str]
    elif key.name == "initial_soc":  # "auto" is no number: checked by the configuration
        kind = str
    flags = key.option.split(", ")
    option = typer.Option(*flags, metavar=key.metavar or None, help=key.help)
    return inspect.Parameter(
        key.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[kind | None, option],
    )


def config_values(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return given options as keys of a configuration; InputError if a bus option is wrong."""
    from cangauge.bus.open import parse_bus_options

    values = {name: str(v) if isinstance(v, Path) else v for name, v in options.items()}
    return values | {"bus_options": parse_bus_options(options["bus_options"] or [])}
