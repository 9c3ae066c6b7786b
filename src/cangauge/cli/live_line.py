"""One line on a terminal that follows a service."""

from __future__ import annotations

from typing import Any, Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cangauge._logging import takes_text
from cangauge._text import number
from cangauge.service.output import Output
from cangauge.service.status import Snapshot

_STYLE: Final = {"initialising": "yellow", "valid": "green", "degraded": "yellow", "invalid": "red"}


class LiveLine(Output):
    """SoC ± standard deviation, status, voltage, residual and rate, drawn at each snapshot.

    Parameters
    ----------
    console : rich.console.Console
    """

    def __init__(self, console: Console) -> None:
        # Without a refresh thread.
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._live.start()

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Draw a snapshot, unless the terminal is stopped."""
        if takes_text(self._live.console.file):
            self._live.update(live_text(snapshot.status), refresh=True)

    def close(self) -> None:
        """Remove the line."""
        self._live.stop()


def live_text(status: dict[str, Any]) -> Text:
    """Return the line."""
    estimate, sample, reasons = status["estimate"], status["sample"], status["reasons"]
    text = Text("SoC ", no_wrap=True, overflow="ellipsis")
    soc = f"{number(estimate['soc_pct'], 2)} ± {number(estimate['soc_std_pct'], 2, '%')}"
    text.append(soc, style="bold")
    text.append("  ")
    text.append(status["status"], style=_STYLE[status["status"]])
    if reasons:
        text.append(f" ({'; '.join(each.replace('_', ' ') for each in reasons)})", style="dim")
    if sample is not None:
        residual_v = estimate["residual_v"]
        residual = number(None if residual_v is None else 1e3 * residual_v, 0, "mV")
        text.append(f"  {number(sample['voltage_v'], 2, 'V')}  residual {residual}")
    text.append(f"  {status['samples_per_s']:.0f} samples/s")
    if status["bus_trouble"]:
        text.append(f"  {status['bus_trouble']}", style="bold red")
    return text
