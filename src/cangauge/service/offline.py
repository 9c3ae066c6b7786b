"""Offline estimates of a recorded log or capture.

A capture passes the same pipeline as the frames of the live service, so that the numbers are the
same bit for bit.
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from operator import attrgetter
from os import PathLike
from typing import Any, Final, Literal, cast

import numpy as np
from can.typechecking import Channel

from cangauge._text import rounded
from cangauge._typing import FloatArray
from cangauge.bus.publish import NO_REPORT, PackReport
from cangauge.bus.recording import CaptureSamples, capture_samples, open_vehicle_capture
from cangauge.bus.time_source import frames_of_buses
from cangauge.bus.vehicle import Vehicle
from cangauge.errors import InputError
from cangauge.estimation.cells import CellEstimator
from cangauge.estimation.compiled import PROGRESS_EVERY, make_estimator
from cangauge.estimation.offline import (
    EstimateTable,
    Scores,
    gap_of,
    initial_soc_of,
    score,
    step_all,
)
from cangauge.estimation.settings import EstimatorSettings
from cangauge.logs.log import Log
from cangauge.logs.read import CellColumns
from cangauge.model.coulomb_counting import difference_from_reference
from cangauge.model.model_file import Model
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.settings import TimeSourceName
from cangauge.types import Estimate, Reason, Sample, reason_name, reason_sentences

PACK_EVERY_S: Final = 1.0
"""Least interval of the rows of health, power and cells [s]."""
PACK_ROWS: Final = 3600
"""Most rows of them for a log: each takes 5 ms, and they change over minutes."""
PACK_VOLTAGE_MARGIN: Final = 0.2
"""Relative margin around the pseudo-OCV's range; a median voltage outside it is another pack's."""
DOUBTFUL_VALID: Final = 0.1
DOUBTFUL_COVER: Final = 0.5
"""Fractions of valid samples, and of reference SoC within ±2σ, below which to warn."""

Origin = Literal["given", "log", "voltage"]
"""Source of the initial SoC: an option, the log's soc_pct, or the first voltages."""


PackRows = list[tuple[float, PackReport]]
"""Health, power and cells at times of a recording [s]."""


def pack_columns(rows: PackRows) -> dict[str, FloatArray]:
    """Return the rows as columns: time_s, health, power and, where known, cells; NaN: unknown."""
    table = []
    for time_s, report in rows:
        parts = report.to_dict()
        cells = {f"cell_{name}": value for name, value in (parts["cells"] or {}).items()}
        table.append({"time_s": time_s, **parts["health"], **parts["power"], **cells})
    return {name: np.array([row[name] for row in table], np.float64) for name in table[0]}


def _add_row(
    rows: PackRows, every_s: float, time_s: float, report: Callable[[], PackReport]
) -> None:
    """Keep the report of a sample's time [s], if the latest row is `every_s` older, or later."""
    if not rows or not rows[-1][0] <= time_s < rows[-1][0] + every_s:
        rows.append((time_s, report()))


