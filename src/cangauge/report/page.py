"""How a report looks: style sheet, frame of the HTML, theme of the drawings.

The frame of every report: one HTML file with tiles, tables and figures, and no network.

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
from bokeh.themes import Theme

from cangauge import __version__
from cangauge.report.charts import POINTS_AT_MOST

# --- How a report looks: style sheet, frame of the HTML, theme of the drawings

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"

THEME = Theme(
    json={
        "attrs": {
            "Plot": {
                "background_fill_color": "#ffffff",
                "border_fill_color": "#ffffff",
                "outline_line_color": "#d5dae1",
            },
            "Axis": {
                "axis_label_text_font": FONT,
                "axis_label_text_font_size": "13px",
                "axis_label_text_font_style": "normal",
                "axis_label_text_color": "#3b4654",
                "major_label_text_font": FONT,
                "major_label_text_font_size": "12px",
                "major_label_text_color": "#3b4654",
                "axis_line_color": "#aab3bf",
                "major_tick_line_color": "#aab3bf",
                "minor_tick_line_color": None,
            },
            "Grid": {"grid_line_color": "#edf0f4"},
            "Legend": {
                "label_text_font": FONT,
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

STYLE = f"""
:root {{ color-scheme: light; }}
* {{ box-sizing: border-box; }}
body {{ margin: 0 auto; max-width: 1180px; padding: 28px 24px 48px; background: #fff;
  color: #1c2430; font: 15px/1.5 {FONT}; }}
h1 {{ font-size: 26px; line-height: 1.25; margin: 0 0 4px; }}
h2 {{ font-size: 19px; margin: 36px 0 10px; padding-top: 14px; border-top: 1px solid #dfe4ea; }}
h3 {{ font-size: 15px; margin: 0 0 4px; }}
.subtitle {{ color: #55606e; margin: 0 0 14px; }}
.banner {{ background: #fff4d6; border-left: 5px solid #e0a100; padding: 10px 14px; margin: 12px 0;
  font-weight: 600; }}
.tiles {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(148px, 1fr)); gap: 10px; }}
.tiles div {{ background: #f5f7fa; border-radius: 8px; padding: 10px 13px; }}
.tiles span, .tiles small {{ display: block; color: #55606e; font-size: 12.5px;
  line-height: 1.35; }}
.tiles b {{ display: block; font-size: 17px; white-space: nowrap;
  font-variant-numeric: tabular-nums; margin: 2px 0; }}
nav {{ margin: 16px 0 0; font-size: 13.5px; }}
nav a {{ color: #0b62a4; text-decoration: none; margin-right: 16px; white-space: nowrap; }}
figure {{ margin: 14px 0 22px; break-inside: avoid; }}
figcaption, .note {{ color: #55606e; font-size: 13.5px; margin: 4px 0 0; }}
.beside {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(400px, 1fr)); gap: 22px; }}
.beside figure {{ min-width: 0; }}
.scroll {{ overflow-x: auto; margin: 12px 0 4px; }}
table {{ border-collapse: collapse; font-size: 13.5px; font-variant-numeric: tabular-nums; }}
th, td {{ text-align: left; padding: 4px 14px 4px 0; border-bottom: 1px solid #e6eaef;
  vertical-align: top; }}
th {{ color: #55606e; font-weight: 600; vertical-align: bottom; }}
th.n, td.n {{ text-align: right; }}
ul {{ padding-left: 20px; }}
footer {{ margin-top: 40px; color: #77818e; font-size: 12.5px; }}
@media print {{
  body {{ max-width: none; padding: 0; font-size: 11pt; }}
  nav {{ display: none; }}
  figure, tr {{ break-inside: avoid; }}
  h2, h3 {{ break-after: avoid; }}
  .tiles div {{ border: 1px solid #dfe4ea; }}
}}
"""

FRAME = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; \
script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; \
font-src data:">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
{bokeh}
</head>
<body>
<header>
<h1>{title}</h1>
<p class="subtitle">{subtitle}</p>
{banners}
<div class="tiles">{tiles}</div>
<nav>{links}</nav>
</header>
{body}
<footer>Made by cangauge {version}. Positive current discharges. Lines longer than {points} points
are thinned for drawing to the smallest and largest value of each short stretch, clouds evenly; all
figures in tiles and tables come from all rows. The time axes move together; click a legend entry
to hide its line.</footer>
{script}
</body>
</html>
"""


# --- The frame of every report: one HTML file with tiles, tables and figures, and no network


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
