"""A report page: tiles, tables and figures as one HTML file that needs no network.

Scripts and styles are inline and the content security policy forbids any request, so a page needs
no network and stays readable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Final

from bokeh.document import Document
from bokeh.embed import components
from bokeh.resources import Resources
from bokeh.themes import Theme
from jinja2 import Environment, PackageLoader, StrictUndefined

from cangauge._files import file_sha256, text_sha256
from cangauge._text import is_numeric
from cangauge._version import __version__
from cangauge.extras.report.charts import MAX_POINTS
from cangauge.model.model_file import Model

_FONT: Final = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
"""As in page.css: a canvas does not inherit the page's font."""

_THEME: Final = Theme(
    json={
        "attrs": {
            "Plot": {
                "background_fill_color": "#ffffff",
                "border_fill_color": "#ffffff",
                "outline_line_color": "#d5dae1",
            },
            "Axis": {
                "axis_label_text_font": _FONT,
                "axis_label_text_font_size": "13px",
                "axis_label_text_font_style": "normal",
                "axis_label_text_color": "#3b4654",
                "major_label_text_font": _FONT,
                "major_label_text_font_size": "12px",
                "major_label_text_color": "#3b4654",
                "axis_line_color": "#aab3bf",
                "major_tick_line_color": "#aab3bf",
                "minor_tick_line_color": None,
            },
            "Grid": {"grid_line_color": "#edf0f4"},
            "Legend": {
                "label_text_font": _FONT,
                "label_text_font_size": "12px",
                "label_text_color": "#1c2430",
                "border_line_color": None,
                "background_fill_alpha": 0.0,
                "padding": 0,
                "margin": 2,
                "spacing": 14,
                "glyph_width": 18,
            },
        }
    }
)


@dataclass(frozen=True)
class InputFile:
    """An input file of a page.

    Parameters
    ----------
    role : str
        "model", "log", "reference", …
    name : str
    sha256 : str, optional
        In hexadecimal; None where the data did not come from a single file.
    """

    role: str
    name: str
    sha256: str | None = None

    @classmethod
    def of_path(cls, role: str, name: str, path: str | Path) -> InputFile:
        """Hash the file at `path`, if it is one."""
        return cls(role, name, file_sha256(path))

    @classmethod
    def of_model(cls, model: Model, path: Path | None = None) -> InputFile:
        """Hash a model's file, or without one the file that it would be written as."""
        if path is not None:
            return cls.of_path("model", model.name, path)
        return cls("model", model.name, text_sha256(model.to_json()))


@dataclass(frozen=True)
class Tile:
    """One figure of the summary."""

    label: str
    value: str
    hint: str = ""


@dataclass(frozen=True)
class Table:
    """A table of texts; columns of numbers are set flush right."""

    kind: ClassVar[str] = "table"
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    @property
    def is_numeric(self) -> list[bool]:
        """Whether each column holds nothing but numbers."""
        columns = list(zip(*self.rows, strict=True)) or [()] * len(self.head)
        return [is_numeric(column) for column in columns]


@dataclass(frozen=True, eq=False)
class Figure:
    """A bokeh figure with a title above and a caption below.

    Parameters
    ----------
    title : str
    plot : bokeh figure
        `bokeh.plotting.show(figure.plot)` draws it in a notebook.
    caption : str
        What to look for.
    """

    kind: ClassVar[str] = "figure"
    title: str
    plot: Any
    caption: str


@dataclass(frozen=True, eq=False)
class Beside:
    """Figures side by side where the page is wide enough."""

    kind: ClassVar[str] = "beside"
    figures: Sequence[Figure]


@dataclass(frozen=True)
class Paragraph:
    """Plain text."""

    kind: ClassVar[str] = "paragraph"
    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of remarks."""

    kind: ClassVar[str] = "bullets"
    items: Sequence[str]


Block = Table | Figure | Beside | Paragraph | Bullets


@dataclass(frozen=True, eq=False)
class Section:
    """A titled part of the page."""

    title: str
    blocks: Sequence[Block]
    is_folded: bool = False
    """Whether only the title is seen until it is opened."""


@dataclass(frozen=True, eq=False)
class Page:
    """A whole report.

    Parameters
    ----------
    title : str
        Names the model or the logs; also the title of the browser's tab.
    subtitle : str
    tiles : sequence of Tile
    sections : sequence of Section
    lead : str
        The result in a sentence, above the subtitle.
    inputs : sequence of InputFile
        Input files.
    banners : sequence of str
        Warnings at the top of the page, such as that a log is a reconstruction.
    """

    title: str
    subtitle: str
    tiles: Sequence[Tile]
    sections: Sequence[Section]
    lead: str = ""
    inputs: Sequence[InputFile] = field(default=())
    banners: Sequence[str] = field(default=())

    @property
    def figures(self) -> list[Figure]:
        """All figures in the order of the page."""
        blocks = [block for section in self.sections for block in section.blocks]
        beside = [block.figures if isinstance(block, Beside) else [block] for block in blocks]
        return [item for items in beside for item in items if isinstance(item, Figure)]


def render(page: Page) -> str:
    """Return the page as one self-contained HTML text, dated now."""
    figures = page.figures
    script, drawn, bokeh_js = "", (), ""
    if figures:
        _add_to_document([item.plot for item in figures])
        script, drawn = components([item.plot for item in figures], theme=_THEME)
        # Only bokeh's core: its widgets, tables and formulae would add 2.7 MB.
        bokeh_js = Resources(mode="inline", components=["bokeh"]).render()
    environment = Environment(
        loader=PackageLoader("cangauge.extras.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style, _, _ = environment.loader.get_source(environment, "page.css")  # type: ignore[union-attr]
    return environment.get_template("page.html.j2").render(
        page=page,
        plots=dict(zip(figures, drawn, strict=True)),
        style=style,
        bokeh_js=bokeh_js,
        bokeh_script=script,
        version=__version__,
        made=datetime.now(UTC),
        max_points=MAX_POINTS,
    )


def _add_to_document(plots: Sequence[Any]) -> None:
    """Add plots to one document at once: bokeh would search it again after each of them."""
    if any(plot.document is not None for plot in plots):
        return  # rendered before
    document = Document()
    with document.models.freeze():
        for plot in plots:
            document.add_root(plot)


def joined(names: Sequence[str], at_most: int = 3) -> str:
    """Return names for a title: the first few, and how many more there are."""
    if len(names) <= at_most:
        return ", ".join(names)
    return f"{', '.join(names[: at_most - 1])} and {len(names) - at_most + 1} more"


def reconstruction_banners(*texts: str) -> list[str]:
    """Return the banner to show if a name, source or remark mentions a reconstruction."""
    if not any("reconstruction" in text.lower() for text in texts):
        return []
    return [
        "This is a reconstruction: the log was computed from a published equation and published"
        " coefficients. It is not a recording of a car."
    ]
