"""Prometheus metrics of a status, rendered by prometheus-client (extra `metrics`)."""

from __future__ import annotations

import math
import os
import platform
import time
import tomllib
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from cangauge.service.status_client import BOUNDS_S, reason_ids, value_at
from cangauge.types import Reason, Status

_TABLE: Final = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


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
        for place, (name, text) in _TABLE["gauges"].items():
            if values[place.partition(".")[0]] is not None:
                value = value_at(values, place)
                yield GaugeMetricFamily(
                    f"cangauge_{name}", text, math.nan if value is None else value
                )
        for place, (name, text) in _TABLE["counters"].items():
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
        for key, (name, text) in _TABLE["histograms"].items():
            bounds = [*map(repr, BOUNDS_S), "+Inf"]
            buckets = [*zip(bounds, accumulate(status[key]["buckets"]), strict=True)]
            yield HistogramMetricFamily(
                f"cangauge_{name}", text, buckets=buckets, sum_value=status[key]["total_s"]
            )
