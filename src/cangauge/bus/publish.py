"""Published frames: SOC_ESTIMATE, SOC_DETAIL, SOC_HEALTH, SOC_POWER, SOC_CELLS, made and read.

The clock of the loop sets the rate (`SocPublisher.publish_periodic`), with or without samples: a
SOC_ESTIMATE each time, the others every tenth time; SOC_CELLS only where there are cells.

During a replay at another speed, log time sets the rate (`SocPublisher.publish`): SOC_ESTIMATE
with the first sample of every 100 ms, the others with the first of every second. SOC_DETAIL is also
sent, as an acknowledgement, at the latest after `acknowledge_every` samples. Beats continue in the
silences.

Counter and CRC are those of AUTOSAR E2E profile 2, with the data ids in the DBC.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import can
from can.typechecking import CanFilter
from cantools.database.can import Database, Message

from cangauge._resources import shared_file
from cangauge._text import plain
from cangauge.bus.database import load_dbc, signal_codec
from cangauge.bus.protection import E2eRule
from cangauge.settings import FrameIds
from cangauge.types import REASONS, CellReport, Estimate, Health, Power, Reason, Status

ESTIMATE_EVERY_S: Final = 0.1
DETAIL_EVERY: Final = 10
"""Period of SOC_ESTIMATE [s], and of the other frames [periods of it]."""
EARLY_S: Final = 0.01
"""A sample may be this early for a frame that is due [s]: else jitter could halve the rate."""
SAMPLES_MODULO: Final = 1 << 16
"""Modulus of the sample count in SOC_DETAIL."""
ACKNOWLEDGE_EVERY: Final = 4
"""Most samples between two SOC_DETAIL under the replay clock: `replay` waits for them."""


class PackReport(NamedTuple):
    """Content of the frames of every second; `cells` is None without cell voltages."""

    health: Health
    power: Power
    cells: CellReport | None = None

    @property
    def notices(self) -> list[str]:
        """Advice for the user, one sentence each."""
        cells = self.cells
        if cells is None or not cells.is_sum_wrong:
            return []
        return [
            f"the pack voltage reads {cells.sum_error_v:+.2f} V (±{cells.sum_std_v:.2f} V) against"
            " the sum of the cells: check the voltage sensor, or count and scale of [cells]"
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the objects "health", "power", "cells" and "notices" of a JSON status."""
        cells = None if self.cells is None else self.cells._asdict()
        if cells is not None and cells["weakest"] < 0:
            cells["weakest"] = None
        return {
            "health": plain(_possible(self.health)),
            "power": plain(_possible(self.power)),
            "cells": cells and plain(cells),
            "notices": self.notices,
        }


_NEVER_NEGATIVE: Final = {
    "capacity_ah": "capacity_std_ah",
    "resistance_ratio": "resistance_std",
    "energy_wh": "energy_std_wh",
}
"""Values of every pack that are never negative, with their standard deviations."""


def _possible(found: Health | Power) -> dict[str, float]:
    """Return values, NaN for those that no pack can have: the current contradicts the voltage."""
    values: dict[str, float] = found._asdict()
    for name, std in _NEVER_NEGATIVE.items():
        if values.get(name, 0.0) < 0.0:
            values[name] = values[std] = math.nan
    return values


NO_REPORT: Final[Mapping[str, Any]] = MappingProxyType(
    {"health": None, "power": None, "cells": None, "notices": []}
)
"""What `PackReport.to_dict` gives before the first sample."""


_KINDS: Final[dict[str, Callable[[int], int]]] = {
    "status": Status,
    "reason": Reason,
    "samples": int,
}
"""Signals that are not floats."""


