"""Numbers and foreign text, the same in every message, report and table."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any, Final

NONE_KNOWN: Final = "–"
"""Shown in place of an unknown number."""
LEAST_KWH_WH: Final = 1000.0
"""Energies from here on are written in kWh [Wh]."""
LONGEST_WHOLE: Final = 1e6
"""Numbers from here on are written with a power of ten."""


def number(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Return a number with fixed decimals and its unit; a dash if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return NONE_KNOWN
    # "+ 0.0" turns −0.0 into 0.0.
    return _with_unit(f"{round(value, digits) + 0.0:.{digits}f}", unit)


def significant(value: float | None, digits: int = 4, unit: str = "") -> str:
    """Return a number with significant digits and its unit; a dash if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return NONE_KNOWN
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e+" in text and abs(value) < LONGEST_WHOLE:
        text = f"{float(text):.0f}"
    return _with_unit(text, unit)


def rounded(value: float, digits: int = 3) -> str:
    """Return a number with at most `digits` significant digits, without trailing zeros.

    Examples
    --------
    >>> rounded(3.0066, 2), rounded(1804.3)
    ('3', '1800')
    """
    return f"{float(f'{value:.{digits}g}'):.15g}".replace("-", "−")


def uncertain(value: float | None, std: float | None, unit: str = "") -> str:
    """Return a value with as many decimals as its standard deviation has with two digits.

    Examples
    --------
    >>> uncertain(199.3, 14.2, "A"), uncertain(9.613, 0.0418, "Wh")
    ('199 ± 14 A', '9.613 ± 0.042 Wh')
    """
    if value is None or std is None or not (math.isfinite(value) and 0.0 < std < math.inf):
        return f"{significant(value, 3)} ± {significant(std, 2, unit)}"
    decimals = max(0, 1 - math.floor(math.log10(std)))
    return f"{number(value, decimals)} ± {number(std, decimals, unit)}"


def energy_text(wh: float | None, std_wh: float | None) -> str:
    """Return an energy with its standard deviation, in kWh from 1 kWh on."""
    if wh is None or std_wh is None:
        return NONE_KNOWN
    if abs(wh) < LEAST_KWH_WH:
        return uncertain(wh, std_wh, "Wh")
    return uncertain(1e-3 * wh, 1e-3 * std_wh, "kWh")


def possible(current_a: float | None, std_a: float | None, unit: str = "") -> str:
    """Return a possible current; one without deviation is the largest that the model's logs had."""
    if current_a and std_a == 0.0:
        return f"at least {significant(current_a, 3, unit)}"
    return uncertain(current_a, std_a, unit)


def known_soc(soc_pct: float | None, std_pct: float | None, digits: int) -> str:
    """Return a SoC with its standard deviation, or that it is not known yet."""
    if soc_pct is None or not math.isfinite(soc_pct):
        return "not known yet"
    return f"{number(soc_pct, digits)} ± {number(std_pct, digits, '%')}"


def span(low: float, high: float, digits: int = 1, unit: str = "") -> str:
    """Return a range, such as "20.0 … 26.0 °C"."""
    return f"{number(low, digits)} … {number(high, digits)} {unit}".rstrip()


def counted(count: int, noun: str) -> str:
    """Return a number of things, such as "1 gap" or "3 gaps"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def duration(seconds: float) -> str:
    """Return a time span in seconds, minutes, hours or days."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    if seconds < 7200.0:
        return f"{seconds / 60.0:.1f} min"
    hours = seconds / 3600.0
    return f"{hours:.2f} h" if hours < 100.0 else f"{hours / 24.0:.1f} days"


_NUMBER: Final = re.compile(r"[−+-]?[\d.,]+([eE][+−-]?\d+)?( ?[%Ω])?|–|")


def is_numeric(column: Iterable[str]) -> bool:
    """Whether a table's column holds nothing but numbers: it is then set flush right."""
    cells = list(column)
    return bool(cells) and all(_NUMBER.fullmatch(cell) for cell in cells)


_NOT_FOR_TERMINALS: Final = frozenset((*range(0x20), *range(0x7F, 0xA0))) - {0x09, 0x0A}
"""Code points by which text controls a terminal: C0 without tab and newline, DEL, C1."""
_AS_TEXT: Final = {code: f"\\x{code:02x}" for code in _NOT_FOR_TERMINALS}
_AS_JSON: Final = {code: f"\\u{code:04x}" for code in _NOT_FOR_TERMINALS}


def printable(text: str) -> str:
    r"""Return text whose control characters are written out ("\x1b"), for terminals and journals.

    Names of files and signals, and what a server answers, may hold anything.
    """
    return text.translate(_AS_TEXT)


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: numpy's as Python's, NaN and infinities as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy, without its import
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def printable_json(text: str) -> str:
    r"""Return JSON whose control characters are escaped ("\u009b"), those beyond ASCII as well."""
    return text.translate(_AS_JSON)


def _with_unit(text: str, unit: str) -> str:
    text = text.replace("-", "−")
    return f"{text} {unit}" if unit else text
