"""What `cangauge estimate` estimates: a log, or a capture by the live service's own path."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from rich.progress import Progress

from cangauge.cli.inputs import refuse_single_row, refuse_turned_current
from cangauge.cli.output import console, note
from cangauge.errors import InputError
from cangauge.estimate.offline import EstimateTable, Scores, estimate_log, score
from cangauge.estimate.settings import EstimatorSettings
from cangauge.identify.charge import counted_soc_pct
from cangauge.identify.rows import usual_gap_s
from cangauge.logs.log import Log
from cangauge.model.delay_line import GAP_S
from cangauge.model.model_file import ModelFile
from cangauge.report.recorded import FloatArray, Recorded, Recording

if TYPE_CHECKING:
    from cangauge.bus.vehicle import Vehicle

VOLTAGE_MARGIN = 0.2
"""A recording whose median voltage lies further outside the model's is another pack's."""

Origin = Literal["given", "log", "voltage"]
"""Where the initial SoC comes from."""


@dataclass(frozen=True, eq=False)
class Estimated:
    """An estimate with all that a table, a report and a JSON object need.

    Parameters
    ----------
    recorded : Recorded
        n samples.
    table : EstimateTable
        n estimates.
    scores : Scores
    settings : EstimatorSettings
    origin : {"given", "log", "voltage"}
        Where the initial SoC comes from.
    facts : dict
        What else belongs into the JSON object.
    """

    recorded: Recorded
    table: EstimateTable
    scores: Scores
    settings: EstimatorSettings
    origin: Origin
    facts: dict[str, Any]


def from_log(
    log: Log, model: ModelFile, settings: EstimatorSettings, *, given: str | None, gap_given: bool
) -> Estimated:
    """Estimate a log.

    Parameters
    ----------
    log : Log
    model : ModelFile
    settings : EstimatorSettings
        As the user gave them.
    given : str, optional
        The initial SoC as given, "auto" for the first voltages; by default the log's first
        reference SoC, counted back to its first row.
    gap_given : bool
        Whether the gap was given; by default it follows a slow log's steps.

    Raises
    ------
    InputError
        If the log is another pack's.
    """
    check_same_pack(log, model)
    origin: Origin = "voltage" if settings.initial_soc_pct is None else "given"
    settings = replace(settings, temperature_source=log.temperature_source)
    if given is None and log.first_soc() is not None:
        origin = "log"
        first = counted_soc_pct(log, settings.capacity_ah or model.capacity_ah, None)[0]
        settings = replace(settings, initial_soc_pct=float(np.clip(first, 0.0, 100.0)))
    if not gap_given:
        settings = replace(settings, gap_s=_gap_s(log))
    with _progress() as progress:
        task = progress.add_task("estimating", total=len(log))
        table, scores = estimate_log(
            log, model, settings, lambda done: progress.update(task, completed=done)
        )
    return Estimated(log, table, scores, settings, origin, {})


def from_capture(
    path: Path, vehicle: Vehicle, model: ModelFile, settings: EstimatorSettings
) -> Estimated:
    """Estimate a capture, bit for bit as the service does.

    Like the service it begins from the first voltages unless an initial SoC is given, whatever
    the car itself says; the car's SoC is the reference to compare with.

    Raises
    ------
    InputError
        If the capture gives no sample, its current is turned, or it is another pack's.
    """
    # python-can and cantools are slow to import; logs do without.
    from cangauge.service.capture_estimate import estimate_capture  # noqa: PLC0415

    if settings.temperature_source == "unknown":
        settings = replace(settings, temperature_source=vehicle.temperature_source)
    with _progress() as progress:
        task = progress.add_task("estimating", total=None)
        found = estimate_capture(
            path,
            vehicle,
            model,
            settings,
            progress=lambda done: progress.update(task, completed=done),
        )
    recording = Recording(
        time_s=_running_on(found.time_s),
        current_a=found.current_a,
        voltage_v=found.voltage_v,
        temperature_c=found.temperature_c,
        soc_pct=found.soc_reference_pct if np.isfinite(found.soc_reference_pct).any() else None,
        name=path.name.split(".")[0],
        source=str(path),
        temperature_source=settings.temperature_source,
        remarks=found.remarks,
    )
    refuse_single_row(recording)
    for remark in recording.remarks:
        note(f"{path}: {remark}")
    check_same_pack(recording, model)
    _check_sign(recording)
    # All that is asked of the log here is what a recording has.
    scores = score(found.table, cast("Log", recording), found.seconds)
    facts = {"time_source": found.time_source, "frames": asdict(found.counts)}
    origin: Origin = "voltage" if settings.initial_soc_pct is None else "given"
    return Estimated(recording, found.table, scores, settings, origin, facts)


def check_same_pack(recorded: Recorded, model: ModelFile) -> None:
    """Refuse a recording whose voltage shows that the model belongs to another pack.

    Raises
    ------
    InputError
        If the median voltage lies more than `VOLTAGE_MARGIN` outside the model's pseudo-OCV.
    """
    known = recorded.voltage_v[np.isfinite(recorded.voltage_v)]
    if not known.size:
        return
    low, high = model.voltage_model().pseudo_ocv([0.0, 100.0])
    median = float(np.median(known))
    if not (1.0 - VOLTAGE_MARGIN) * low <= median <= (1.0 + VOLTAGE_MARGIN) * high:
        raise InputError(
            f"the median is {median:.1f} V, but the model {model.name} is of a pack of"
            f" {low:.0f} … {high:.0f} V",
            source=recorded.source or recorded.name,
            field="voltage_v",
            cure="give the model of this pack with -m, or check the unit of the voltage",
        )


def _check_sign(recording: Recording) -> None:
    """Refuse a turned current; a log of the rows that have everything tells it."""
    whole = np.isfinite(recording.voltage_v)
    whole[1:] &= np.diff(recording.time_s) > 0.0
    if whole.sum() < 2:
        return
    soc_pct = recording.soc_pct
    refuse_turned_current(
        Log(
            time_s=recording.time_s[whole],
            current_a=recording.current_a[whole],
            voltage_v=recording.voltage_v[whole],
            temperature_c=np.zeros(int(whole.sum())),
            soc_pct=None if soc_pct is None else soc_pct[whole],
            name=recording.name,
            source=recording.source,
        ),
        is_capture=True,
    )


def _running_on(time_s: FloatArray) -> FloatArray:
    """Return time that goes on where a second replay began anew in the same capture [s]."""
    step_s = np.diff(time_s)
    if not np.any(step_s < 0.0):
        return time_s
    return np.asarray(time_s[0] + np.concatenate(([0.0], np.cumsum(np.maximum(step_s, 0.0)))))


def _gap_s(log: Log) -> float:
    gap_s = min(usual_gap_s(log.time_s, GAP_S), 3600.0)
    if gap_s > GAP_S:
        note(
            f"note: {log.source or log.name}: its usual step is {gap_s / 3.0:g} s; steps over"
            f" {gap_s:g} s count as gaps (--max-gap-s)"
        )
    return gap_s


def _progress() -> Progress:
    return Progress(console=console, transient=True, disable=not console.is_terminal)
