"""The columns that a reader found, and the checks that make a log of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from cangauge._text import counted
from cangauge._typing import BoolArray, FloatArray
from cangauge.errors import InputError
from cangauge.logs.agreement import agreeing
from cangauge.logs.columns import shown_headings
from cangauge.logs.headings import Rank, cell_number, meaning_of
from cangauge.logs.log import Log
from cangauge.logs.quantities import REQUIRED, known_temperature_source
from cangauge.logs.sign import Sign, SignSource
from cangauge.settings import TemperatureSource
from cangauge.types import SOC_WITHIN_PCT

BESIDES: Final = "#"
"""Begins the name of a value that is none of the log's, such as one that may count the charge [Ah];
its heading follows."""
MAX_INCOMPLETE: Final = 0.05
"""Largest fraction of incomplete rows that are dropped [-]: beyond it the export is damaged, or its
rows hold only what changed."""
_COARSE_S: Final = 2.0
"""Interval above which the current between rows is a gap [s]."""
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
    sign_by : {"format", "user", "data"}
        Source of the sign of the current.
    negated : bool
        The file stores discharge as negative.
    in_seconds, stated
        Whether a unit of time is stated, and columns whose unit the user states; see `agreeing`.
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
    sign_by: SignSource = "format"
    negated: bool = False
    in_seconds: bool | None = False
    stated: set[str] = field(default_factory=set)
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
        self.values["temperature_c"] = probes_c[0]
        if len(probes_c) == 1:
            return
        values = np.vstack(probes_c)
        values[np.isinf(values)] = np.nan
        known = np.isfinite(values).any(axis=0)
        median = np.full(known.size, np.nan)
        median[known] = np.nanmedian(values[:, known], axis=0)
        self.values["temperature_c"] = median
        apart = np.fmax.reduce(values) - np.fmin.reduce(values) > _PROBES_APART_K
        if apart.any():
            row = int(np.argmax(apart))
            shown = " and ".join(f"{value:.4g}" for value in values[:, row])
            apart_c = f"{' and '.join(names)} are {shown} °C in row {row + 1}"
            cure = "one of the probes fails; name the good ones with --columns temperature=…"
            self.remarks.append(f"temperature: {apart_c}: {cure}")

    def log(
        self,
        temperature_c: float | None = None,
        temperature_source: TemperatureSource | None = None,
        sign: Sign | None = None,
    ) -> Log:
        """Check all values and return the log, with its sign of current found or confirmed.

        Rows that lack a value or repeat the time stamp of the row before are dropped, with a
        remark. Arguments and errors as of `cangauge.read_log`.
        """
        if sign is not None:
            if sign not in {"charge", "discharge"}:
                cure = "say what a positive current does: charge or discharge"
                raise InputError("not a sign", field="--sign", value=sign, cure=cure)
            if (sign == "charge") is not self.negated:
                self.negate_current(f"positive {sign}s in the file, as stated")
            self.sign_by = "user"
        if not self.values["time_s"].size:
            raise InputError("the log holds no rows", source=self.where, cure="check the export")
        self._remark_ignored()
        self._set_temperature(temperature_c)
        if temperature_source is not None:
            self.temperature_source = known_temperature_source(temperature_source)
        if "soc_pct" in self.values:
            self.values["soc_pct"][np.isinf(self.values["soc_pct"])] = np.nan
        self._drop_incomplete()
        self._drop_repeated()
        self._remark_values()
        for values in self.values.values():
            values.flags.writeable = False  # the log need not copy them
        columns = {name: each for name, each in self.values.items() if name[:1] != BESIDES}
        log = Log(
            **columns,
            name=self.name,
            source=self.source,
            temperature_source=self.temperature_source,
            remarks=tuple(self.remarks),
            assumed=tuple(self.assumed),
        )
        return agreeing(
            log,
            labels=self.labels,
            in_seconds=self.in_seconds,
            stated=self.stated,
            sign_by=self.sign_by,
            counters={name[1:]: each for name, each in self.values.items() if name not in columns},
        )

    def _remark_ignored(self) -> None:
        cells = [name for name in self.ignored if cell_number(name) is not None]
        if len(cells) > 1:  # `LogFile.cells`
            self.remarks.append(f"{len(cells)} cells: {cells[0]} … {cells[-1]}")
        ignored = [name for name in self.ignored if len(cells) < 2 or name not in cells]
        if ignored:
            shown = ", ".join(ignored[:6]) + (", …" if len(ignored) > 6 else "")
            self.remarks.append(f"{counted(len(ignored), 'other column')} ignored: {shown}")

    def _set_temperature(self, given_c: float | None) -> None:
        kind = "file" if self.source else "table"
        if given_c is not None:
            replaced = f" in place of the {kind}'s" if "temperature_c" in self.values else ""
            self.remarks.append(f"temperature {given_c:g} °C as given{replaced}")
            self.values["temperature_c"] = np.full(self.values["time_s"].size, float(given_c))
            self.labels["temperature_c"] = "--temperature"
            self.stated.add("temperature_c")
            self.temperature_source = "unknown"
        elif "temperature_c" not in self.values:
            found = f" (found: {shown_headings(self.headings)})" if self.headings else ""
            cure = "give a constant: --temperature 25"
            for text in reversed(self.ignored):
                meaning = meaning_of(text)
                if meaning and (meaning.quantity, meaning.rank) == ("temperature", Rank.GUESS):
                    cure = f"name its column: --columns 'temperature={text}'"
            raise self.error("temperature_c", f"the {kind} holds no temperature{found}", cure)

    def _drop_incomplete(self) -> None:
        lacks = {name: ~np.isfinite(self.values[name]) for name in REQUIRED}
        incomplete = np.any([*lacks.values()], axis=0)
        for name, rows in lacks.items():
            if rows.all():
                quantity = name.rpartition("_")[0]
                cure = f"name another one: --columns {quantity}=…"
                if name == "temperature_c":
                    cure = "give a constant: --temperature 25"
                raise self.error(name, "the column is empty", cure)
        count, row = int(incomplete.sum()), int(np.argmax(incomplete))
        lacking = "time, current, voltage or temperature"
        if count > MAX_INCOMPLETE * incomplete.size:
            name = next(name for name, rows in lacks.items() if rows[row])
            problem = f"{count} of {incomplete.size} rows lack {lacking}"
            cure = f"check the export: the first is row {row + 1}"
            if self.in_seconds is None:  # values hold for a second where rows hold only changes
                option = f"--columns 'time={self.labels['time_s']}[ms]'"
                cure += f"; if its time is in milliseconds, state it: {option}"
            raise self.error(name, problem, cure)
        self.keep(~incomplete, f"without {lacking} dropped (the first is row {row + 1})")

    def _drop_repeated(self) -> None:
        time = self.values["time_s"]
        if np.all(time[1:] > time[:-1]):
            return
        step = np.diff(time, prepend=-np.inf)
        back = np.flatnonzero(step < 0.0)
        if back.size:
            row = int(back[0])
            before = f"the row before has {time[row - 1]:.6f} s"
            problem = f"time runs backwards at row {row + 1} ({back.size} such rows; {before})"
            cure = "split the file there into one log each: the clock was set back or restarted"
            cure = "sort the rows by time" if 2 * back.size > step.size else cure
            raise self.error("time_s", problem, cure, float(time[row]))
        repeats = step == 0.0
        row = int(np.argmax(repeats))
        differs = np.any([np.diff(v, prepend=v[0]) != 0.0 for v in self.values.values()], axis=0)
        count = int(np.sum(repeats & differs))
        apart_s = float(np.median(np.diff(time[~repeats]))) if count else 0.0
        if count > MAX_INCOMPLETE * time.size and apart_s > _COARSE_S:  # stamps of whole minutes
            problem = f"{count} of {time.size} rows have the time stamp of the row before"
            cure = f"export fractions of a second, or one row per time: the first is row {row + 1}"
            raise self.error("time_s", problem, cure)
        remark = f"with the time stamp of the row before dropped (the first is row {row + 1})"
        self.keep(~repeats, remark)

    def _remark_values(self) -> None:
        """Remark on a SoC that leaves 0–100 %, and on rows without voltage."""
        soc = self.values.get("soc_pct", np.empty(0))
        least, most = SOC_WITHIN_PCT
        wrong = (soc < least) | (soc > most)
        if wrong.any():
            shown = f"{float(np.nanmin(soc)):.4g} … {float(np.nanmax(soc)):.4g} %"
            problem = f"SoC {shown} is not within 0–100 % in {counted(int(wrong.sum()), 'row')}"
            self.remarks.append(f"{problem}: its scale or offset is wrong, and it is no start")
        off = self.values["voltage_v"] == 0.0
        if off.any():
            row = int(np.argmax(off))
            rows = counted(int(off.sum()), "row")
            self.remarks.append(f"0 V in {rows} (the first is row {row + 1}): no voltage was read")

    @property
    def where(self) -> str:
        """The file, or the name of a table in memory, for messages."""
        return self.source or self.name

    def error(self, name: str, problem: str, cure: str, value: object = None) -> InputError:
        """Return the error for a column, by its canonical name or, of others, its heading."""
        label = self.labels.get(name, name)
        return InputError(problem, source=self.where, field=label, value=value, cure=cure)