class _Layout:
    """A message of soc_estimate.dbc: codecs by signal, counter and CRC."""

    def __init__(self, message: Message) -> None:
        self._length = message.length
        self._codecs = {
            signal.name: signal_codec(message, signal)
            for signal in message.signals
            if not signal.name.startswith(("counter_", "crc_"))
        }
        ids = getattr(message.dbc, "attributes", {})["E2EDataIdList"].value
        self._rule = E2eRule("e2e_02", data_id_list=tuple(bytes.fromhex(str(ids))))

    def encode(self, counter: int, values: Mapping[str, float]) -> bytes:
        """Return the payload; values are clipped to the signal's range, NaN becomes its code."""
        payload = bytearray(self._length)
        for name, codec in self._codecs.items():
            value, (low, high) = float(values[name]), codec.range
            codec.encode_into(payload, value if math.isnan(value) else min(max(value, low), high))
        return self._rule.protect(payload, counter)

    def decode(self, data: bytes | bytearray) -> dict[str, Any]:
        """Return the values by name; none for a damaged frame."""
        if len(data) != self._length or not self._rule.is_whole(data):
            return {}
        values: dict[str, Any] = {name: codec.decode(data) for name, codec in self._codecs.items()}
        return values | {name: _KINDS[name](int(values[name])) for name in _KINDS.keys() & values}


@cache
def _database() -> Database:
    return load_dbc(shared_file("dbc", "soc_estimate.dbc"))


def _layouts(ids: FrameIds) -> dict[str, _Layout]:
    message = _database().get_message_by_name
    return {name: _Layout(message(name.upper())) for name in ids.published.values()}


class SocPublisher:
    """Encode estimates, health, power and cells as frames.

    With `acknowledge_every`, SOC_DETAIL is sent after this number of samples, and with the
    periodic frames after fewer.
    """

    def __init__(self, ids: FrameIds | None = None, acknowledge_every: int | None = None) -> None:
        self.ids = ids or FrameIds()
        self._acknowledge_every = acknowledge_every
        self._layouts = _layouts(self.ids)
        self._made = dict.fromkeys(self._layouts, 0)
        self._beats = self._acknowledged = 0
        self._due_s = {1: -math.inf, DETAIL_EVERY: -math.inf}

    def publish_periodic(
        self,
        estimate: Estimate,
        samples: int,
        age_s: float,
        report: Callable[[], PackReport] | None = None,
    ) -> list[can.Message]:
        """Return the periodic frames; due every `ESTIMATE_EVERY_S`.

        `samples` are those processed so far, including refused ones; `age_s` is the time since the
        latest that the estimator took [s], NaN without a sample. `report` is called where its
        frames are due.
        """
        frames = [self.estimate_frame(estimate, age_s)]
        is_due = self._beats % DETAIL_EVERY == 0
        self._beats += 1
        is_behind = self._acknowledge_every is not None and samples != self._acknowledged
        return frames + self._slow_frames(estimate, samples, report, is_due, is_behind)

    def publish(
        self, estimate: Estimate, samples: int, report: Callable[[], PackReport] | None = None
    ) -> list[can.Message]:
        """Return the frames due with a sample of a replayed log; see `publish_periodic`."""
        frames = []
        if self._is_due(1, estimate.time_s):
            frames.append(self.estimate_frame(estimate))
        is_due = self._is_due(DETAIL_EVERY, estimate.time_s)
        is_behind = samples - self._acknowledged >= (self._acknowledge_every or math.inf)
        return frames + self._slow_frames(estimate, samples, report, is_due, is_behind)

    def _is_due(self, periods: int, now_s: float) -> bool:
        """Return whether a frame is due at a log time: on the grid of its period, or on a new one.

        The grid is a new one after a pause, and in a new log, which begins earlier.
        """
        every_s, due_s = periods * ESTIMATE_EVERY_S, self._due_s[periods]
        if due_s - every_s - EARLY_S <= now_s < due_s - EARLY_S:
            return False
        is_on_grid = due_s - EARLY_S <= now_s < due_s + every_s
        self._due_s[periods] = every_s + (due_s if is_on_grid else now_s)
        return True

    def _slow_frames(
        self,
        estimate: Estimate,
        samples: int,
        report: Callable[[], PackReport] | None,
        is_due: bool,
        is_behind: bool,
    ) -> list[can.Message]:
        frames = [self.detail_frame(estimate, samples)] if is_due or is_behind else []
        return frames + (self.report_frames(report()) if is_due and report is not None else [])

    def estimate_frame(self, estimate: Estimate, age_s: float = 0.0) -> can.Message:
        """Return SOC_ESTIMATE with the next counter; arguments as in `publish_periodic`."""
        values = {
            "soc_pct": estimate.soc_pct,
            "soc_std_pct": estimate.soc_std_pct,
            "status": estimate.status,
            "reason": reason_bits(estimate.reasons),
            "age_s": age_s if math.isnan(age_s) else math.floor(age_s),
        }
        return self._frame("soc_estimate", values)

    def detail_frame(self, estimate: Estimate, samples: int) -> can.Message:
        """Return SOC_DETAIL with the next counter."""
        self._acknowledged = samples
        values = estimate._asdict() | {"samples": samples % SAMPLES_MODULO}
        return self._frame("soc_detail", values)

    def report_frames(self, report: PackReport) -> list[can.Message]:
        """Return SOC_HEALTH, SOC_POWER and, where there are cells, SOC_CELLS."""
        health = report.health._asdict() | {"current_offset_a": report.health.offset_a}
        power = report.power._asdict()
        power |= {
            "energy_kwh": 1e-3 * power["energy_wh"],
            "energy_std_kwh": 1e-3 * power["energy_std_wh"],
        }
        frames = [self._frame("soc_health", health), self._frame("soc_power", power)]
        if (cells := report.cells) is not None:
            values = {
                "weakest_cell": math.nan if cells.weakest < 0 else cells.weakest,
                "weakest_soc_pct": cells.soc_pct,
                "weakest_soc_std_pct": cells.soc_std_pct,
                "cell_spread_pct": cells.spread_pct,
                "sum_error_v": cells.sum_error_v,
                "sum_check": (not math.isnan(cells.sum_error_v)) + cells.is_sum_wrong,
            }
            frames.append(self._frame("soc_cells", values))
        return frames

    def _frame(self, name: str, values: Mapping[str, float]) -> can.Message:
        """Return a frame with the next counter."""
        data = self._layouts[name].encode(self._made[name], values)
        self._made[name] += 1
        return can.Message(arbitration_id=getattr(self.ids, name), is_extended_id=False, data=data)


