"""The frame of every report: one HTML file with tiles, tables and figures, and no network.

Scripts and styles stand in the page, and its content security policy forbids it to load anything,
so that a report looks the same in a workshop without network and in ten years.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from bokeh.document import Document
from bokeh.embed import components
from bokeh.resources import Resources

from cangauge import __version__
from cangauge.report.decimate import POINTS_AT_MOST
from cangauge.report.page_style import FRAME, STYLE, THEME


@dataclass(frozen=True)
class Tile:
    """One figure of the summary."""

    label: str
    value: str
    hint: str = ""


@dataclass(frozen=True)
class Table:
    """A table of texts; a column that holds nothing but numbers is set flush right."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True, eq=False)
class Figure:
    """A drawing with its title above and a sentence below that says what to see."""

    title: str
    plot: Any
    """A bokeh model (bokeh ships no types that mypy could follow)."""
    see: str


@dataclass(frozen=True, eq=False)
class Beside:
    """Figures side by side."""

    figures: Sequence[Figure]


@dataclass(frozen=True)
class Paragraph:
    """Plain text."""

    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of remarks."""

    items: Sequence[str]


Block = Table | Figure | Beside | Paragraph | Bullets


@dataclass(frozen=True, eq=False)
class Section:
    """A titled part of the page."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True, eq=False)
class Page:
    """A whole report."""

    title: str
    subtitle: str
    tiles: Sequence[Tile]
    sections: Sequence[Section]
    banners: Sequence[str] = field(default=())
    """What the reader must know before anything else, such as that a log is a reconstruction."""


def render(page: Page) -> str:
    """Return the page as one self-contained HTML text."""
    figures = [item for section in page.sections for item in _figures(section)]
    plots = {f"f{number}": item.plot for number, item in enumerate(figures)}
    _gather(list(plots.values()))
    script, divs = components(plots, theme=THEME) if plots else ("", {})
    # Only bokeh's core is needed: its widgets, tables and formulae would add 2.7 MB.
    bokeh = Resources(mode="inline", components=["bokeh"]).render() if plots else ""
    drawn = {id(item): divs[f"f{number}"] for number, item in enumerate(figures)}
    body = "\n".join(
        _section(section, number, drawn) for number, section in enumerate(page.sections)
    )
    links = " ".join(  # a space to break the line at
        f'<a href="#s{number}">{escape(section.title)}</a>'
        for number, section in enumerate(page.sections)
    )
    banners = "".join(f'<p class="banner">{escape(text)}</p>' for text in page.banners)
    return FRAME.format(
        title=escape(page.title),
        subtitle=escape(page.subtitle),
        style=STYLE,
        bokeh=bokeh,
        banners=banners,
        tiles="".join(_tile(tile) for tile in page.tiles),
        links=links,
        body=body,
        script=script,
        version=escape(__version__),
        points=POINTS_AT_MOST,
    )


def _gather(plots: Sequence[Any]) -> None:
    """Put drawings into one document, which bokeh would search anew after each of them."""
    if any(plot.document is not None for plot in plots):
        return  # rendered before
    document = Document()
    with document.models.freeze():
        for plot in plots:
            document.add_root(plot)


def reconstruction_banners(*texts: str) -> list[str]:
    """Return the banner to show if a name, source or remark speaks of a reconstruction."""
    if not any("reconstruction" in text.lower() for text in texts):
        return []
    return [
        "This is a reconstruction: the log was computed from a published equation and published"
        " coefficients. It is not a recording of a car."
    ]


def _figures(section: Section) -> list[Figure]:
    found: list[Figure] = []
    for block in section.blocks:
        if isinstance(block, Figure):
            found.append(block)
        elif isinstance(block, Beside):
            found.extend(block.figures)
    return found


def _section(section: Section, number: int, drawn: dict[int, str]) -> str:
    blocks = "\n".join(_block(block, drawn) for block in section.blocks)
    return f'<section id="s{number}"><h2>{escape(section.title)}</h2>\n{blocks}\n</section>'


def _block(block: Block, drawn: dict[int, str]) -> str:
    match block:
        case Figure():
            return _figure(block, drawn)
        case Beside():
            return f'<div class="beside">{"".join(_figure(f, drawn) for f in block.figures)}</div>'
        case Table():
            return _table(block)
        case Paragraph():
            return f"<p>{escape(block.text)}</p>"
        case Bullets():
            return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in block.items) + "</ul>"


def _figure(figure: Figure, drawn: dict[int, str]) -> str:
    return (
        f"<figure><h3>{escape(figure.title)}</h3>{drawn[id(figure)]}"
        f"<figcaption>{escape(figure.see)}</figcaption></figure>"
    )


def _tile(tile: Tile) -> str:
    hint = f"<small>{escape(tile.hint)}</small>" if tile.hint else ""
    return f"<div><span>{escape(tile.label)}</span><b>{escape(tile.value)}</b>{hint}</div>"


_NUMBER = re.compile(r"[−+-]?[\d.,]+([eE][+−-]?\d+)?( ?[%Ω])?|–|")


def _table(table: Table) -> str:
    columns = list(zip(*table.rows, strict=True)) or [()] * len(table.head)
    flush = [
        ' class="n"' if column and all(map(_NUMBER.fullmatch, column)) else "" for column in columns
    ]
    head = "".join(f"<th{c}>{escape(text)}</th>" for c, text in zip(flush, table.head, strict=True))
    rows = "".join(
        "<tr>"
        + "".join(f"<td{c}>{escape(text)}</td>" for c, text in zip(flush, row, strict=True))
        + "</tr>"
        for row in table.rows
    )
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
        f"</div>{note}"
    )
