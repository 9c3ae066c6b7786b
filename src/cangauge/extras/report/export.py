"""Figures of a page as PNG and SVG files, drawn from the same data by matplotlib (extra `figures`).

bokeh itself exports through a browser; this way needs none.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

import numpy as np
from bokeh.models import BoxAnnotation, ColorBar, FactorRange, Label, Span, Whisker

from cangauge._files import atomic_path, open_regular
from cangauge.errors import InputError
from cangauge.extras.report.page import Page

_PX_PER_INCH: Final = 96.0
"""Of CSS."""
_WIDTH_IN: Final = 10.0
_PNG_DPI: Final = 200
_HEAD_BYTES: Final = 4096
"""Beginning of a file in which matplotlib writes its description [bytes]."""
_MARK: Final = "figure of cangauge "
_SUFFIXES: Final = (".png", ".svg")
_DASHES: Final = {"dashed": (6.0, 4.0)}


def write_figures(page: Page, folder: Path, kind: str) -> list[Path]:
    """Write every figure of a page as PNG and as SVG, and return the files.

    Parameters
    ----------
    page : Page
    folder : Path
        Made if it is missing; figures of this kind that are in it are replaced, nothing else.
    kind : str
        Of the page, such as "fit.fit_page"; noted in each file.

    Raises
    ------
    InputError
        If a file that is no figure of cangauge has the name of a figure; nothing is written then.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    folder.mkdir(parents=True, exist_ok=True)
    mark = f"{_MARK}{kind}."
    earlier = {
        path
        for suffix in _SUFFIXES
        for path in folder.glob(f"[0-9][0-9]-*{suffix}")
        if _has_mark(path, mark)
    }
    names = [
        f"{count:02d}-{item.anchor.removeprefix('figure-')}"
        for count, item in enumerate(page.figures, start=1)
    ]
    written = [folder / f"{name}{suffix}" for name in names for suffix in _SUFFIXES]
    for path in written:
        if os.path.lexists(path) and not _has_mark(path, _MARK):
            raise InputError(
                "this is no figure of cangauge", source=path, cure="name another folder"
            )
    for name, item in zip(names, page.figures, strict=True):
        plots = [child[0] for child in getattr(item.plot, "children", [])] or [item.plot]
        heights = [plot.height / _PX_PER_INCH for plot in plots]
        drawing = Figure((_WIDTH_IN, sum(heights) + 0.4), layout="constrained")
        drawing.suptitle(item.title, fontsize=11, fontweight="bold")
        rows = drawing.subplots(
            len(plots), squeeze=False, gridspec_kw={"height_ratios": heights}
        )  # fmt: skip
        for axes, plot in zip(rows[:, 0], plots, strict=True):
            _draw(drawing, axes, plot)
        for suffix in _SUFFIXES:
            with atomic_path(folder / f"{name}{suffix}") as part:
                drawing.savefig(part, dpi=_PNG_DPI, metadata={"Description": mark})
    for path in earlier.difference(written):
        path.unlink()
    return written


def _has_mark(path: Path, mark: str) -> bool:
    """Return whether a file can be read and has this mark."""
    try:
        with open_regular(path) as file:
            return mark.encode() in file.read(_HEAD_BYTES)
    except InputError:
        return False


def _draw(drawing: Any, axes: Any, plot: Any) -> None:
    """Draw one bokeh figure on matplotlib axes."""
    for renderer in plot.renderers:
        if renderer.visible:
            _Glyph(axes, plot, renderer).draw()
    axes.set_xlabel(plot.xaxis[0].axis_label or "")
    axes.set_ylabel(plot.yaxis[0].axis_label or "")
    axes.xaxis.set_visible(plot.xaxis[0].visible)
    axes.grid(color="#edf0f4")
    axes.set_axisbelow(True)
    if isinstance(plot.y_range, FactorRange):
        axes.set_yticks(range(len(plot.y_range.factors)), plot.y_range.factors)
        axes.set_ylim(-0.6, len(plot.y_range.factors) - 0.4)
    else:
        _limit(axes.set_ylim, plot.y_range)
    _limit(axes.set_xlim, plot.x_range)
    for item in (*plot.center, *plot.right, *plot.left, *plot.above, *plot.below):
        _draw_annotation(drawing, axes, plot, item)
    if plot.legend:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=8, frameon=False)


def _limit(set_limits: Any, limits: Any) -> None:
    """Take over the ends of a range that are set; bokeh leaves the others to the data."""
    low, high = (
        end if isinstance(end, int | float) and np.isfinite(end) else None
        for end in (getattr(limits, "start", None), getattr(limits, "end", None))
    )
    set_limits(low, high)


