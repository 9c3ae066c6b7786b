"""The last step of every reader: missing values, units, order of time → Log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.logs.file_content import FileContent
from cangauge.logs.log import Log, TemperatureSource
from cangauge.logs.units import refuse_wrong_units

REQUIRED: Final = ("time_s", "current_a", "voltage_v", "temperature_c")
MAX_MISSING_SHARE: Final = 0.05
"""More incomplete rows than this are an error even where dropping them is the rule."""


@dataclass(slots=True)
class DraftLog:
    """What a reader found in a file, before it is checked.

    Parameters
    ----------
    content : FileContent
        The file.
    values : dict of str to array of shape (n,)
        `time_s`, `current_a` (positive = discharge), `voltage_v`, `temperature_c` and maybe
        `soc_pct`, in canonical units, NaN where missing.
    labels : dict of str to str
        Heading in the file by field, for messages.
    temperature_source : str
        What the temperature was measured on.
    drop_incomplete : bool
        Whether rows that lack a required value are dropped (with a remark) or an error.
    sign_unknown : bool
        Whether the format does not say which way it counts current.
    remarks : list of str
        What the reader changed or noticed.
    """

    content: FileContent
    values: dict[str, FloatArray]
    labels: dict[str, str] = field(default_factory=dict)
    temperature_source: TemperatureSource = "unknown"
    drop_incomplete: bool = False
    sign_unknown: bool = False
    remarks: list[str] = field(default_factory=list)

    def to_log(self, temperature_c: float | None = None) -> Log:
        """Check the draft and return it as a Log.

        Rows whose time stamp equals the one before are dropped (the first stays), with a remark.

        Parameters
        ----------
        temperature_c : float, optional
            Constant temperature [°C] to use, whatever the file says.

        Raises
        ------
        InputError
            No temperature, missing or infinite values, wrong units, time that runs backwards.
        """
        self._settle_temperature(temperature_c)
        self._settle_missing()
        self._settle_time()
        self.remarks.extend(
            refuse_wrong_units(self.values, source=self.content.path, labels=self.labels)
        )
        return Log(
            **self.values,
            name=self.content.stem,
            source=str(self.content.path),
            temperature_source=self.temperature_source,
            remarks=(*self.content.remarks, *self.remarks),
        )

    def require(self, *fields: str, headings: Sequence[str]) -> None:
        """Raise InputError if one of these fields was not found under any heading."""
        for name in fields:
            if name not in self.values:
                shown = ", ".join(headings[:12]) + (", …" if len(headings) > 12 else "")
                raise self._error(
                    name,
                    f"no column of this file gives it (it has: {shown})",
                    None,
                    cure="check the export, or make a canonical log of it",
                )

    def keep(self, rows: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> None:
        """Keep only the rows of a mask of shape (n,)."""
        self.values = {name: values[rows] for name, values in self.values.items()}

    def _settle_temperature(self, given_c: float | None) -> None:
        if given_c is not None:
            replaced = " in place of the file's" if "temperature_c" in self.values else ""
            self.remarks.append(f"temperature {given_c:g} °C as given{replaced}")
            self.values["temperature_c"] = np.full(self.values["time_s"].size, given_c)
            self.temperature_source = "unknown"
        elif "temperature_c" not in self.values:
            raise self._error(
                "temperature_c",
                "the file holds no temperature",
                None,
                cure="add this column [°C], or give a constant with --temperature",
            )

    def _settle_missing(self) -> None:
        soc = self.values.get("soc_pct")
        if soc is not None and np.isinf(soc).any():
            row = int(np.flatnonzero(np.isinf(soc))[0])
            raise self._error("soc_pct", f"row {row + 1} is not finite", float(soc[row]))
        incomplete = np.zeros(self.values["time_s"].size, dtype=bool)
        for name in REQUIRED:
            values = self.values[name]
            bad = ~np.isfinite(values)
            infinite = np.isinf(values)
            if infinite.any() or (bad.any() and not self.drop_incomplete):
                rows = np.flatnonzero(infinite if infinite.any() else bad)
                raise self._error(
                    name,
                    f"row {rows[0] + 1} holds no number ({rows.size} such rows of {bad.size})",
                    float(values[rows[0]]),
                    cure="fill or drop these rows in the file",
                )
            if bad.all():
                raise self._error(name, "the column is empty", None, cure="check the export")
            incomplete |= bad
        count = int(incomplete.sum())
        if not count:
            return
        if count > MAX_MISSING_SHARE * incomplete.size:
            raise self._error(
                None,
                f"{count} of {incomplete.size} rows lack time, current, voltage or temperature",
                None,
                cure="check the export",
            )
        self.remarks.append(
            f"{count} rows without time, current, voltage or temperature dropped"
            f" (the first is row {int(np.flatnonzero(incomplete)[0]) + 1})"
        )
        self.keep(~incomplete)

    def _settle_time(self) -> None:
        time = self.values["time_s"]
        step = np.diff(time)
        back = np.flatnonzero(step < 0.0)
        if back.size:
            row = int(back[0]) + 1
            raise self._error(
                "time_s",
                f"time runs backwards at row {row + 1} ({back.size} such rows;"
                f" {time[row - 1]:.6f} s comes before)",
                float(time[row]),
                cure="sort the rows by time, or split the file into one log each",
            )
        same = np.flatnonzero(step == 0.0)
        if same.size:
            self.remarks.append(
                f"{same.size} rows with the time stamp of the row before dropped"
                f" (the first is row {int(same[0]) + 2})"
            )
            keep = np.ones(time.size, dtype=bool)
            keep[same + 1] = False
            self.keep(keep)

    def _error(
        self, name: str | None, problem: str, value: float | None, cure: str | None = None
    ) -> InputError:
        return InputError(
            problem,
            source=self.content.path,
            field=None if name is None else self.labels.get(name, name),
            value=value,
            cure=cure,
        )
