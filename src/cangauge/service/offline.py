"""Offline estimates of a recorded log or capture, and the table file that they go to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, cast

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.estimate.offline import EstimateTable, Scores, estimate_log, score
from cangauge.estimate.settings import EstimatorSettings
from cangauge.estimate.validity import Reason, Status, reason_name, reason_names
from cangauge.inference.rows import usual_gap_s
from cangauge.logs.log import Log
from cangauge.model.charge import counted_soc_pct
from cangauge.model.delay_line import GAP_S
from cangauge.model.model_file import Model
from cangauge.service.estimate_table import NUMBERS

if TYPE_CHECKING:
    from cangauge.bus.vehicle import Vehicle

LONGEST_GAP_S: Final = 3600.0
"""Upper limit of a gap that follows from a slow log's step [s]."""

PACK_VOLTAGE_MARGIN: Final = 0.2
"""Relative margin around the pseudo-OCV's range; a median voltage outside it is another pack's."""

DOUBTFUL_VALID: Final = 0.1
DOUBTFUL_COVER: Final = 0.5
"""Fractions of valid samples, and of reference SoC within ±2σ, below which to warn."""

Origin = Literal["given", "log", "voltage"]
"""Where the initial SoC comes from: an option, the log's soc_pct, the first voltages."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Samples of a capture: unlike a log's rows, they may lack voltage and temperature.

    Parameters
    ----------
    time_s : array of shape (n,)
        Time [s], not decreasing.
    current_a, voltage_v, temperature_c : array of shape (n,)
        Current [A] (positive = discharge), voltage [V] and temperature [°C], NaN where missing.
    soc_pct : array of shape (n,), optional
        Reference SoC [%], NaN where missing.
    name, source, temperature_source : str
    remarks : tuple of str
    """

    time_s: FloatArray
    current_a: FloatArray
    voltage_v: FloatArray
    temperature_c: FloatArray
    soc_pct: FloatArray | None
    name: str
    source: str
    temperature_source: str
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.time_s.size)

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time_s[-1] - self.time_s[0])

    def as_log(self) -> Log | None:
        """Return the rows with a voltage and a new time, at 0 °C; None if there are fewer than 2.

        Enough to check the sign of the current.
        """
        rows = np.isfinite(self.voltage_v)
        rows[1:] &= np.diff(self.time_s) > 0.0
        if rows.sum() < 2:
            return None
        return Log(
            time_s=self.time_s[rows],
            current_a=self.current_a[rows],
            voltage_v=self.voltage_v[rows],
            temperature_c=np.zeros(int(rows.sum())),
            soc_pct=None if self.soc_pct is None else self.soc_pct[rows],
            name=self.name,
            source=self.source,
        )


Recorded = Log | Recording


