"""A report page: tiles, tables and figures as one HTML file that needs no network.

Scripts and styles are inline and the content security policy forbids any request, so a page needs
no network and stays readable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from bokeh.embed import components
from bokeh.resources import Resources
from bokeh.themes import Theme
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from cangauge._files import file_sha256, text_sha256
from cangauge._text import duration, is_numeric, number, significant, span
from cangauge._version import __version__
from cangauge.bus.recording import CaptureSamples
from cangauge.extras.report.charts import MAX_POINTS, Figure
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

_RECONSTRUCTION: Final = (
    "This is a reconstruction: the log was computed from a published equation and published"
    " coefficients. It is not a recording of a car."
)
_TEMPLATES: Final = Path(__file__).with_name("templates")


@dataclass(frozen=True)
class Tile:
    """One figure of the summary."""

    label: str
    value: str
    hint: str = ""


@dataclass(frozen=True)
class Table:
    """A table of texts; columns of numbers are set flush right."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    @property
    def is_numeric(self) -> list[bool]:
        """Whether each column holds nothing but numbers."""
        columns = list(zip(*self.rows, strict=True)) or [()] * len(self.head)
        return [is_numeric(column) for column in columns]


Block = str | Table | Figure | Sequence[str] | Sequence[Figure]
"""A paragraph, a table, a figure, a list of remarks, or figures side by side."""


def joined(names: Sequence[str], at_most: int = 3) -> str:
    """Return names for a title: the first few, and how many more there are."""
    if len(names) <= at_most:
        return ", ".join(names)
    return f"{', '.join(names[: at_most - 1])} and {len(names) - at_most + 1} more"


_PAGE: Final = "page.html.j2"
_ENVIRONMENT: Final = Environment(
    loader=FileSystemLoader(_TEMPLATES),
    autoescape=select_autoescape(["html.j2"]),  # the others give plain text, escaped there
    undefined=StrictUndefined,
    extensions=["jinja2.ext.do"],
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.globals |= {"Table": Table, "Tile": Tile}
_ENVIRONMENT.filters |= {
    "duration": duration,
    "file_sha256": file_sha256,
    "joined": joined,
    "number": number,
    "significant": significant,
    "span": span,
}


@dataclass(frozen=True, eq=False)
class Page:
    """A whole report.

    Parameters
    ----------
    title : str
        Names the model or the logs; also the title of the browser's tab.
    lead : str
        The result in a sentence.
    subtitle : str
    tiles : sequence of Tile
    sections, folded : mapping of str to sequence of Block
        Parts by title; of a folded one only the title is seen until it is opened. A part without
        blocks is left out.
    model : Model, optional
    model_path : Path, optional
        The model's file; without one the model is hashed as it would be written.
    logs : sequence of Log or CaptureSamples
        Named with their SHA-256; a banner says so if one is a reconstruction.
    warnings : sequence of str
        Further banners at the top of the page.
    """

    title: str
    lead: str
    subtitle: str
    tiles: Sequence[Tile]
    sections: Mapping[str, Sequence[Block]]
    folded: Mapping[str, Sequence[Block]] = field(default_factory=dict)
    model: Model | None = None
    model_path: Path | None = None
    logs: Sequence[Log | CaptureSamples] = ()
    warnings: Sequence[str] = ()

    @classmethod
    def of(cls, template: str, values: Mapping[str, Any]) -> Page:
        """Return the page that a template describes: its variables are parameters of this class.

        Parameters
        ----------
        template : str
            File in the folder `templates`.
        values : mapping of str to object
            What it names.
        """
        described = vars(_ENVIRONMENT.get_template(template).make_module(dict(values)))
        names = {each.name for each in fields(cls)} & described.keys()
        return cls(**{name: described[name] for name in names})

    @property
    def figures(self) -> list[Figure]:
        """All figures in the order of the page."""
        parts = (*self.sections.values(), *self.folded.values())
        blocks = [block for part in parts for block in part]
        rows = [block if isinstance(block, list | tuple) else [block] for block in blocks]
        return [item for row in rows for item in row if isinstance(item, Figure)]

    def html(self) -> str:
        """Return the page as one self-contained text, dated now."""
        figures = self.figures
        script, drawn, bokeh_js = "", (), ""
        if figures:
            theme = Theme(filename=_TEMPLATES / "theme.yaml")
            script, drawn = components([item.plot for item in figures], theme=theme)
            # Only bokeh's core: its widgets, tables and formulae would add 2.7 MB.
            bokeh_js = Resources(mode="inline", components=["bokeh"]).render()
        texts = [text for log in self.logs for text in (log.name, log.source, *log.remarks)]
        is_reconstruction = any("reconstruction" in text.lower() for text in texts)
        parts = [
            (title, blocks, is_folded)
            for of, is_folded in ((self.sections, False), (self.folded, True))
            for title, blocks in of.items()
            if blocks
        ]
        return _ENVIRONMENT.get_template(_PAGE).render(
            page=self,
            parts=parts,
            inputs=self._inputs(),
            banners=[*([_RECONSTRUCTION] if is_reconstruction else []), *self.warnings],
            plots=dict(zip(figures, drawn, strict=True)),
            style=(_TEMPLATES / "page.css").read_text(encoding="utf-8"),
            bokeh_js=bokeh_js,
            bokeh_script=script,
            version=__version__,
            made=datetime.now(UTC),
            max_points=MAX_POINTS,
        )

    def _inputs(self) -> list[tuple[str, str, str | None]]:
        """Return role, name and SHA-256 of the inputs; None if a log is not a single file."""
        logs = [("log", log.name, file_sha256(log.source)) for log in self.logs]
        if self.model is None:
            return logs
        path = self.model_path
        sha256 = text_sha256(self.model.to_json()) if path is None else file_sha256(path)
        return [("model", self.model.name, sha256), *logs]
