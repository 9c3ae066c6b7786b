"""What a capture's samples take while it is estimated."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.compiled import PROGRESS_EVERY
from cangauge.service import offline
from live import frames_of, leaf_model, short_log

VALUES_B = 5 * 8
"""Time, current, voltage, temperature and SoC of a sample, as doubles [B]."""
PLACE_B = 8
"""A sample's place in the list of estimates [B]."""


def test_a_sample_takes_its_five_values_and_a_place(tmp_path: Path) -> None:
    """A tuple alone takes 80 B, in place of 40 B."""
    path, taken_b = tmp_path / "drive.log", []
    frames = [*frames_of(short_log(300.0))]
    lines = [
        f"({1e9 + each.timestamp:.6f}) can0 {each.arbitration_id:03X}#{each.data.hex()}"
        for each in frames
    ]
    path.write_text("\n".join([*lines, ""]))

    def measure(_: int) -> None:
        own = tracemalloc.take_snapshot().filter_traces(
            [tracemalloc.Filter(True, offline.__file__)]
        )
        taken_b.append(sum(each.size for each in own.statistics("filename")))

    tracemalloc.start()
    try:
        found = offline.estimate_capture(
            path, Vehicle.load("generic"), leaf_model(), progress=measure
        )
    finally:
        tracemalloc.stop()
    samples = len(found.recorded.time_s) * PROGRESS_EVERY / len(frames)
    # A list and an array keep an eighth more than they hold, to grow.
    assert taken_b[0] / samples < 1.3 * (VALUES_B + PLACE_B)