class SocReader:
    """Decode the frames of a `SocPublisher`; `refused` counts damaged ones."""

    def __init__(self, ids: FrameIds | None = None) -> None:
        self.ids = ids or FrameIds()
        self.refused = 0
        self._layouts = _layouts(self.ids)

    def read(self, message: can.Message) -> tuple[str, dict[str, Any]]:
        """Return name and values of a frame, by the DBC's signals (NaN: not available).

        ("", {}) for other frames and damaged ones.
        """
        name = self.ids.published.get(message.arbitration_id)
        is_data = not (message.is_extended_id or message.is_error_frame or message.is_remote_frame)
        if name is None or not is_data:
            return "", {}
        values = self._layouts[name].decode(message.data)
        self.refused += not values
        return (name, values) if values else ("", {})


def reason_bits(reasons: Reason) -> Reason:
    """Return the reasons in the frame's 20 bits.

    The frame has no bit for SIGN_SUSPECT, which is sent as IMPLAUSIBLE_INPUT.
    """
    bits = int(reasons)
    if bits & Reason.SIGN_SUSPECT:
        bits = bits & ~Reason.SIGN_SUSPECT | Reason.IMPLAUSIBLE_INPUT
    return REASONS[bits]


def standard_filter(frame_id: int) -> CanFilter:
    """Return python-can's filter for one standard id."""
    return {"can_id": frame_id, "can_mask": 0x7FF, "extended": False}
