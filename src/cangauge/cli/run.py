"""`cangauge run`: the service, frames in, SoC frames out; `cangauge check` of its configuration."""

from __future__ import annotations

import gc
import logging
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.live import Live

from cangauge._logging import emit
from cangauge.cli.options import Json, argument, command, config_parameters, config_values, option
from cangauge.cli.output import console, emit_json, finish, print_values
from cangauge.cli.status import live_text
from cangauge.errors import CangaugeError
from cangauge.service.events import logging_to, takes_text
from cangauge.service.output import Output

if TYPE_CHECKING:
    from cangauge.service.status_client import Snapshot

_LOG = logging.getLogger(__name__)


@command(keys=config_parameters())
def run_command(
    *,
    config: Annotated[
        Path | None,
        option(
            "--config",
            "FILE",
            "Configuration in TOML. `python -m cangauge.service.config` prints its keys. Options"
            " override the keys.",
        ),
    ] = None,
    json_output: Json = False,
    **options: Any,
) -> None:
    """Estimate the state of charge from a bus, and publish it there.

    SOC_ESTIMATE (0x5A0) is sent every 100 ms. It has SoC and standard deviation [%], status and
    reasons. SOC_DETAIL (0x5A1), SOC_HEALTH (0x5A2: capacity [Ah]), SOC_POWER (0x5A3: possible
    currents [A], energy left [kWh]) and, with cell voltages, SOC_CELLS (0x5A4) are sent every
    second. `dbc/soc_estimate.dbc` defines the frames. Ctrl-C or SIGTERM stops the service, which
    then prints a summary. Positive current discharges.

    SIGHUP reloads configuration, model and map file. The SoC is kept, unless current or voltage is
    now decoded differently. An invalid configuration is refused (`cangauge check` tests it before).
    The log names changed keys that need a restart, such as those of bus, time source and recording.

    Examples
    --------
    `cangauge run -m leaf.json --vehicle leaf_aze0 --interface socketcan --channel can0`

    `cangauge run -m leaf.json --time-source replay-clock`  (and, beside it,
    `cangauge replay trip.parquet --speed max`)

    `cangauge run --config car.toml --record drive.log`  (then `cangauge estimate drive.log -m
    leaf.json --vehicle leaf_aze0 -o soc.parquet` writes the live estimates, bit for bit, if the
    keys that are not options of `estimate` have their defaults)

    `cangauge run --config car.toml --state /var/lib/cangauge`

    `cangauge run --config car.toml --dashboard 8642`  (the live page at http://127.0.0.1:8642/)
    """
    from cangauge.service.config import load_config
    from cangauge.service.run import Service

    given = config_values(options)
    loaded = load_config(config, given)
    with ExitStack() as stack:
        stack.enter_context(logging_to(loaded.log_format, loaded.log_level))
        try:
            service = Service(config, [_LiveLine()] if console.is_terminal else [], **given)
            # Everything loaded so far lives until exit. Garbage collection of it would pause the
            # loop, and destroying it would delay the exit by a second.
            gc.freeze()
            result = service.run()
        except CangaugeError as error:
            if loaded.log_format == "json":  # each line of stderr is an object
                emit(_LOG.error, "service.failed", str(error), exit_code=error.exit_code)
                error.logged = True
            raise
        if json_output:
            emit_json(result)


class _LiveLine(Output):
    """One line on the terminal that follows the service, drawn at each snapshot."""

    def __init__(self) -> None:
        # Without a refresh thread.
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._live.start()

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Draw a snapshot, unless the terminal is stopped."""
        if takes_text(self._live.console.file):
            self._live.update(live_text(snapshot.status), refresh=True)

    def close(self) -> None:
        """Remove the line."""
        if takes_text(self._live.console.file):
            self._live.stop()


def check_command(
    config: Annotated[Path, argument("FILE.toml", "Configuration of `cangauge run`.")],
    *,
    json_output: Json = False,
) -> None:
    """Check a configuration as `cangauge run` would read it, without opening the bus.

    Model, DBC, map, token and password are read. Ids, bus, addresses and output files are checked.
    If `run` or a reload would refuse the configuration, the exit code is 2, and one line names
    file, key, value and cure. Whether a port or bus is free is only known when `run` opens it.

    Examples
    --------
    `cangauge check car.toml && systemctl reload cangauge@can0`
    """
    from cangauge.service.run import Service

    service = Service(config)
    pipeline = service.pipeline
    ids = service.pipeline.settings.ids
    found = {
        "bus": service.bus,
        "vehicle": pipeline.vehicle.name,
        "model": pipeline.model.name,
        "method": pipeline.settings.estimator.method,
        "time_source": pipeline.settings.time_source,
        "received": sorted(f"0x{key:X}" for key in pipeline.vehicle.wanted_ids),
        "published": [f"0x{key:X} {name.upper()}" for key, name in ids.published.items()],
    }
    rows = {
        name.replace("_", " "): ", ".join(value) if isinstance(value, list) else str(value)
        for name, value in found.items()
    }
    finish(
        found,
        partial(print_values, f"{config}: `cangauge run` takes it", rows),
        as_json=json_output,
    )
