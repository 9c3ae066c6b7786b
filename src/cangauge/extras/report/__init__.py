"""Results as self-contained HTML pages.

`fit.fit_page`, `estimate.estimate_page` and `diagnosis.gap_page` return a
`page.Page`; `page.render` writes it as HTML, and its `figures` are bokeh figures for a notebook.
The package imports nothing, since importing bokeh takes half a second.
"""
