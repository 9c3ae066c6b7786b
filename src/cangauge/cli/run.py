"""`cangauge run`: the service, frames in, SoC frames out."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Self

import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from cangauge._logging import LogFormat, emit, logging_to, takes_text
from cangauge._text import number
from cangauge.cli.config_options import config_options, config_values
from cangauge.cli.options import JsonOption
from cangauge.cli.output import console, emit_json
from cangauge.errors import CangaugeError
from cangauge.types import Status

if TYPE_CHECKING:
    from cangauge.service.status import Snapshot

_LOG = logging.getLogger(__name__)


@config_options
def run_command(
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            help="Options in a file, by their names with underscores. Options given here take"
            " precedence.",
        ),
    ] = None,
    json_output: JsonOption = False,
    **options: Any,
) -> None:
    """Estimate the state of charge from a bus, and publish it there.

    Publishes SOC_ESTIMATE (0x5A0) every 100 ms, and SOC_DETAIL (0x5A1), SOC_HEALTH (0x5A2),
    SOC_POWER (0x5A3) and, where there are cell voltages, SOC_CELLS (0x5A4) every second, as in
    `dbc/soc_estimate.dbc`: SoC and its standard deviation [%], status, reasons; capacity [Ah];
    possible currents [A]; energy left [kWh]. Ctrl-C or SIGTERM stops it with a summary. Positive
    current discharges.

    SIGHUP reloads configuration, model and vehicle: the SoC continues, an invalid configuration
    is refused. Changes of the bus, the time source and output files need a restart.

    Examples
    --------
    `cangauge run -m leaf.json --vehicle leaf_aze0 --interface socketcan --channel can0`

    `cangauge run -m leaf.json --time-source replay-clock`  (and, beside it,
    `cangauge replay trip.parquet --speed max`)

    `cangauge run --config car.toml --record drive.log -o soc.parquet`

    `cangauge run --config car.toml --state /var/lib/cangauge`

    `cangauge run --config car.toml --dashboard`  (the live page at http://127.0.0.1:8642/)
    """
    from cangauge.service.config import load_config
    from cangauge.service.lifecycle import deadline_after_signal
    from cangauge.service.run import Service

    given = config_values(options)
    loaded = load_config(config, given)
    with ExitStack() as stack:
        stack.enter_context(logging_to(loaded.log_format, loaded.log_level))
        stack.enter_context(_failures_logged(loaded.log_format))
        service = Service(config, **given)
        shown_on = [stack.enter_context(LiveLine(console)).show] if console.is_terminal else []
        if (address := loaded.dashboard_address()) is not None:
            # bokeh is slow to import, and few services serve the page.
            from cangauge.extras.live.launch import LivePage

            page = LivePage(address, lambda active: service.record(active=active))
            shown_on.append(stack.enter_context(page).show)
        service.on_status = _each(shown_on)
        # Everything loaded so far lives until exit. Garbage collection of it would pause the loop,
        # and destroying it would delay the exit by a second.
        gc.freeze()
        stack.enter_context(deadline_after_signal())
        result = service.run()
        if json_output:
            emit_json(result)


def _each(shown_on: Sequence[Callable[[Snapshot], None]]) -> Callable[[Snapshot], None]:
    def show(snapshot: Snapshot) -> None:
        for each in shown_on:
            each(snapshot)

    return show


@contextmanager
def _failures_logged(log_format: LogFormat) -> Iterator[None]:
    """Log a failure as an event where stderr is JSON, so that each line is an object."""
    try:
        yield
    except CangaugeError as error:
        if log_format == "json":
            emit(_LOG, logging.ERROR, "service.failed", str(error), exit_code=error.exit_code)
            error.logged = True
        raise


_STYLE: Final = {
    Status.INITIALISING: "yellow",
    Status.VALID: "green",
    Status.DEGRADED: "yellow",
    Status.INVALID: "red",
}


class LiveLine:
    """One line on a terminal: SoC ± standard deviation, status, voltage, residual and rate.

    Parameters
    ----------
    console : rich.console.Console
    """

    def __init__(self, console: Console) -> None:
        # Without a refresh thread: drawn at each snapshot.
        self._live = Live(console=console, auto_refresh=False, transient=True)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, snapshot: Snapshot) -> None:
        """Draw a snapshot, unless the terminal is stopped."""
        if not takes_text(self._live.console.file):
            return
        self._live.update(live_text(snapshot), refresh=True)


def live_text(snapshot: Snapshot) -> Text:
    """Return the line."""
    from cangauge.types import reason_names

    estimate, sample = snapshot.estimate, snapshot.sample
    text = Text("SoC ", no_wrap=True, overflow="ellipsis")
    soc = f"{number(estimate.soc_pct, 2)} ± {number(estimate.soc_std_pct, 2, '%')}"
    text.append(soc, style="bold")
    text.append("  ")
    text.append(estimate.status.name.lower(), style=_STYLE[estimate.status])
    if reasons := reason_names(int(estimate.reasons)):
        text.append(f" ({reasons})", style="dim")
    if sample is not None:
        residual = number(1e3 * estimate.residual_v, 0, "mV")
        text.append(f"  {number(sample.voltage_v, 2, 'V')}  residual {residual}")
    text.append(f"  {snapshot.samples_per_s:.0f} samples/s")
    if snapshot.bus_trouble:
        text.append(f"  {snapshot.bus_trouble}", style="bold red")
    return text
