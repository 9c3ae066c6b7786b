"""The screen of `cangauge monitor` (extra `monitor`): text first, so that 80 × 24 is enough."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rich.text import Text

from cangauge._text import NONE_KNOWN, duration, number, printable
from cangauge.cli.status import with_std
from cangauge.errors import InputError
from cangauge.types import REASON_WORDS, reason_name

if TYPE_CHECKING:
    from cangauge.service.status_feed import Point, StatusFeed, View

try:
    from textual.app import App, ComposeResult
    from textual.binding import Binding, BindingType
    from textual.containers import VerticalScroll
    from textual.screen import ModalScreen
    from textual.widgets import Footer, Static
except ImportError as error:
    raise InputError(
        "the screen needs the package textual, which is not installed",
        cure="pip install 'cangauge[monitor]'; `cangauge monitor --once` works without",
    ) from error

DRAW_EVERY_S: Final = 0.25
RANGES_S: Final = (60.0, 600.0, 3600.0, math.inf)
"""Ranges of the charts [s], in the order of the key; infinite: all."""
_FIXED_ROWS: Final = 14
"""Rows of the screen without the two charts."""
_LABEL_WIDTH: Final = 9
_BLOCKS: Final = " ▁▂▃▄▅▆▇█"
_LETTERS: Final = {
    "valid": "V",
    "degraded": "D",
    "initialising": "I",
    "invalid": "X",
    "": "·",
}
_LEGEND: Final = "V valid  D degraded  I initialising  X invalid  · no answer"
_WORDS: Final = {
    reason_name(reason).replace(" ", "_"): words for reason, words in REASON_WORDS.items()
}
_HELP: Final = """\
p      pause the display; recording of the history continues
r      range of the charts: 1 min, 10 min, 1 h, all
?      this help; Escape closes it
q      quit; the service is not touched

SoC ± is one standard deviation. "By voltage" is the inverse of the
voltage model alone, "by charge" is Coulomb counting alone.
Positive current discharges. The residual is the measured voltage
less the modelled one; one that lasts is a gap of the model:
`cangauge gap` finds its cause. The measured voltage shown may be a
sample newer than the modelled one.

