"""Checks of what is to be diagnosed: logs of another pack, dead channels, duplicates, wrong counts.

A wrong start, capacity or sensor is a cause to find. A log is refused only where no cause within
its physical bounds can explain it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np

from cangauge.errors import InputError
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import soc_at_first_row
from cangauge.model.model_file import Model

SHORTEST_S: Final = 300.0
"""Shortest log to diagnose [s]; a shorter one is mostly transient."""

LEAST_PART, MOST_PART = 0.7, 1.4
"""Limits of a log's median voltage relative to the pack's usual voltage."""

MOST_COUNTED_PCT, COUNT_TOLERANCE_PCT = 150.0, 5.0
"""Span of the counted SoC that a wrong capacity or current gain explains at most, as their physical
bounds are a third of the value; and how far it may lie beyond 0–100 % without contradiction [%]."""


def check_logs(logs: Sequence[Log], references: Sequence[Log], model: Model) -> None:
    """Raise InputError for logs that cannot be diagnosed, or not with these references."""
    if not logs:
        raise InputError("no log to diagnose", field="logs", cure="give at least one log")
    usual = model.extended_model().pack.voltage_v
    for log in (*logs, *references):
        where = log.source or log.name
        if log.duration_s < SHORTEST_S:
            raise InputError(
                f"{log.duration_s:.0f} s are too short for a diagnosis",
                source=where,
                cure=f"give a log of at least {SHORTEST_S / 60.0:.0f} min, better half an hour with"
                " changing load and SoC",
            )
        for channel, unit in (("current_a", "A"), ("voltage_v", "V")):
            values = getattr(log, channel)
            if np.ptp(values) == 0.0:
                raise InputError(
                    f"constant for {log.duration_s / 60.0:.0f} min: no diagnosis is possible",
                    source=where,
                    field=channel,
                    value=f"{values[0]:g} {unit}",
                    cure="check the signal, or give a log in which the pack is used",
                )
        median = float(np.median(log.voltage_v))
        if not LEAST_PART * usual <= median <= MOST_PART * usual:
            raise InputError(
                f"this log is of another pack: the model's has about {usual:.3g} V",
                source=where,
                field="voltage_v",
                value=round(median, 1),
                cure="use the model of this pack",
            )
        _check_count(log, model.capacity_ah)
    check_given_once((*logs, *references), cure="give each log once, either as LOG or as reference")


_MEASURED: Final = ("current_a", "voltage_v")


def check_given_once(logs: Sequence[Log], *, cure: str) -> None:
    """Raise InputError if two logs have the same rows; those of a parked pack may be alike."""
    moving = [log for log in logs if any(np.ptp(getattr(log, k)) > 0.0 for k in _MEASURED)]
    for one, other in itertools.combinations(moving, 2):
        if all(np.array_equal(getattr(one, k), getattr(other, k)) for k in _MEASURED):
            raise InputError(
                f"same rows as {other.source or other.name}: they would count twice",
                source=one.source or one.name,
                cure=cure,
            )


def _check_count(log: Log, capacity_ah: float) -> None:
    """Raise InputError if no start explains a log whose counted SoC leaves 0–100 %."""
    out = 100.0 * discharged_ah(log.time_s, log.current_a) / capacity_ah
    stated = soc_at_first_row(log, capacity_ah)
    start = 50.0 if stated is None else stated
    low, high = start - float(out.max()), start - float(out.min())
    within = low >= -COUNT_TOLERANCE_PCT and high <= 100.0 + COUNT_TOLERANCE_PCT
    too_much = high - low > MOST_COUNTED_PCT
    if within or (stated is None and not too_much):
        return
    # As the SoC rises so does the voltage, whatever the start.
    backwards = np.corrcoef(-out, log.voltage_v)[0, 1] < 0.0
    if too_much or backwards:
        reason = "the voltage moves the other way" if backwards else "no start explains it"
        raise InputError(
            f"the SoC counted with {capacity_ah:.2f} Ah runs from {high:.1f} to {low:.1f} %:"
            f" {reason}",
            source=log.source or log.name,
            field="soc_pct",
            cure="check --capacity-ah and the sign of current (positive must discharge; see"
            " `cangauge inspect`)",
        )
