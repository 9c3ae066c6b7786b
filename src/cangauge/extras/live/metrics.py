"""Prometheus metrics of a status, rendered by prometheus-client (extra `metrics`)."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Iterator
from itertools import accumulate
from typing import Any, Final

from cangauge.errors import InputError
from cangauge.service.status_client import BOUNDS_S, reason_ids, value_at
from cangauge.types import Reason, Status

try:
    from prometheus_client import CollectorRegistry, ProcessCollector
    from prometheus_client.core import (
        CounterMetricFamily,
        GaugeMetricFamily,
        HistogramMetricFamily,
        Metric,
    )
    from prometheus_client.exposition import choose_encoder
    from prometheus_client.registry import Collector
except ImportError as error:
    raise InputError(
        "the metrics need the package prometheus-client, which is not installed",
        field="http",
        cure="pip install 'cangauge[metrics]'; /status works without",
    ) from error

_GAUGES: Final = {
    "start_s": ("start_time_seconds", "Start time, seconds since 1970."),
    "is_config_used": (
        "config_last_reload_successful",
        "0 if the latest configuration was refused and the one before it is in use.",
    ),
    "loop_age_s": ("loop_age_seconds", "Time since the latest turn of the receive loop."),
    "bus_up": ("bus_up", "0 while the bus is lost or its controller is bus-off."),
    "sample_age_s": (
        "sample_age_seconds",
        "Age of the latest sample; infinite before the first.",
    ),
    "is_record_failing": ("record_failing", "1 while the disk rejects data."),
    "estimate.soc_pct": ("soc_percent", "State of charge [%]."),
    "estimate.soc_std_pct": ("soc_std_percent", "Standard deviation of the SoC [%]."),
    "estimate.soc_newton_pct": ("soc_newton_percent", "SoC by the inverse voltage model [%]."),
    "estimate.soc_coulomb_pct": ("soc_coulomb_percent", "SoC by Coulomb counting [%]."),
    "estimate.residual_v": ("residual_volts", "Measured minus predicted voltage."),
    "sample.current_a": ("current_amperes", "Pack current, positive = discharge."),
    "sample.voltage_v": ("voltage_volts", "Pack voltage."),
    "sample.temperature_c": ("temperature_celsius", "Temperature."),
    "health.capacity_ah": ("capacity_ah", "Charge from 100 to 0 % [Ah]."),
    "health.capacity_std_ah": ("capacity_std_ah", "Standard deviation of the capacity [Ah]."),
    "health.resistance_ratio": ("resistance_ratio", "Resistance relative to the model's."),
    "health.resistance_std": ("resistance_std", "Standard deviation of that ratio."),
    "health.offset_a": (
        "current_offset_amperes",
        "Offset of the current sensor, measured minus true.",
    ),
    "power.discharge_a": ("discharge_amperes", "Discharge current possible for 10 s."),
    "power.discharge_std_a": ("discharge_std_amperes", "Its standard deviation."),
    "power.charge_a": ("charge_amperes", "Charge current possible for 10 s, positive."),
    "power.charge_std_a": ("charge_std_amperes", "Its standard deviation."),
    "power.energy_wh": ("energy_watt_hours", "Energy left to the cut-off [Wh]."),
    "power.energy_std_wh": ("energy_std_watt_hours", "Its standard deviation [Wh]."),
    "cells.cells": ("cells", "Cells whose voltage is known."),
    "cells.weakest": ("weakest_cell", "Number of the cell with the least SoC."),
    "cells.soc_pct": ("weakest_soc_percent", "Its state of charge [%]."),
    "cells.soc_std_pct": ("weakest_soc_std_percent", "Standard deviation of that [%]."),
    "cells.spread_pct": (
        "cell_spread_percent",
        "SoC of the strongest cell less that of the weakest [%].",
    ),
    "cells.sum_error_v": ("cell_sum_error_volts", "Pack voltage less the sum of the cells."),
    "cells.is_sum_wrong": (
        "cell_sum_differs",
        "1 while they differ by more than both sensors allow.",
    ),
}
_COUNTERS: Final = {
    "frames.received": ("frames_received", "Frames that passed the filters."),
    "frames.wanted": ("frames_wanted", "Frames with an expected id."),
    "frames.used": ("frames_used", "Expected frames not rejected."),
    "frames.lost": ("frames_lost", "Expected frames missing by their alive counters."),
    "samples": ("samples", "Samples completed by frames."),
    "bus_counts.garbled": ("bus_garbled", "Packets that are not CAN frames."),
    "bus_counts.error_frames": ("bus_error_frames", "Error frames of the controller."),
    "bus_counts.unsent": (
        "bus_unsent",
        "Frames dropped since the transmit queue stayed full.",
    ),
    "bus_counts.queue_drops": (
        "bus_queue_drops",
        "Frames that the kernel dropped since the receive queue was full.",
    ),
    "bus_counts.losses": (
        "bus_losses",
        "Losses of the bus; each is followed by reconnecting.",
    ),
    "bus_counts.foreign": (
        "bus_foreign",
        "Frames from another sender with ids that this service sends.",
    ),
    "record.frames": ("record_frames", "Frames recorded."),
    "record.lost_frames": ("record_lost_frames", "Frames that could not be written."),
    "record.written_bytes": ("record_written_bytes", "Bytes written."),
}
_HISTOGRAMS: Final = {
    "latency": (
        "latency_seconds",
        "Time from the receive stamp that completes a sample to its published SoC.",
    ),
    "step": ("step_seconds", "Processing time of the frame that completes a sample."),
}


def render(status: dict[str, Any], accept: str) -> tuple[bytes, str]:
    """Return the text for a status and its content type, as the Accept header asks for."""
    registry = CollectorRegistry()
    registry.register(_Status(status))
    ProcessCollector(pid=os.getppid, registry=registry)  # the service, which started this one
    encode, content_type = choose_encoder(accept)
    return encode(registry), content_type


class _Status(Collector):
    def __init__(self, status: dict[str, Any]) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        status, record = self._status, self._status["record"]
        names = ("version", "bus", "vehicle", "model", "method", "time_source")
        labels = {"python": platform.python_version()} | {name: status[name] for name in names}
        build = GaugeMetricFamily(
            "cangauge_build_info", "Version and setup; always 1.", labels=[*labels]
        )
        build.add_metric([*labels.values()], 1.0)
        yield build
        age_s = value_at(status, "sample.age_s")
        values = status | {
            "start_s": time.time() - status["uptime_s"],
            "is_config_used": status["config"]["problem"] is None,
            "sample_age_s": math.inf if age_s is None else age_s,
            "is_record_failing": None if record is None else record["problem"] is not None,
        }
        for place, (name, text) in _GAUGES.items():
            if values[place.partition(".")[0]] is not None:
                value = value_at(values, place)
                yield GaugeMetricFamily(
                    f"cangauge_{name}", text, math.nan if value is None else value
                )
        for place, (name, text) in _COUNTERS.items():
            if (value := value_at(status, place)) is not None:
                yield CounterMetricFamily(f"cangauge_{name}", text, value)
        statuses = {each.name.lower(): each.name.lower() == status["status"] for each in Status}
        reasons = {name: name in status["reasons"] for name in reason_ids(~Reason.NONE)}
        rejected = "Rejected frames and values, by reason."
        asked = "Requests over ISO-TP, and what came of them."
        for kind, name, text, label, counts in (
            (GaugeMetricFamily, "status", "1 for the present status.", "status", statuses),
            (GaugeMetricFamily, "reason", "1 for present reasons.", "reason", reasons),
            (CounterMetricFamily, "rejects", rejected, "reason", status["rejects"]),
            (CounterMetricFamily, "polls", asked, "kind", status["polls"] or {}),
        ):
            family = kind(f"cangauge_{name}", text, labels=[label])
            for key, value in counts.items():
                family.add_metric([key], value)
            if counts:
                yield family
        for key, (name, text) in _HISTOGRAMS.items():
            bounds = [*map(repr, BOUNDS_S), "+Inf"]
            buckets = [*zip(bounds, accumulate(status[key]["buckets"]), strict=True)]
            yield HistogramMetricFamily(
                f"cangauge_{name}", text, buckets=buckets, sum_value=status[key]["total_s"]
            )