@dataclass(frozen=True, eq=False)
class RecordedEstimate:
    """Estimates of a recording, with all that a table, a report and a JSON object need.

    Parameters
    ----------
    recorded : Recorded
        n samples.
    table : EstimateTable
        n estimates.
    scores : Scores
    model : Model
    settings : EstimatorSettings
        As used.
    origin : {"given", "log", "voltage"}
        Source of the initial SoC.
    capture_facts : dict
        Time source and frame counts of a capture.
    """

    recorded: Recorded
    table: EstimateTable
    scores: Scores
    model: Model
    settings: EstimatorSettings = field(default_factory=EstimatorSettings)
    origin: Origin = "voltage"
    capture_facts: dict[str, Any] = field(default_factory=dict)

    @property
    def reason_shares(self) -> dict[str, float]:
        """Fraction of the samples with each reason that occurs."""
        shares = {
            reason_name(reason): float(np.mean((self.table.reasons & reason) != 0))
            for reason in Reason
        }
        return {name: share for name, share in shares.items() if share > 0.0}

    @property
    def warnings(self) -> list[str]:
        """What makes the estimate doubtful as a whole, a sentence each."""
        scores, found = self.scores, []
        if scores.valid_fraction < DOUBTFUL_VALID:
            reasons = reason_names(int(np.bitwise_or.reduce(self.table.reasons)))
            found.append(
                f"Only {100.0 * scores.valid_fraction:.0f} % of the estimates are valid"
                f" ({reasons}). Check that {self.model.name} is the model of this pack at these"
                " temperatures."
            )
        if scores.cover_2sigma is not None and scores.cover_2sigma < DOUBTFUL_COVER:
            found.append(
                f"The reference SoC lies within ±2σ in only {100.0 * scores.cover_2sigma:.0f} % of"
                f" the samples. Check that {self.model.name} is the model of this pack and that its"
                " capacity is right."
            )
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the object that `cangauge estimate --json` prints, without the file names."""
        settings = self.settings
        return {
            **vars(self.scores),
            "method": settings.method,
            "initial_soc_pct": settings.initial_soc_pct,
            "initial_soc_from": self.origin,
            "capacity_ah": settings.capacity_ah or self.model.capacity_ah,
            "max_gap_s": settings.gap_s,
            "reasons": self.reason_shares,
            **self.capture_facts,
        }


def estimate_recorded_log(
    log: Log,
    model: Model,
    settings: EstimatorSettings,
    *,
    soc_from_log: bool = True,
    gap_from_log: bool = True,
    progress: Callable[[int], None] | None = None,
) -> RecordedEstimate:
    """Estimate a log.

    Parameters
    ----------
    log : Log
    model : Model
    settings : EstimatorSettings
        The log's temperature source replaces its own.
    soc_from_log : bool
        Begin from the log's first reference SoC, counted back to its first row, if it has one.
    gap_from_log : bool
        Lengthen the gap for a slow log, to three of its usual steps.
    progress : callable, optional
        Called with the number of samples done.

    Raises
    ------
    InputError
        If the log's voltage is another pack's.
    """
    require_same_pack(log, model)
    origin: Origin = "voltage" if settings.initial_soc_pct is None else "given"
    settings = replace(settings, temperature_source=log.temperature_source)
    if soc_from_log and log.first_soc() is not None:
        origin = "log"
        first_pct = counted_soc_pct(log, settings.capacity_ah or model.capacity_ah, None)[0]
        settings = replace(settings, initial_soc_pct=float(np.clip(first_pct, 0.0, 100.0)))
    if gap_from_log:
        gap_s = min(usual_gap_s(log.time_s, GAP_S), LONGEST_GAP_S)
        settings = replace(settings, gap_s=gap_s)
    table, scores = estimate_log(log, model, settings, progress)
    return RecordedEstimate(log, table, scores, model, settings, origin)


def estimate_recorded_capture(
    path: Path,
    vehicle: Vehicle,
    model: Model,
    settings: EstimatorSettings,
    *,
    progress: Callable[[int], None] | None = None,
) -> RecordedEstimate:
    """Estimate a capture, bit for bit as the service does.

    Like the service it begins from the first voltages unless `settings` holds an initial SoC; the
    car's own SoC is only the reference to compare with.

    Raises
    ------
    InputError
        If the capture gives no sample.
    """
    # python-can and cantools are slow to import; logs do without.
    from cangauge.service.capture_estimate import estimate_capture  # noqa: PLC0415

    if settings.temperature_source == "unknown":
        settings = replace(settings, temperature_source=vehicle.temperature_source)
    found = estimate_capture(path, vehicle, model, settings, progress=progress)
    recording = Recording(
        time_s=_unwrapped(found.time_s),
        current_a=found.current_a,
        voltage_v=found.voltage_v,
        temperature_c=found.temperature_c,
        soc_pct=found.soc_reference_pct if np.isfinite(found.soc_reference_pct).any() else None,
        name=path.name.split(".")[0],
        source=str(path),
        temperature_source=settings.temperature_source,
        remarks=found.remarks,
    )
    return RecordedEstimate(
        recorded=recording,
        table=found.table,
        # A recording has all that the scores need of a log.
        scores=score(found.table, cast("Log", recording), found.seconds),
        model=model,
        settings=settings,
        origin="voltage" if settings.initial_soc_pct is None else "given",
        capture_facts={"time_source": found.time_source, "frames": asdict(found.counts)},
    )


def _unwrapped(time_s: FloatArray) -> FloatArray:
    """Return time that continues where a second replay in the same capture began anew [s]."""
    step_s = np.diff(time_s)
    if not np.any(step_s < 0.0):
        return time_s
    return np.asarray(time_s[0] + np.concatenate(([0.0], np.cumsum(np.maximum(step_s, 0.0)))))


def require_same_pack(recorded: Recorded, model: Model) -> None:
    """Raise InputError if the voltage shows that the model belongs to another pack.

    Raises
    ------
    InputError
        If the median voltage lies outside the pseudo-OCV's range by `PACK_VOLTAGE_MARGIN`.
    """
    known = recorded.voltage_v[np.isfinite(recorded.voltage_v)]
    if not known.size:
        return
    low, high = model.voltage_model().pseudo_ocv([0.0, 100.0])
    median = float(np.median(known))
    if not (1.0 - PACK_VOLTAGE_MARGIN) * low <= median <= (1.0 + PACK_VOLTAGE_MARGIN) * high:
        raise InputError(
            f"the median is {median:.1f} V, but the model {model.name} is of a pack of"
            f" {low:.0f} … {high:.0f} V",
            source=recorded.source or recorded.name,
            field="voltage_v",
            cure="give the model of this pack with -m, or check the unit of the voltage",
        )


def require_table_suffix(output: Path) -> None:
    """Raise InputError if the name of an estimate file ends in neither .csv nor .parquet."""
    if output.suffix.lower() not in {".csv", ".parquet"}:
        raise InputError(
            "the suffix is neither .csv nor .parquet",
            source=output,
            field="--output",
            value=output.suffix,
            cure="name it .csv or .parquet",
        )


def write_estimates(path: Path, time_s: FloatArray, table: EstimateTable) -> None:
    """Write one row per sample, as CSV or Parquet by the suffix.

    Parameters
    ----------
    path : Path
        Ends in .csv or .parquet.
    time_s : array of shape (n,)
        The samples' own time [s]: a refused sample's estimate is the one before.
    table : EstimateTable
        n estimates; an unknown value becomes empty (CSV) or null (Parquet).
    """
    columns: dict[str, Any] = {"time_s": pa.array(time_s)}
    columns |= {name: pa.array(getattr(table, name), from_pandas=True) for name in NUMBERS}
    columns["status"] = pa.array([Status(value).name.lower() for value in table.status.tolist()])
    texts = {value: reason_names(value) for value in np.unique(table.reasons).tolist()}
    columns["reasons"] = pa.array([texts[value] for value in table.reasons.tolist()])
    if path.suffix.lower() == ".parquet":
        pa.parquet.write_table(pa.table(columns), path)
        return
    with path.open("wb") as file:
        # The header by hand: pyarrow always quotes names; no cell needs quotes.
        file.write((",".join(columns) + "\n").encode())
        plain = pa.csv.WriteOptions(include_header=False, quoting_style="none")
        pa.csv.write_csv(pa.table(columns), file, plain)


def read_estimates(path: Path) -> EstimateTable:
    """Read a Parquet file of estimates, as `write_estimates` or the service wrote it."""
    columns = pa.parquet.read_table(path).to_pydict()
    numbers: dict[str, Any] = {
        name: np.array([np.nan if value is None else value for value in columns[name]])
        for name in ("time_s", *NUMBERS)
    }
    flags = {reason_name(reason): int(reason) for reason in Reason}
    reasons = {
        text: sum(flags[name] for name in text.split("; ") if name)
        for text in set(columns["reasons"])
    }
    return EstimateTable(
        **numbers,
        status=np.array([Status[name.upper()] for name in columns["status"]], dtype=np.int64),
        reasons=np.array([reasons[text] for text in columns["reasons"]], dtype=np.int64),
    )
