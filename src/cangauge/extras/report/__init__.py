"""Results as self-contained HTML pages.

Each module returns a `page.Page`, whose `html()` is the file and whose `figures` are bokeh figures
for a notebook. The package imports nothing, since importing bokeh takes half a second.
"""
