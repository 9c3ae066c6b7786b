"""Wrong usage (an option that there is not, an argument that misses): in one line, for `--json`."""

from __future__ import annotations

from typing import Any, Final

import typer

from cangauge.errors import CangaugeError

# typer brings its own copy of click: the base of its errors is reached through the one it exports.
UsageError: Final[type[Exception]] = typer.BadParameter.__mro__[1]


def usage_line(error: Any) -> str:
    """Return what is wrong with the command line and which help tells more; "" if help was shown.

    Parameters
    ----------
    error : UsageError
    """
    text = " ".join(error.format_message().split()).replace("Input should be", "must be")
    if not text or type(error).__name__ == "NoArgsIsHelpError":
        return ""
    if not text[1:2].isupper():
        text = text[0].lower() + text[1:]
    command = "cangauge"
    if error.ctx is not None and error.ctx.parent is not None:
        command = f"cangauge {error.ctx.info_name}"
    return f"error: {text.rstrip('.')}; see `{command} --help`"


def usage_dict(error: Any) -> dict[str, Any]:
    """Return what `CangaugeError.to_dict` does; the option or argument is the field.

    Parameters
    ----------
    error : UsageError
    """
    field = getattr(error, "option_name", None)
    parameter = getattr(error, "param", None)
    if field is None and parameter is not None:
        # An argument has no spelling of its own: help shows it by its metavar.
        is_option = parameter.param_type_name == "option"
        field = "/".join(parameter.opts) if is_option else parameter.metavar or parameter.name
    return {**CangaugeError(usage_line(error).removeprefix("error: ")).to_dict(), "field": field}