"""


def in_columns(
    points: Sequence[Point], now_s: float, span_s: float, columns: int
) -> list[list[Point]]:
    """Return the points of each of equal parts of the time span that ends now."""
    found: list[list[Point]] = [[] for _ in range(columns)]
    for point in points:
        at = math.floor(columns * (point.time_s - (now_s - span_s)) / span_s)
        if 0 <= at <= columns:
            found[min(at, columns - 1)].append(point)
    return found


def chart(title: str, values: Sequence[float], rows: int, digits: int) -> Iterator[str]:
    """Yield the rows of a bar chart whose scale is that of its values; NaN leaves a gap."""
    known = [each for each in values if math.isfinite(each)]
    low, high = (min(known), max(known)) if known else (math.nan, math.nan)
    # A constant is drawn at half height, not as noise of its last digit.
    least = 10.0**-digits
    if known and high - low < least:
        low, high = low - least, high + least
    labels = {0: number(high, digits), rows - 1: number(low, digits), rows // 2: title}
    # Eighths of a row, at least one where a value is known.
    heights = [
        0 if math.isnan(each) else 1 + round((8 * rows - 1) * (each - low) / (high - low))
        for each in values
    ]
    for row in range(rows):
        below = 8 * (rows - 1 - row)
        cells = "".join(_BLOCKS[min(max(each - below, 0), 8)] for each in heights)
        yield f"{labels.get(row, ''):>{_LABEL_WIDTH - 1}} {cells}".rstrip()


def timeline(columns: Sequence[Sequence[Point]]) -> str:
    """Return a letter for the worst status of each column; a blank where nothing is known."""
    order = ["invalid", "", "initialising", "degraded", "valid"]
    return "".join(
        _LETTERS[min((each.status for each in points), key=order.index)] if points else " "
        for points in columns
    )


def lines(view: View, width: int, height: int, range_s: float, *, is_paused: bool) -> list[str]:
    """Return the rows of the screen."""
    from cangauge.service.status_feed import alarm

    status = view.status
    state = "PAUSED" if is_paused else ""
    if status is None:
        return [
            f"cangauge at {view.place}  {state}",
            "",
            alarm(view),
            "",
            "waiting for a service …",
        ]
    chart_rows = max((height - _FIXED_ROWS) // 2, 3)
    began_s = view.points[0].time_s if view.points else view.now_s
    span_s = min(range_s, max(view.now_s - began_s, RANGES_S[0]))
    columns = in_columns(view.points, view.now_s, span_s, max(width - _LABEL_WIDTH, 10))
    soc = [_mean([each.soc_pct for each in points]) for points in columns]
    current = [_mean([each.current_a for each in points]) for points in columns]
    whole = "all" if math.isinf(range_s) else duration(range_s)
    shown = f"last {whole}" if span_s == range_s else f"{duration(span_s)} of {whole}"
    return [
        f"{status['bus']} · {status['vehicle']} · {status['method']} · {view.place}  {state}",
        alarm(view),
        *_soc_lines(view, width),
        *_two_columns(view),
        *chart("SoC %", soc, chart_rows, 2),
        *chart("A", current, chart_rows, 1),
        f"{'status':>{_LABEL_WIDTH - 1}} {timeline(columns)}",
        f" {_LEGEND}   {shown}",
    ]


def _soc_lines(view: View, width: int) -> list[str]:
    status = view.status or {}
    estimate, reasons = status["estimate"], status["reasons"]
    state = status["status"].upper() if view.is_answered else "LAST KNOWN"
    first = (
        f"SoC {with_std(estimate['soc_pct'], estimate['soc_std_pct'], '%', 2)}   {state}"
        f"   by voltage {number(estimate['soc_newton_pct'], 1, '%')}"
        f"   by charge {number(estimate['soc_coulomb_pct'], 1, '%')}"
    )
    words = [_WORDS.get(each, each.replace("_", " ")) for each in reasons]
    if len(words) > 2:
        words = [words[0], f"{words[1]} (and {len(words) - 2} more: ?)"]
    bullets = [f"  - {each}"[:width] for each in words]
    return [first, *[*bullets, "", ""][:2]]


def _two_columns(view: View) -> list[str]:
    status = view.status or {}
    estimate, sample = status["estimate"], status["sample"] or {}
    health, power = status["health"] or {}, status["power"] or {}
    cells = status["cells"] or {}
    weakest = NONE_KNOWN
    if cells.get("weakest") is not None:
        weakest = f"{cells['weakest']}: {with_std(cells['soc_pct'], cells['soc_std_pct'], '%')}"
    energy_kwh, energy_std_kwh = (
        None if power.get(name) is None else 1e-3 * power[name]
        for name in ("energy_wh", "energy_std_wh")
    )
    residual_v = estimate["residual_v"]
    rejects = sum(status["rejects"].values())
    left = [
        ("current", number(sample.get("current_a"), 1, "A")),
        ("voltage", number(sample.get("voltage_v"), 2, "V")),
        ("modelled", number(estimate["voltage_model_v"], 2, "V")),
        ("residual", number(None if residual_v is None else 1e3 * residual_v, 0, "mV")),
        ("temperature", number(sample.get("temperature_c"), 1, "°C")),
        ("frames", f"{number(view.frames_per_s, 0)} /s"),
        ("rejected", f"{rejects} ({number(view.rejects_per_s, 1)} /s)"),
    ]
    right = [
        ("capacity", with_std(health.get("capacity_ah"), health.get("capacity_std_ah"), "Ah")),
        (
            "resistance",
            with_std(health.get("resistance_ratio"), health.get("resistance_std"), "× model's", 2),
        ),
        ("sensor offset", number(health.get("offset_a"), 2, "A")),
        (
            "discharge 10 s",
            with_std(power.get("discharge_a"), power.get("discharge_std_a"), "A", 0),
        ),
        ("charge 10 s", with_std(power.get("charge_a"), power.get("charge_std_a"), "A", 0)),
        ("energy left", with_std(energy_kwh, energy_std_kwh, "kWh")),
        ("weakest cell", weakest),
    ]
    return [
        f"{name:<12}{value:<22}{other:<15}{text}"
        for (name, value), (other, text) in zip(left, right, strict=True)
    ]


def _mean(values: Sequence[float]) -> float:
    known = [each for each in values if math.isfinite(each)]
    return sum(known) / len(known) if known else math.nan


class MonitorScreen(App[None]):
    """Draw a feed a few times a second.

    Parameters
    ----------
    feed : StatusFeed
        Entered by the caller.
    """

    CSS = "#body { width: 1fr; height: 1fr; text-wrap: nowrap; text-overflow: ellipsis; }"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("p", "pause", "Pause"),
        Binding("r", "range", "Range"),
        Binding("question_mark", "explain", "Help", key_display="?"),
        Binding("q", "quit", "Quit"),
    ]

    def __init__(self, feed: StatusFeed) -> None:
        super().__init__()
        self._feed = feed
        self._frozen: View | None = None
        self._range = 1

    def compose(self) -> ComposeResult:
        """Lay out the screen."""
        yield Static(id="body", markup=False)
        yield Footer()

    def on_mount(self) -> None:
        """Draw from now on."""
        self.set_interval(DRAW_EVERY_S, self._draw)
        self._draw()

    def action_pause(self) -> None:
        """Stop or go on."""
        self._frozen = None if self._frozen is not None else self._feed.view()
        self._draw()

    def action_range(self) -> None:
        """Take the next range."""
        self._range = (self._range + 1) % len(RANGES_S)
        self._draw()

    def action_explain(self) -> None:
        """Show keys, words and all reasons."""
        status = self._feed.view().status or {}
        reasons = [f"- {_WORDS.get(each, each)}" for each in status.get("reasons", [])]
        present = "\n".join(["Reasons now:", *(reasons or ["- none"])])
        self.push_screen(_Explanation(_HELP + present))

    def on_resize(self) -> None:
        """Draw for the new size."""
        self._draw()

    def _draw(self) -> None:
        if len(self.screen_stack) > 1:
            return
        view = self._frozen or self._feed.view()
        width, height = self.size.width, self.size.height - 1
        rows = lines(view, width, height, RANGES_S[self._range], is_paused=self._frozen is not None)
        self.query_one("#body", Static).update(_styled(rows))


class _Explanation(ModalScreen[None]):
    CSS = "VerticalScroll { background: $panel; padding: 1 2; }"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,question_mark,q", "dismiss", "Close", key_display="Esc")
    ]

    def __init__(self, text: str) -> None:
        super().__init__()
        self._text = text

    def compose(self) -> ComposeResult:
        yield VerticalScroll(Static(printable(self._text), markup=False))
        yield Footer()


def _styled(rows: Sequence[str]) -> Text:
    """Return the rows; weight and inversion only repeat what the words say."""
    styles: dict[int, Any] = {0: "dim", 1: "reverse bold", 2: "bold"}
    text = Text(no_wrap=True, overflow="ellipsis")
    for at, row in enumerate(rows):
        text.append(printable(row) + "\n", style=styles.get(at, ""))
    return text
