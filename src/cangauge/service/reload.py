"""Another configuration while running: all of it or nothing, and SoC goes on.

What takes effect at once: the model (also another one in the same file), the car and its files,
method, capacity, gaps, pairing, time-outs, ends, and the ids of what is published. Initial SoC and
its standard deviation are ignored: SoC is known by now. The bus, the time source, REPLAY_CLOCK's id
and the files to write stay what they are until the service is started again, and that is said.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.model.model_file import load_model
from cangauge.service.config import RunConfig
from cangauge.service.gauge import Gauge
from cangauge.service.loop import LoopSettings

NEEDS_RESTART: Final = (
    "interface",
    "channel",
    "bus_options",
    "wait_for_bus",
    "time_source",
    "record",
    "output",
    "state",
    "state_max_age_s",
    "record_part_mb",
    "record_part_s",
    "record_keep_mb",
    "http",
    "http_token_file",
    "status_socket",
    "log_format",
    "log_level",
)
"""What stays as it was at the start."""


class Reloader:
    """Gives a gauge another configuration.

    Parameters
    ----------
    read : callable
        Returns the configuration as it now stands; may raise InputError.
    config : RunConfig
        The one that the gauge was made of.
    vehicle : Vehicle
        Likewise.
    gauge : Gauge
    say : callable
        Takes a line of text.

    Attributes
    ----------
    config : RunConfig
        The configuration in use, but for what needs a restart.
    """

    def __init__(
        self,
        read: Callable[[], RunConfig],
        config: RunConfig,
        vehicle: Vehicle,
        gauge: Gauge,
        say: Callable[[str], None],
    ) -> None:
        self._read = read
        self.config = config
        self._gauge = gauge
        self._say = say
        self._vehicle_key = _vehicle_key(config, vehicle)

    def reload(self) -> LoopSettings | None:
        """Read and apply; return the loop's settings, or None if the old configuration stays.

        Whatever is wrong with the new one is said in one line.
        """
        try:
            config = self._read()
            vehicle, model = config.load_vehicle(), load_model(config.model)
            key = _vehicle_key(config, vehicle)
            settings = config.gauge_settings()
            started = self._gauge.settings
            ids = replace(settings.ids, replay_clock=started.ids.replay_clock)
            self._gauge.reconfigure(
                None if key == self._vehicle_key else vehicle,
                model,
                replace(settings, ids=ids, time_source=started.time_source),
            )
        except (InputError, OSError) as error:  # OSError: a file went while it was read
            self._say(f"warning: new configuration refused, the old one goes on: {error}")
            return None
        self._vehicle_key = key
        self._tell(config)
        self.config = config
        return config.loop_settings()

    def _tell(self, config: RunConfig) -> None:
        old, new = self.config.model_dump(), config.model_dump()
        changed = [name for name in new if new[name] != old[name]]
        self._say(f"configuration read again; changed: {', '.join(changed) or 'no option'}")
        late = [name for name in changed if name in NEEDS_RESTART]
        if self.config.ids.replay_clock != config.ids.replay_clock:
            late.append("ids.replay_clock")
        if late:
            self._say(f"warning: {', '.join(late)}: takes effect when the service starts again")


def _vehicle_key(config: RunConfig, vehicle: Vehicle) -> tuple[object, ...]:
    """Return what tells a vehicle from another: what it is made of, files by their content."""
    files = [*vehicle.dbc_files, *([config.map] if config.map is not None else [])]
    contents = tuple(hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files)
    chosen = (config.messages, config.rules, config.checks)
    return (config.vehicle, config.temperature, config.pair_within_s, chosen, *contents)