class _Glyph:
    """The glyph of a renderer, with its columns as arrays."""

    def __init__(self, axes: Any, plot: Any, renderer: Any) -> None:
        self._axes, self._plot = axes, plot
        self._glyph, self._data = renderer.glyph, renderer.data_source.data
        shown = [item for legend in plot.legend for item in legend.items]
        named = any(renderer in item.renderers for item in shown)
        self._label = renderer.name if named else None

    def _of(self, name: str) -> Any:
        """Return a property: a column, positions of categories, or the value itself."""
        return _values(self._plot, self._data, getattr(self._glyph, name))

    def draw(self) -> None:
        getattr(self, f"_{type(self._glyph).__name__.lower()}")()

    def _line(self) -> None:
        if (alpha := self._of("line_alpha")) == 0.0:
            return  # carries the hover text
        dash = _DASHES["dashed"] if self._glyph.line_dash else (None, None)
        self._axes.plot(
            self._of("x"), self._of("y"), color=self._of("line_color"), alpha=alpha,
            linewidth=0.75 * self._of("line_width"), dashes=dash, label=self._label,
        )  # fmt: skip

    def _scatter(self) -> None:
        self._axes.scatter(
            self._of("x"), self._of("y"), s=self._of("size") ** 2, c=self._of("fill_color"),
            alpha=self._of("fill_alpha"), linewidths=0, label=self._label,
        )  # fmt: skip

    def _varea(self) -> None:
        self._axes.fill_between(
            self._of("x"), self._of("y1"), self._of("y2"), color=self._of("fill_color"),
            alpha=self._of("fill_alpha"), linewidth=0, label=self._label,
        )  # fmt: skip

    def _vbar(self) -> None:
        self._axes.bar(
            self._of("x"), self._of("top"), self._of("width"), color=self._of("fill_color"),
            alpha=self._of("fill_alpha"), label=self._label,
        )  # fmt: skip

    def _hbar(self) -> None:
        left = self._of("left")
        self._axes.barh(
            self._of("y"), self._of("right") - left, self._of("height"), left=left,
            color=self._of("fill_color"), label=self._label,
        )  # fmt: skip

    def _quad(self) -> None:
        left, bottom = self._of("left"), self._of("bottom")
        for x, y, width, height, color in zip(
            left, bottom, self._of("right") - left, self._of("top") - bottom,
            _colors(self._data, self._glyph.fill_color), strict=True,
        ):  # fmt: skip
            self._axes.add_patch(_rectangle((x, y), width, height, color))
        self._axes.autoscale_view()

    def _text(self) -> None:
        for x, y, text in zip(self._of("x"), self._of("y"), self._of("text"), strict=True):
            self._axes.text(x, y, text, va="center", fontsize=9)


def _values(plot: Any, data: Any, spec: Any) -> Any:
    spec = getattr(spec, "value", spec)
    column = getattr(spec, "field", spec)
    if not (isinstance(column, str) and column in data):
        return spec
    values = list(data[column])
    factors = getattr(plot.y_range, "factors", None) or []
    if values and set(map(str, values)) <= set(factors):
        return np.array([factors.index(value) for value in values])
    return values if values and isinstance(values[0], str) else np.asarray(values)


def _colors(data: Any, spec: Any) -> list[str]:
    """Return the colours of a column's values by the mapper of the glyph."""
    mapper = spec.transform
    share = (np.asarray(data[spec.field]) - mapper.low) / (mapper.high - mapper.low)
    last = len(mapper.palette) - 1
    return [mapper.palette[int(at)] for at in np.clip(share * last, 0, last)]


def _rectangle(corner: tuple[float, float], width: float, height: float, color: str) -> Any:
    from matplotlib.patches import Rectangle  # noqa: PLC0415 - an extra

    return Rectangle(corner, width, height, facecolor=color, edgecolor="white", linewidth=0.4)


def _draw_annotation(drawing: Any, axes: Any, plot: Any, item: Any) -> None:
    if isinstance(item, Span):
        draw = axes.axhline if item.dimension == "width" else axes.axvline
        draw(item.location, color=item.line_color, linewidth=0.8)
    elif isinstance(item, BoxAnnotation):
        low, high = axes.get_xlim()
        left, right = (getattr(end, "value", end) for end in (item.left, item.right))
        left = left if isinstance(left, int | float) else low
        right = right if isinstance(right, int | float) else high
        axes.axvspan(left, right, color="#9aa4b0", alpha=0.16, linewidth=0)
        axes.set_xlim(low, high)
    elif isinstance(item, Label):
        axes.text(
            item.x, 0.02, f" {item.text}", transform=axes.get_xaxis_transform(), fontsize=7,
            rotation=90 if item.angle else 0, color="#55606e",
        )  # fmt: skip
    elif isinstance(item, Whisker):
        base, low, high = (
            _values(plot, item.source.data, spec) for spec in (item.base, item.lower, item.upper)
        )
        draw = axes.hlines if item.dimension == "width" else axes.vlines
        draw(base, low, high, color="#222222", linewidth=1)
    elif isinstance(item, ColorBar):
        from matplotlib.cm import ScalarMappable  # noqa: PLC0415 - an extra
        from matplotlib.colors import ListedColormap, Normalize  # noqa: PLC0415

        mapper = item.color_mapper
        shades = ScalarMappable(Normalize(mapper.low, mapper.high), ListedColormap(mapper.palette))
        drawing.colorbar(shades, ax=axes, label=item.title)
