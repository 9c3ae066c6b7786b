"""How a report looks: style sheet, frame of the HTML, theme of the drawings."""

from __future__ import annotations

from bokeh.themes import Theme

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
