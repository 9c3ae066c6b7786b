"""`cangauge check`: a configuration of `cangauge run`, without its bus."""

from __future__ import annotations

from pathlib import Path

from cangauge.cli.declare import command
from cangauge.cli.output import emit_json, print_table


@command()
def check_command(config: Path, *, json_output: bool = False) -> None:
    """Check a configuration as `cangauge run` would read it, without opening the bus.

    Reads model, DBC and map, and checks ids, bus and output files. Exit code 2 and one line
    with file, key, value and cure, if `run` or a reload would refuse it.

    Examples
    --------
    `cangauge check car.toml && systemctl reload cangauge@can0`

    Parameters
    ----------
    config : FILE.toml
        Configuration of `cangauge run`.
    """
    from cangauge.service.run import Service

    service = Service(config)
    pipeline, ids = service.pipeline, service.pipeline.settings.ids
    found = {
        "bus": service.bus,
        "vehicle": pipeline.vehicle.name,
        "model": pipeline.model.name,
        "method": pipeline.settings.estimator.method,
        "time_source": pipeline.settings.time_source,
        "received": sorted(f"0x{key:X}" for key in pipeline.vehicle.wanted_ids),
        "published": [f"0x{key:X} {name.upper()}" for key, name in ids.published.items()],
    }
    if json_output:
        emit_json(found)
        return
    rows = [
        (name.replace("_", " "), ", ".join(value) if isinstance(value, list) else str(value))
        for name, value in found.items()
    ]
    print_table(f"{config}: `cangauge run` takes it", ("", ""), rows)
