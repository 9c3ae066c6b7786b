"""Samples and estimates as MCAP messages, for Foxglove and PlotJuggler."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from cangauge.extras.formats.mcap_messages import ESTIMATE, SAMPLE, McapTopics
from cangauge.types import Estimate, Sample, Status, reason_names

if TYPE_CHECKING:
    from cangauge.bus.recording import CaptureSamples
    from cangauge.estimation.offline import EstimateTable
    from cangauge.logs.log import Log

SAMPLE_TOPIC: Final = "/sample"
ESTIMATE_TOPIC: Final = "/soc_estimate"
_NUMBERS: Final = Estimate._fields[1:7]


def write_estimate(
    topics: McapTopics, time_s: float, sample: Sample, soc_pct: float, estimate: Estimate
) -> None:
    """Write a sample and the estimate after it.

    Parameters
    ----------
    topics : McapTopics
    time_s : float
        Log time of both messages [s]; they state the bus time of the sample themselves.
    sample : Sample
    soc_pct : float
        The vehicle's own SoC [%]; NaN if unknown.
    estimate : Estimate
    """
    fields = {**sample._asdict(), "soc_pct": soc_pct}
    topics.write_numbers(SAMPLE_TOPIC, SAMPLE, time_s, fields)
    numbers = dict(zip(_NUMBERS, estimate[1:7], strict=True))
    words = {
        "status": estimate.status.name.lower(),
        "reasons": reason_names(int(estimate.reasons)),
    }
    # A refused sample's estimate is the one before; its time is that of the sample.
    topics.write_numbers(
        ESTIMATE_TOPIC, ESTIMATE, time_s, {"time_s": sample.time_s, **numbers, **words}
    )


def write_estimates_mcap(path: Path, recorded: Log | CaptureSamples, table: EstimateTable) -> None:
    """Write the samples of a recording and their estimates, without its frames.

    Parameters
    ----------
    path : Path
    recorded : Log or CaptureSamples
        n samples.
    table : EstimateTable
        n estimates.

    Raises
    ------
    InputError
        If the package mcap is not installed.
    """
    own = recorded.soc_pct
    soc_pct = np.full(len(table), np.nan) if own is None else own
    samples = zip(
        *(
            column.tolist()
            for column in (
                recorded.time_s,
                recorded.current_a,
                recorded.voltage_v,
                recorded.temperature_c,
            )
        ),
        strict=True,
    )
    numbers = zip(*(getattr(table, name).tolist() for name in _NUMBERS), strict=True)
    flags = zip(table.status.tolist(), table.reasons.tolist(), strict=True)
    with path.open("wb") as file:
        topics = McapTopics(file, path)
        rows = zip(samples, soc_pct.tolist(), numbers, flags, strict=True)
        for values, soc, estimated, (status, reasons) in rows:
            sample = Sample(*values)
            estimate = Estimate._make((sample.time_s, *estimated, Status(status), reasons, 0))
            write_estimate(topics, sample.time_s, sample, soc, estimate)
        topics.finish()
