"""Prometheus metrics of a snapshot, rendered by prometheus-client (extra `metrics`)."""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from cangauge._version import __version__
from cangauge.errors import InputError
from cangauge.service.status import BOUNDS_S, HistogramCounts, Snapshot, reason_ids
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
        cure="pip install 'cangauge[metrics]'; `cangauge status` works without",
    ) from error

_BUS_HELP: Final = {
    "garbled": "Packets that are not CAN frames.",
    "error_frames": "Error frames of the controller.",
    "unsent": "Frames dropped since the transmit queue stayed full.",
    "queue_drops": "Frames that the kernel dropped since the receive queue was full.",
    "losses": "Losses of the bus; each is followed by reconnecting.",
    "foreign": "Frames from another sender with ids that this service sends.",
}


class Exposition:
    """Render the latest snapshot; call it from any thread but the receive loop's.

    Parameters
    ----------
    latest : callable
        Returns the latest snapshot.
    clock : callable
        Monotonic time [s].
    """

    def __init__(
        self, latest: Callable[[], Snapshot], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._registry = CollectorRegistry()
        self._registry.register(_SnapshotCollector(latest, clock))
        ProcessCollector(registry=self._registry)

    def render(self, accept: str) -> tuple[bytes, str]:
        """Return the text and its content type, as the Accept header asks for."""
        encode, content_type = choose_encoder(accept)
        return encode(self._registry), content_type


class _SnapshotCollector(Collector):
    def __init__(self, latest: Callable[[], Snapshot], clock: Callable[[], float]) -> None:
        self._latest = latest
        self._clock = clock

    def collect(self) -> Iterator[Metric]:
        snapshot, now_s = self._latest(), self._clock()
        yield from _about(snapshot, now_s)
        yield from _estimate(snapshot, now_s)
        yield from _report(snapshot)
        yield from _frames(snapshot)
        yield _histogram(
            "cangauge_latency_seconds",
            "Time from the receive stamp that completes a sample to its published SoC.",
            snapshot.latency,
        )
        yield _histogram(
            "cangauge_step_seconds",
            "Processing time of the frame that completes a sample.",
            snapshot.step,
        )
        yield from _record(snapshot)


def _about(snapshot: Snapshot, now_s: float) -> Iterator[Metric]:
    identity = snapshot.identity
    labels = {
        "version": __version__,
        "python": platform.python_version(),
        "bus": identity.bus,
        "vehicle": identity.vehicle,
        "model": identity.model,
        "method": identity.method,
        "time_source": identity.time_source,
    }
    build = GaugeMetricFamily(
        "cangauge_build_info", "Version and setup; always 1.", labels=[*labels]
    )
    build.add_metric([*labels.values()], 1.0)
    yield build
    yield GaugeMetricFamily(
        "cangauge_start_time_seconds", "Start time, seconds since 1970.", identity.began_s
    )
    yield GaugeMetricFamily(
        "cangauge_config_last_reload_successful",
        "0 if the latest configuration was refused and the one before it is in use.",
        not snapshot.config.problem,
    )
    yield GaugeMetricFamily(
        "cangauge_loop_age_seconds",
        "Time since the latest turn of the receive loop.",
        now_s - snapshot.made_s,
    )


def _estimate(snapshot: Snapshot, now_s: float) -> Iterator[Metric]:
    estimate, sample = snapshot.estimate_at(now_s), snapshot.sample
    nan = math.nan
    for name, text, value in (
        ("soc_percent", "State of charge [%].", estimate.soc_pct),
        ("soc_std_percent", "Standard deviation of the SoC [%].", estimate.soc_std_pct),
        (
            "soc_newton_percent",
            "SoC by the inverse voltage model [%].",
            estimate.soc_newton_pct,
        ),
        (
            "soc_coulomb_percent",
            "SoC by Coulomb counting [%].",
            estimate.soc_coulomb_pct,
        ),
        ("residual_volts", "Measured minus predicted voltage.", estimate.residual_v),
        (
            "current_amperes",
            "Pack current, positive = discharge.",
            nan if sample is None else sample.current_a,
        ),
        ("voltage_volts", "Pack voltage.", nan if sample is None else sample.voltage_v),
        ("temperature_celsius", "Temperature.", nan if sample is None else sample.temperature_c),
        (
            "sample_age_seconds",
            "Age of the latest sample; infinite before the first.",
            snapshot.age_s(now_s),
        ),
    ):
        yield GaugeMetricFamily(f"cangauge_{name}", text, value)
    status = GaugeMetricFamily("cangauge_status", "1 for the present status.", labels=["status"])
    for each in Status:
        status.add_metric([each.name.lower()], float(each is estimate.status))
    yield status
    reasons = GaugeMetricFamily("cangauge_reason", "1 for present reasons.", labels=["reason"])
    held = set(reason_ids(estimate.reasons))
    for name in reason_ids(~Reason.NONE):
        reasons.add_metric([name], float(name in held))
    yield reasons


def _report(snapshot: Snapshot) -> Iterator[Metric]:
    if snapshot.report is None:
        return
    health, power, cells = snapshot.report
    for name, text, value in (
        ("capacity_ah", "Charge from 100 to 0 % [Ah].", health.capacity_ah),
        ("capacity_std_ah", "Standard deviation of the capacity [Ah].", health.capacity_std_ah),
        ("resistance_ratio", "Resistance relative to the model's.", health.resistance_ratio),
        ("resistance_std", "Standard deviation of that ratio.", health.resistance_std),
        (
            "current_offset_amperes",
            "Offset of the current sensor, measured minus true.",
            health.offset_a,
        ),
        (
            "discharge_amperes",
            "Discharge current possible for 10 s.",
            power.discharge_a,
        ),
        ("discharge_std_amperes", "Its standard deviation.", power.discharge_std_a),
        ("charge_amperes", "Charge current possible for 10 s, positive.", power.charge_a),
        ("charge_std_amperes", "Its standard deviation.", power.charge_std_a),
        ("energy_watt_hours", "Energy left to the cut-off [Wh].", power.energy_wh),
        ("energy_std_watt_hours", "Its standard deviation [Wh].", power.energy_std_wh),
    ):
        yield GaugeMetricFamily(f"cangauge_{name}", text, value)
    if cells is None:
        return
    weakest = math.nan if cells.weakest < 0 else cells.weakest
    for name, text, value in (
        ("cells", "Cells whose voltage is known.", cells.cells),
        ("weakest_cell", "Number of the cell with the least SoC.", weakest),
        ("weakest_soc_percent", "Its state of charge [%].", cells.soc_pct),
        ("weakest_soc_std_percent", "Standard deviation of that [%].", cells.soc_std_pct),
        (
            "cell_spread_percent",
            "SoC of the strongest cell less that of the weakest [%].",
            cells.spread_pct,
        ),
        (
            "cell_sum_error_volts",
            "Pack voltage less the sum of the cells.",
            cells.sum_error_v,
        ),
        (
            "cell_sum_differs",
            "1 while they differ by more than both sensors allow.",
            float(cells.is_sum_wrong),
        ),
    ):
        yield GaugeMetricFamily(f"cangauge_{name}", text, value)


def _frames(snapshot: Snapshot) -> Iterator[Metric]:
    for name, text, value in (
        ("frames_received", "Frames that passed the filters.", snapshot.frames),
        ("frames_wanted", "Frames with an expected id.", snapshot.wanted),
        (
            "frames_used",
            "Expected frames not rejected.",
            snapshot.wanted - snapshot.rejected,
        ),
        ("frames_lost", "Expected frames missing by their alive counters.", snapshot.lost),
        ("samples", "Samples completed by frames.", snapshot.samples),
    ):
        yield CounterMetricFamily(f"cangauge_{name}", text, value)
    yield _by_label(
        "cangauge_rejects", "Rejected frames and values, by reason.", "reason", snapshot.rejects
    )
    for name, value in snapshot.bus.items():
        text = _BUS_HELP.get(name, name.replace("_", " "))
        yield CounterMetricFamily(f"cangauge_bus_{name}", text, value)
    if snapshot.polls is not None:
        yield _by_label(
            "cangauge_polls",
            "Requests over ISO-TP, and what came of them.",
            "kind",
            snapshot.polls,
        )
    yield GaugeMetricFamily(
        "cangauge_bus_up", "0 while the bus is lost or its controller is bus-off.", snapshot.bus_up
    )


def _record(snapshot: Snapshot) -> Iterator[Metric]:
    record = snapshot.record
    if record is None:
        return
    yield CounterMetricFamily("cangauge_record_frames", "Frames recorded.", record.frames)
    yield CounterMetricFamily(
        "cangauge_record_lost_frames", "Frames that could not be written.", record.lost_frames
    )
    yield CounterMetricFamily(
        "cangauge_record_written_bytes", "Bytes written.", record.written_bytes
    )
    yield GaugeMetricFamily(
        "cangauge_record_failing",
        "1 while the disk rejects data.",
        record.is_active and record.problem is not None,
    )


def _by_label(name: str, text: str, label: str, values: Mapping[str, int]) -> Metric:
    family = CounterMetricFamily(name, text, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


def _histogram(name: str, text: str, histogram: HistogramCounts) -> Metric:
    total = 0
    buckets: list[tuple[str, float]] = []
    for bound, count in zip((*BOUNDS_S, math.inf), histogram.counts, strict=True):
        total += count
        buckets.append(("+Inf" if math.isinf(bound) else repr(bound), float(total)))
    return HistogramMetricFamily(name, text, buckets=buckets, sum_value=histogram.total_s)
