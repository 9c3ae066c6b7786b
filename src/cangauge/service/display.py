"""One line on a terminal that shows the running estimate, a few times a second."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cangauge.estimate.types import Status
from cangauge.report.words import number, reason_names
from cangauge.service.gauge import Gauge

SHOW_EVERY_S: Final = 0.25

_STYLE: Final = {
    Status.INITIALISING: "yellow",
    Status.VALID: "green",
    Status.DEGRADED: "yellow",
    Status.INVALID: "red",
}


class LiveLine:
    """SoC ± standard deviation, status, voltage, residual and rate, on a terminal.

    Parameters
    ----------
    console : rich.console.Console
    gauge : Gauge
    trouble : callable, optional
        Returns what is wrong with the bus, in words; empty if nothing is.
    """

    def __init__(
        self, console: Console, gauge: Gauge, trouble: Callable[[], str] | None = None
    ) -> None:
        self._gauge = gauge
        self._trouble = trouble
        # Without a thread of its own: it is drawn when it is told to.
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._due_s = 0.0
        self._last: tuple[float, int] | None = None
        self._rate = 0.0

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._live.stop()

    def show(self, now_s: float) -> None:
        """Draw if it is time to (monotonic clock [s])."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + SHOW_EVERY_S
        samples = self._gauge.samples
        if self._last is not None and now_s > self._last[0]:
            self._rate = (samples - self._last[1]) / (now_s - self._last[0])
        self._last = (now_s, samples)
        text = live_text(self._gauge, self._rate)
        if self._trouble is not None and (trouble := self._trouble()):
            text.append(f"  {trouble}", style="bold red")
        self._live.update(text, refresh=True)


def live_text(gauge: Gauge, samples_per_s: float) -> Text:
    """Return the line."""
    estimate = gauge.latest
    text = Text("SoC ", no_wrap=True, overflow="ellipsis")
    soc = f"{number(estimate.soc_pct, 2)} ± {number(estimate.soc_std_pct, 2, '%')}"
    text.append(soc, style="bold")
    status = estimate.status.name.lower()
    why = reason_names(int(estimate.reasons))
    text.append("  ")
    text.append(status, style=_STYLE[estimate.status])
    if why:
        text.append(f" ({why})", style="dim")
    sample = gauge.latest_sample
    if sample is not None:
        residual = number(1e3 * estimate.residual_v, 0, "mV")
        text.append(f"  {number(sample.voltage_v, 2, 'V')}  residual {residual}")
    text.append(f"  {samples_per_s:.0f} samples/s")
    return text
