"""Results as self-contained HTML pages.

`fit.fit_page`, `estimate.estimate_page`, `diagnosis.gap_page` and `check.check_page` return a
`page.Page`; `page.render` writes it as HTML, and its `figures` are bokeh figures for a notebook.
The package imports nothing, since importing bokeh takes half a second.
"""
