"""Columns that a reader found, and the checks that make a log of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from cangauge._text import counted
from cangauge._typing import BoolArray, FloatArray
from cangauge.errors import InputError, require_number
from cangauge.logs.column_map import shown_headings
from cangauge.logs.headings import cell_number
from cangauge.logs.log import NEEDED, Log, refuse_bad_rows
from cangauge.logs.sign import resolve_sign
from cangauge.logs.units import (
    COLDEST_C,
    HOTTEST_C,
    REQUIRED,
    TemperatureSource,
    known_temperature_source,
    refuse_wrong_units,
)

Sign = Literal["charge", "discharge"]
"""What a positive current in the file does."""

MAX_INCOMPLETE: Final = 0.05
"""Largest fraction of incomplete rows that are dropped [-]: beyond it the export is damaged, or its
rows hold only what changed."""
_PROBES_APART_K: Final = 20.0
"""Difference of a pack's temperature probes from which one of them fails [K]: packs are cooled so
that their cells differ by less than 5 K (Pesaran, J. Power Sources 110, 2002)."""


@dataclass(slots=True)
class DraftLog:
    """Columns of a log as a reader found them, by canonical field; NaN where missing.

    Parameters
    ----------
    name, source : str
        Short name, and path of the file ("" for a table in memory).
    values, labels : dict
        Arrays of shape (n,) in canonical units (positive current discharges), and headings.
    temperature_source : str
        Location of the temperature sensor.
    sign_unknown, negated : bool
        The format does not define the sign; the file stores discharge as negative.
    assumed, remarks : list of str
        How the columns were understood; changes and findings.
    headings, ignored : tuple of str
        All columns of the file, and those that hold no quantity of the log, for messages.
    """

    name: str
    source: str
    values: dict[str, FloatArray] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    temperature_source: TemperatureSource = "unknown"
    sign_unknown: bool = False
    negated: bool = False
    assumed: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    headings: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()

    def keep(self, rows: BoolArray, remark: str) -> None:
        """Keep the rows of a mask of shape (n,); remark on the number of the others, if any."""
        dropped = int(np.sum(~rows))
        if dropped:
            self.values = {name: values[rows] for name, values in self.values.items()}
            self.remarks.append(f"{counted(dropped, 'row')} {remark}")

    def negate_current(self, because: str) -> None:
        """Invert the sign of the stored current, with a remark."""
        self.values["current_a"] = 0.0 - self.values["current_a"]  # no -0.0
        self.negated = not self.negated
        self.remarks.append(f"current negated: {because}")

    def take_probes(self, names: Sequence[str], probes_c: Sequence[FloatArray]) -> None:
        """Take the median of temperature probes [°C], shape (n,) each; remark where they differ."""
        values = np.vstack([np.where(np.isfinite(each), each, np.nan) for each in probes_c])
        rows = np.flatnonzero(np.isfinite(values).any(axis=0))
        known, median = values[:, rows], np.full(values.shape[1], np.nan)
        median[rows] = np.nanmedian(known, axis=0)
        self.values["temperature_c"] = median
        apart = np.nanmax(known, axis=0) - np.nanmin(known, axis=0) > _PROBES_APART_K
        if apart.any():
            row = int(rows[np.argmax(apart)])
            shown = " and ".join(f"{value:.4g}" for value in values[:, row])
            self.remarks.append(
                f"temperature: {' and '.join(names)} are {shown} °C in row {row + 1}: one of the"
                " probes fails; name the good ones with --columns temperature=…"
            )

    def to_log(
        self,
        temperature_c: float | None = None,
        temperature_source: TemperatureSource | None = None,
        sign: Sign | None = None,
        used: Sequence[str] = (),
    ) -> Log:
        """Check all values and return the log; see `read_log` for the arguments and errors.

        Rows that lack a value or repeat the time stamp of the row before are dropped, with a
        remark. `used` are columns that the caller reads besides.
        """
        if sign is not None:
            self._state_sign(sign)
        self._remark_ignored([name for name in self.ignored if name not in used])
        self._set_temperature(temperature_c)
        if temperature_source is not None:
            self.temperature_source = known_temperature_source(temperature_source)
        if "soc_pct" in self.values:
            self.values["soc_pct"][np.isinf(self.values["soc_pct"])] = np.nan
        where = self.source or self.name
        self._drop_rows()
        refuse_bad_rows(self.values, where, self.labels)
        for values in self.values.values():
            values.flags.writeable = False  # the log need not copy them
        self.remarks.extend(refuse_wrong_units(self.values, source=where, labels=self.labels))
        log = Log(
            **self.values,
            name=self.name,
            source=self.source,
            temperature_source=self.temperature_source,
            remarks=tuple(self.remarks),
            assumed=tuple(self.assumed),
        )
        return resolve_sign(log, is_unknown=self.sign_unknown, is_stated=sign is not None)

    def _state_sign(self, sign: Sign) -> None:
        if sign not in {"charge", "discharge"}:
            cure = "say what a positive current does: charge or discharge"
            raise InputError("not a sign", field="--sign", value=sign, cure=cure)
        if (sign == "charge") is not self.negated:
            self.negate_current(f"positive {sign}s in the file, as stated")
        self.sign_unknown = False

    def _remark_ignored(self, names: list[str]) -> None:
        cells = [name for name in names if cell_number(name) is not None]
        if len(cells) > 1:  # `read_cells`
            self.remarks.append(f"{len(cells)} cells: {cells[0]} … {cells[-1]}")
            names = [name for name in names if name not in cells]
        if names:
            shown = ", ".join(names[:6]) + (", …" if len(names) > 6 else "")
            self.remarks.append(f"{counted(len(names), 'other column')} ignored: {shown}")

    def _set_temperature(self, given_c: float | None) -> None:
        kind = "file" if self.source else "table"
        if given_c is not None:
            require_number(given_c, "--temperature")
            if not COLDEST_C <= given_c <= HOTTEST_C:
                problem = f"must lie within {COLDEST_C:g} … {HOTTEST_C:g} °C"
                raise InputError(problem, field="--temperature", value=given_c)
            replaced = f" in place of the {kind}'s" if "temperature_c" in self.values else ""
            self.remarks.append(f"temperature {given_c:g} °C as given{replaced}")
            self.values["temperature_c"] = np.full(self.values["time_s"].size, float(given_c))
            self.temperature_source = "unknown"
        elif "temperature_c" not in self.values:
            found = f" (found: {shown_headings(self.headings)})" if self.headings else ""
            named = "name its column with --columns temperature=…" if found else "add this column"
            option = "--temperature" if self.source else "temperature_c"
            cure = f"{named} [°C], or give a constant with {option}"
            problem, where = f"the {kind} holds no temperature{found}", self.source or self.name
            raise InputError(problem, source=where, field="temperature_c", cure=cure)

    def _drop_rows(self) -> None:
        """Drop a few incomplete rows, and those that repeat a time stamp."""

        def drop(rows: BoolArray, what: str) -> None:
            self.keep(~rows, f"{what} dropped (the first is row {int(np.argmax(rows)) + 1})")

        lacks = np.any([~np.isfinite(self.values[name]) for name in REQUIRED], axis=0)
        if 0 < lacks.sum() <= MAX_INCOMPLETE * lacks.size:
            drop(lacks, f"without {NEEDED}")
        if (again := np.diff(self.values["time_s"], prepend=-np.inf) == 0.0).any():
            drop(again, "with the time stamp of the row before")
