"""What a run of the service amounted to: one line for the log, one object for `--json`."""

from __future__ import annotations

from typing import Any

from cangauge.bus.lasting import LastingPort
from cangauge.report.words import number, reason_names
from cangauge.service.gauge import Gauge
from cangauge.service.loop import RunSummary


def summary_line(gauge: Gauge, port: LastingPort, summary: RunSummary) -> str:
    """Return the line: frames, losses, the last SoC."""
    counts, latest = gauge.counts, gauge.latest
    soc = f"{number(latest.soc_pct, 2)} ± {number(latest.soc_std_pct, 2, '%')}"
    step = number(summary.step_p50_us, 0, "µs")
    return (
        f"{summary.seconds:.1f} s, {counts.frames} frames, {counts.samples} samples,"
        f" {counts.lost} lost, {counts.crc_errors} CRC errors{_troubles(port, summary)};"
        f" last SoC {soc} ({latest.status.name.lower()}); step {step} (median)"
    )


def _troubles(port: LastingPort, summary: RunSummary) -> str:
    """Return what went wrong on the bus, as a part of the summary."""
    kinds = ", ".join(f"{kind} {count}" for kind, count in port.error_kinds.most_common())
    found = {
        "dropped in the receive queue": port.queue_drops,
        f"error frames ({kinds})": port.error_frames,
        "not sent": port.unsent,
        "of another service with these ids": summary.rival_frames,
        f"times without the bus ({port.away_s:.1f} s)": port.losses,
    }
    return "".join(f", {count} {what}" for what, count in found.items() if count)


def summary_json(gauge: Gauge, port: LastingPort, summary: RunSummary) -> dict[str, Any]:
    """Return the object."""
    counts, latest = gauge.counts, gauge.latest
    return {
        "bus": port.name,
        "seconds": summary.seconds,
        "cpu_seconds": summary.cpu_seconds,
        "frames": counts.frames,
        "samples": counts.samples,
        "lost": counts.lost,
        "crc_errors": counts.crc_errors,
        "refused": {
            "crc_errors": counts.crc_errors,
            "repeated": counts.repeated,
            "short": counts.short,
            "not_available": counts.not_available,
            "implausible": counts.implausible,
            "stuck": counts.stuck,
            "held_back": counts.held_back,
        },
        "untimed": counts.untimed,
        "restarts": counts.beginnings,
        "garbled": port.garbled,
        "error_frames": port.error_frames,
        "error_kinds": dict(port.error_kinds),
        "queue_drops": port.queue_drops,
        "unsent": port.unsent,
        "bus_losses": port.losses,
        "bus_away_s": port.away_s,
        "rival_frames": summary.rival_frames,
        "stamps": port.facts.stamps,
        "step_p50_us": summary.step_p50_us,
        "estimate": {
            "time_s": latest.time_s,
            "soc_pct": latest.soc_pct,
            "soc_std_pct": latest.soc_std_pct,
            "soc_newton_pct": latest.soc_newton_pct,
            "soc_coulomb_pct": latest.soc_coulomb_pct,
            "residual_v": latest.residual_v,
            "status": latest.status.name.lower(),
            "reasons": reason_names(int(latest.reasons)),
        },
        "soc_reference_pct": gauge.reference_soc_pct,
    }