@dataclass(frozen=True, eq=False)
class RecordedEstimate:
    """Estimates of a recording, with the data for table, report and JSON.

    Parameters
    ----------
    recorded : Log or CaptureSamples
        n samples.
    table : EstimateTable
        n estimates.
    scores : Scores
    model : Model
    settings : EstimatorSettings
        As used.
    origin : {"given", "log", "voltage"}
        Source of the initial SoC.
    time_source : {"receive", "replay-clock"}, optional
    counts : dict, optional
        Source of bus time, and `Pipeline.counts`, of a capture.
    report : PackReport, optional
        Health, power and cells at the end.
    pack_rows : list
        The same over time, where asked for.
    """

    recorded: Log | CaptureSamples
    table: EstimateTable
    scores: Scores
    model: Model
    settings: EstimatorSettings
    origin: Origin = "voltage"
    time_source: TimeSourceName | None = None
    counts: dict[str, int] | None = None
    report: PackReport | None = None
    pack_rows: PackRows = field(default_factory=list)

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
        """Reasons to doubt the estimate as a whole, one sentence each."""
        scores = self.scores
        found = []
        name = self.model.name
        if scores.valid_fraction < DOUBTFUL_VALID:
            reasons = reason_sentences(int(np.bitwise_or.reduce(self.table.reasons)))
            found.append(
                f"Only {100.0 * scores.valid_fraction:.0f} % of the estimates are valid"
                f" ({reasons}). Check that {name} is the model of this pack at these temperatures."
            )
        if scores.cover_2sigma is not None and scores.cover_2sigma < DOUBTFUL_COVER:
            found.append(
                f"The reference SoC lies within ±2σ in only {100.0 * scores.cover_2sigma:.0f} % of"
                f" the samples. Check that {name} is the model of this pack and that its capacity"
                " is right."
            )
        if isinstance(self.recorded, Log):
            capacity_ah = self.settings.capacity_ah or self.model.capacity_ah
            difference = difference_from_reference(self.recorded, capacity_ah)
            found.extend([] if difference is None else [f"{difference}."])
        if self.report is not None:
            found += [f"{notice[:1].upper()}{notice[1:]}." for notice in self.report.notices]
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the object that `cangauge estimate --json` prints, without the file names."""
        settings = self.settings
        of_capture = {"time_source": self.time_source, "frames": self.counts}
        return {
            **vars(self.scores),
            "method": settings.method,
            "initial_soc_pct": settings.initial_soc_pct,
            "initial_soc_from": self.origin,
            "capacity_ah": settings.capacity_ah or self.model.capacity_ah,
            "max_gap_s": settings.gap_s,
            "reasons": self.reason_shares,
            **(NO_REPORT if self.report is None else self.report.to_dict()),
            **({} if self.counts is None else of_capture),
        }


def estimate_recorded_log(
    log: Log,
    model: Model,
    settings: EstimatorSettings,
    *,
    soc_from_log: bool = True,
    cells: CellColumns | None = None,
    keeps_pack: bool = False,
    progress: Callable[[int], None] | None = None,
) -> RecordedEstimate:
    """Estimate a log.

    Parameters
    ----------
    log : Log
    model : Model
    settings : EstimatorSettings
        The log's temperature source replaces its own, and so does the gap of a slow log: three of
        its usual steps.
    soc_from_log : bool
        Begin from the log's first reference SoC, counted back to its first row, if it has one.
    cells : CellColumns, optional
        Cell voltages, by the log's rows.
    keeps_pack : bool
        Keep health, power and cells over time: at the first sample of each interval of a second,
        or of a longer one that gives `PACK_ROWS`.
    progress : callable, optional
        Called with the number of samples done.

    Raises
    ------
    InputError
        If the log's voltage is another pack's.
    """
    require_same_pack(log.voltage_v, model, log.source or log.name)
    origin: Origin = "voltage" if settings.initial_soc_pct is None else "given"
    settings = replace(settings, temperature_source=log.temperature_source, gap_s=gap_of(log))
    start_pct = initial_soc_of(log, settings.capacity_ah or model.capacity_ah)
    if soc_from_log and start_pct is not None:
        origin = "log"
        settings = replace(settings, initial_soc_pct=start_pct)
    began = time.perf_counter()
    estimator = make_estimator(model, settings)
    weakest = None
    if cells is not None:
        weakest = CellEstimator(estimator.voltage_model, cells.count, cells.first)
    rows: PackRows = []
    every_s = max(PACK_EVERY_S, log.duration_s / PACK_ROWS)
    volts = iter(() if cells is None else cells.voltage_v)

    def report() -> PackReport:
        return PackReport(
            estimator.health, estimator.power(), None if weakest is None else weakest.report
        )

    def observe(sample: Sample) -> None:
        row = next(volts, None)
        if weakest is not None and row is not None and weakest.is_due(sample.time_s):
            weakest.update(estimator.pack_tick(sample), row.tolist(), [0.0] * len(row))
        if keeps_pack:
            _add_row(rows, every_s, sample.time_s, report)

    observes = observe if keeps_pack or cells is not None else None
    table = step_all(estimator, log, progress=progress, observe=observes)
    scores = score(table, log, time.perf_counter() - began)
    return RecordedEstimate(
        log, table, scores, model, settings, origin, report=report(), pack_rows=rows
    )


def require_same_pack(voltage_v: FloatArray, model: Model, source: str) -> None:
    """Raise InputError if the median voltage shows that the model belongs to another pack."""
    known = voltage_v[np.isfinite(voltage_v)]
    if not known.size:
        return
    low, high = model.voltage_model().pseudo_ocv([0.0, 100.0])
    median = float(np.median(known))
    if not (1.0 - PACK_VOLTAGE_MARGIN) * low <= median <= (1.0 + PACK_VOLTAGE_MARGIN) * high:
        raise InputError(
            f"the voltage is {rounded(known.min(), 4)} … {rounded(known.max(), 4)} V (median"
            f" {rounded(median, 4)} V), but the model {model.name} is of a pack of {rounded(low)} …"
            f" {rounded(high)} V",
            source=source,
            field="voltage_v",
            cure="give the model of this pack with -m, or check the unit of the voltage",
        )


def estimate_capture(
    path: str | PathLike[str],
    vehicle: Vehicle,
    model: Model,
    settings: EstimatorSettings | None = None,
    *,
    keeps_pack: bool = False,
    progress: Callable[[int], None] | None = None,
) -> RecordedEstimate:
    """Estimate a capture, bit for bit as the service does with the same frames.

    Bus time is that of REPLAY_CLOCK if the capture holds one, else the receive stamps. Like the
    service it starts from the first voltages unless `settings` holds an initial SoC; the car's own
    SoC is the reference to compare with only.

    Parameters
    ----------
    path : path-like
    vehicle : Vehicle
        Its temperature source replaces an unknown one of `settings`.
    model : Model
    settings : EstimatorSettings, optional
    keeps_pack : bool
        Keep health, power and cells of each second (`pack_rows`), not only of the end.
    progress : callable, optional
        Called with the number of frames read, every `PROGRESS_EVERY`.

    Raises
    ------
    InputError
        If the capture cannot be read, gives no sample, or its voltage is another pack's.
    """
    began = time.perf_counter()
    buses: dict[Channel | None, _Bus] = {}
    capture = open_vehicle_capture(path, vehicle)

    def open_bus(source: TimeSourceName) -> _Bus:
        chosen = PipelineSettings(settings or EstimatorSettings(), source)
        return _Bus(Pipeline(vehicle, model, chosen, publishes=False))

    frames = frames_of_buses(capture, buses, open_bus)
    for number, (bus, message) in enumerate(frames, start=1):
        if bus.pipeline.handle(message):
            bus.collect(keeps_pack=keeps_pack)
        if progress is not None and number % PROGRESS_EVERY == 0:
            progress(number)
    for bus in buses.values():
        if bus.pipeline.finish():
            bus.collect(keeps_pack=keeps_pack)
    found = [bus for bus in buses.values() if bus.estimates]
    if not found:
        raise InputError(
            "the capture gives no sample of current",
            source=path,
            field=vehicle.current.message,
            cure=f"check that this is the bus of {vehicle.name} (see `cangauge inspect`)",
        )
    best = max(found, key=attrgetter("pipeline.samples"))
    pipeline = best.pipeline
    table = EstimateTable.of(best.estimates)
    settings = pipeline.estimator.settings
    statistics = pipeline.decoder.statistics
    time_s, current_a, voltage_v, temperature_c, soc_pct = np.array(best.values).reshape(-1, 5).T
    recorded = CaptureSamples(
        _without_steps_back(time_s),
        current_a,
        voltage_v,
        temperature_c,
        soc_pct,
        str(path),
        settings.temperature_source,
        statistics,
        (
            *vehicle.remarks,
            *capture.info["remarks"],
            *_remarks(pipeline, len(found)),
            *pipeline.decoder.never_decoded.values(),
        ),
    )
    # With a model, another pack's voltage is implausible, and a current that wraps.
    wraps = statistics.messages[vehicle.current.key]["implausible"] > 0
    is_known = np.isfinite(recorded.voltage_v).any() and not wraps
    own = recorded if is_known else capture_samples(path, vehicle)
    require_same_pack(own.voltage_v, model, str(path))
    # `score` needs only columns that a capture has.
    scores = score(table, cast("Log", recorded), time.perf_counter() - began)
    origin: Origin = "voltage" if settings.initial_soc_pct is None else "given"
    return RecordedEstimate(
        recorded,
        table,
        scores,
        model,
        settings,
        origin,
        pipeline.settings.time_source,
        pipeline.counts,
        pipeline.report(),
        best.pack_rows,
    )


def _without_steps_back(time_s: FloatArray) -> FloatArray:
    """Count steps back as none: further replays in the same capture begin earlier."""
    steps_s = np.diff(time_s)
    if not np.any(steps_s < 0.0):
        return time_s
    return np.asarray(time_s[0] + np.concatenate(([0.0], np.cumsum(np.maximum(steps_s, 0.0)))))


@dataclass
class _Bus:
    """One of the buses in a capture; each has its own pipeline.

    `values` are time, current, voltage, temperature and the vehicle's own SoC of every sample.
    """

    pipeline: Pipeline
    estimates: list[Estimate] = field(default_factory=list)
    values: array[float] = field(default_factory=lambda: array("d"))
    pack_rows: PackRows = field(default_factory=list)

    def collect(self, *, keeps_pack: bool) -> None:
        """Keep the latest sample with its estimate, and health, power and cells if asked for."""
        sample = self.pipeline.latest_sample
        if sample is not None:
            self.estimates.append(self.pipeline.latest)
            self.values.extend((*sample, self.pipeline.decoder.reference_soc_pct))
            if keeps_pack:
                _add_row(self.pack_rows, PACK_EVERY_S, sample.time_s, self.pipeline.report)


def _remarks(pipeline: Pipeline, buses: int) -> list[str]:
    """Return what a user must know of a capture's frames."""
    counts = pipeline.counts
    two_senders = pipeline.decoder.statistics.two_senders
    remarks = {
        "a recorded replay: time is its log's (REPLAY_CLOCK)": pipeline.is_replay,
        f"{counts['beginnings'] + 1} logs were replayed; each is estimated separately": counts[
            "beginnings"
        ],
        f"the stamps start again: {counts['steps_back'] + 1} sessions in one file, estimated as"
        " one: split it there": counts["steps_back"],
        f"{counts['crc_errors']} frames refused: wrong CRC": counts["crc_errors"],
        f"{counts['lost']} frames lost, by their alive counters": counts["lost"],
        f"{two_senders} frames refused: two senders use their id or PGN": two_senders,
        "several buses carry the frames; the one with most samples is used": buses > 1,
    }
    return [text for text, applies in remarks.items() if applies]
