"""The live page of a running service: its own process, fed through a pipe, read by browsers.

`launch` starts the process, `server` answers browsers, `history` keeps the rows, `comparison` holds
the residual against the model's stated error, `charts` describes the figures that `page` draws.
"""
