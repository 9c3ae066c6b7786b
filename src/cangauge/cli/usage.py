"""Wrong usage (an option that there is not, an argument that misses) in one line."""

from __future__ import annotations

from typing import Any, Final

import typer

# typer brings its own copy of click: the base of its errors is reached through the one it exports.
UsageError: Final[type[Exception]] = typer.BadParameter.__mro__[1]


def usage_line(error: Any) -> str:
    """Return what is wrong with the command line and which help tells more; "" if help was shown.

    Parameters
    ----------
    error : UsageError
    """
    text = " ".join(error.format_message().split()).replace("Input should be", "must be")
    if not text or (error.ctx is not None and not error.ctx.args and "--help" in text):
        return ""
    if not text[1:2].isupper():
        text = text[0].lower() + text[1:]
    command = "cangauge"
    if error.ctx is not None and error.ctx.parent is not None:
        command = f"cangauge {error.ctx.info_name}"
    return f"error: {text.rstrip('.')}; see `{command} --help`"
