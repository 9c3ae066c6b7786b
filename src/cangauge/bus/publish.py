"""Published frames: SOC_ESTIMATE, SOC_DETAIL, SOC_HEALTH, SOC_POWER, SOC_CELLS, made and read.

Normally the clock of the loop sets the rate (`SocPublisher.beat`), with or without samples: a
SOC_ESTIMATE at each beat, the others at every tenth; SOC_CELLS only where there are cells.

During a replay at another speed, log time sets the rate (`SocPublisher.publish`): SOC_ESTIMATE
with the first sample of every 100 ms, the others with the first of every second. SOC_DETAIL is also
sent, as an acknowledgement, at the latest after `acknowledge_every` samples. Beats continue in the
silences.

Counter and CRC are those of AUTOSAR E2E profile 2, with the data ids in the DBC.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import can
from can.typechecking import CanFilter
from cantools.database.can import Database

from cangauge._resources import shared_file
from cangauge.bus.database import SignalCodec, load_dbc, signal_codec
from cangauge.bus.protection import E2eRule
from cangauge.bus.time_source import REPLAY_CLOCK_ID
from cangauge.errors import InputError
from cangauge.types import CellReport, Estimate, Health, Power, Reason, Status

ESTIMATE_EVERY_S: Final = 0.1
DETAIL_EVERY_S: Final = 1.0
DETAIL_EVERY_BEATS: Final = 10
"""Periods of the frames: [s] of log time, and beats of `ESTIMATE_EVERY_S`."""
EARLY_S: Final = 0.01
"""A sample may be this early for a frame that is due [s]: else jitter could halve the rate."""

AGE_AT_MOST_S: Final = 30.0
"""Largest age in SOC_ESTIMATE [s]."""

SAMPLES_MODULO: Final = 1 << 16
"""Modulus of the sample count in SOC_DETAIL."""
ACKNOWLEDGE_EVERY: Final = 4
"""Most samples between two SOC_DETAIL under the replay clock: `replay` waits for them."""

_LENGTH: Final = 8


@dataclass(frozen=True)
class FrameIds:
    """Standard ids of the frames.

    Raises
    ------
    InputError
        If one is not a standard id, or two are equal.
    """

    soc_estimate: int = 0x5A0
    soc_detail: int = 0x5A1
    replay_clock: int = REPLAY_CLOCK_ID
    soc_health: int = 0x5A2
    soc_power: int = 0x5A3
    soc_cells: int = 0x5A4

    @property
    def published(self) -> dict[int, str]:
        """Names of the frames that the service sends, by id."""
        names = ("soc_estimate", "soc_detail", "soc_health", "soc_power", "soc_cells")
        return {getattr(self, name): name for name in names}

    def __post_init__(self) -> None:
        seen: dict[int, str] = {}
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not 0 <= value <= 0x7FF:
                raise InputError(
                    "no standard CAN id", field=f"ids.{name}", value=value, cure="use 0x000–0x7FF"
                )
            if value in seen:
                raise InputError(
                    f"{seen[value]} has the same id", field=f"ids.{name}", value=f"0x{value:X}"
                )
            seen[value] = name


class SocEstimate(NamedTuple):
    """Content of a SOC_ESTIMATE."""

    soc_pct: float
    """State of charge [%]; NaN: not available."""
    soc_std_pct: float
    """Its standard deviation [%]; NaN: not available."""
    status: Status
    reasons: Reason
    age_s: float = math.nan
    """Whole seconds since charge was last counted, at most 30 [s]; NaN: no sample yet."""


class SocDetail(NamedTuple):
    """Content of a SOC_DETAIL."""

    soc_newton_pct: float
    soc_coulomb_pct: float
    residual_v: float
    """Measured minus predicted voltage [V]; NaN: not available."""
    samples: int
    """Samples processed so far, modulo `SAMPLES_MODULO`."""


class SocHealth(NamedTuple):
    """Content of a SOC_HEALTH; NaN: not available."""

    capacity_ah: float
    capacity_std_ah: float
    resistance_ratio: float
    """Resistance relative to the model's [-]."""
    resistance_std: float
    current_offset_a: float


class SocPower(NamedTuple):
    """Content of a SOC_POWER; NaN: not available."""

    discharge_a: float
    discharge_std_a: float
    charge_a: float
    charge_std_a: float
    energy_kwh: float
    energy_std_kwh: float


class SocCells(NamedTuple):
    """Content of a SOC_CELLS; NaN: not available."""

    weakest_cell: float
    weakest_soc_pct: float
    weakest_soc_std_pct: float
    cell_spread_pct: float
    """SoC of the strongest cell less that of the weakest [%]."""
    sum_error_v: float
    """Pack voltage less the sum of the cells [V]."""
    sum_check: float
    """0: not known, 1: agrees, 2: differs by more than both sensors allow."""


SocContent = SocEstimate | SocDetail | SocHealth | SocPower | SocCells


class PackReport(NamedTuple):
    """What is published every second besides the estimate."""

    health: Health
    power: Power
    cells: CellReport | None = None
    """None: the vehicle gives no cell voltages."""

    @property
    def notices(self) -> list[str]:
        """What the user should look after, one sentence each."""
        cells = self.cells
        if cells is None or not cells.is_sum_wrong:
            return []
        return [
            f"the pack voltage reads {cells.sum_error_v:+.2f} V (±{cells.sum_std_v:.2f} V) against"
            " the sum of the cells: check the voltage sensor, or count and scale of [cells]"
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the objects "health", "power", "cells" and "notices" of a JSON status."""
        cells = self.cells
        return {
            "health": _finite(self.health._asdict()),
            "power": _finite(self.power._asdict()),
            "cells": None
            if cells is None
            else _finite(
                cells._asdict() | {"weakest": cells.weakest if cells.weakest >= 0 else None}
            ),
            "notices": self.notices,
        }


NO_REPORT: Final[Mapping[str, Any]] = MappingProxyType(
    {"health": None, "power": None, "cells": None, "notices": []}
)
"""What `PackReport.to_dict` gives before the first sample."""


class _Layout:
    """A message of soc_estimate.dbc: codecs by signal, counter and CRC."""

    def __init__(self, database: Database, name: str, path: Path) -> None:
        message = database.get_message_by_name(name)
        self._codecs: dict[str, SignalCodec] = {
            signal.name: signal_codec(message, signal, source=path, field=name)
            for signal in message.signals
            if not signal.name.startswith(("counter_", "crc_"))
        }
        self._limits = {signal: codec.range for signal, codec in self._codecs.items()}
        try:
            attributes = getattr(message.dbc, "attributes", {})
            data_ids = bytes.fromhex(str(attributes["E2EDataIdList"].value))
        except (KeyError, ValueError) as error:
            raise InputError(
                "has no list of data ids", source=path, field=f"{name}.E2EDataIdList"
            ) from error
        self._rule = E2eRule("e2e_02", data_ids=data_ids)

    def encode(self, counter: int, **values: float) -> bytes:
        """Return the payload; values are clipped to the signal's range, NaN becomes its code."""
        payload = bytearray(_LENGTH)
        for name, codec in self._codecs.items():
            value = values[name]
            if not math.isnan(value):
                low, high = self._limits[name]
                value = min(max(value, low), high)
            codec.encode_into(payload, value)
        return self._rule.protect(payload, counter)

    def decode(self, data: bytes | bytearray) -> dict[str, float] | None:
        """Return the values by name; None for a damaged frame."""
        if len(data) != _LENGTH or not self._rule.is_whole(data):
            return None
        return {name: codec.decode(data) for name, codec in self._codecs.items()}


def _layouts() -> dict[str, _Layout]:
    path = shared_file("dbc", "soc_estimate.dbc")
    database = load_dbc(path)
    return {name: _Layout(database, name.upper(), path) for name in FrameIds().published.values()}


class SocPublisher:
    """Encode estimates, health, power and cells as frames.

    Parameters
    ----------
    ids : FrameIds, optional
    acknowledge_every : int, optional
        Send SOC_DETAIL after this number of samples, and at a beat with unacknowledged ones.
    """

    def __init__(self, ids: FrameIds | None = None, acknowledge_every: int | None = None) -> None:
        self.ids = ids or FrameIds()
        self._acknowledge_every = acknowledge_every
        self._layouts = _layouts()
        self._made = dict.fromkeys(self._layouts, 0)
        self._beats = 0
        self._estimate_due_s = -math.inf
        self._detail_due_s = -math.inf
        self._acknowledged = 0

    def beat(
        self,
        estimate: Estimate,
        samples: int,
        age_s: float,
        report: Callable[[], PackReport] | None = None,
    ) -> list[can.Message]:
        """Return the frames of one beat; due every `ESTIMATE_EVERY_S`.

        Parameters
        ----------
        estimate : Estimate
        samples : int
            Samples processed so far, including refused ones.
        age_s : float
            Time since the latest of them [s]; NaN: none yet.
        report : callable, optional
            Returns health, power and cells; called where their frames are due.
        """
        frames = [self.estimate_frame(estimate, age_s)]
        is_due = self._beats % DETAIL_EVERY_BEATS == 0
        self._beats += 1
        if is_due or (self._acknowledge_every is not None and samples != self._acknowledged):
            frames.append(self.detail_frame(estimate, samples))
        if is_due and report is not None:
            frames += self.report_frames(report())
        return frames

    def publish(
        self, estimate: Estimate, samples: int, report: Callable[[], PackReport] | None = None
    ) -> list[can.Message]:
        """Return the frames due with a sample of a replayed log; arguments as in `beat`."""
        now_s = estimate.time_s
        frames = []
        if now_s >= self._estimate_due_s - EARLY_S:
            self._estimate_due_s = _next_due(self._estimate_due_s, ESTIMATE_EVERY_S, now_s)
            frames.append(self.estimate_frame(estimate))
        is_due = now_s >= self._detail_due_s - EARLY_S
        if is_due or samples - self._acknowledged >= (self._acknowledge_every or math.inf):
            if is_due:
                self._detail_due_s = _next_due(self._detail_due_s, DETAIL_EVERY_S, now_s)
            frames.append(self.detail_frame(estimate, samples))
            if is_due and report is not None:
                frames += self.report_frames(report())
        return frames

    def restart(self) -> None:
        """Reset the due times: a new log may begin earlier."""
        self._estimate_due_s = self._detail_due_s = -math.inf

    def estimate_frame(self, estimate: Estimate, age_s: float = 0.0) -> can.Message:
        """Return SOC_ESTIMATE with the next counter; arguments as in `beat`."""
        return self._frame(
            "soc_estimate",
            soc_pct=estimate.soc_pct,
            soc_std_pct=estimate.soc_std_pct,
            age_s=age_s if math.isnan(age_s) else min(math.floor(age_s), AGE_AT_MOST_S),
            reason=float(reason_bits(estimate.reasons)),
            status=float(estimate.status),
        )

    def detail_frame(self, estimate: Estimate, samples: int) -> can.Message:
        """Return SOC_DETAIL with the next counter."""
        self._acknowledged = samples
        return self._frame(
            "soc_detail",
            soc_newton_pct=estimate.soc_newton_pct,
            soc_coulomb_pct=estimate.soc_coulomb_pct,
            samples=float(samples % SAMPLES_MODULO),
            residual_v=estimate.residual_v,
        )

    def report_frames(self, report: PackReport) -> list[can.Message]:
        """Return SOC_HEALTH, SOC_POWER and, where there are cells, SOC_CELLS."""
        health, power, cells = report
        frames = [
            self._frame(
                "soc_health",
                capacity_ah=health.capacity_ah,
                capacity_std_ah=health.capacity_std_ah,
                resistance_ratio=health.resistance_ratio,
                resistance_std=health.resistance_std,
                current_offset_a=health.offset_a,
            ),
            self._frame(
                "soc_power",
                discharge_a=power.discharge_a,
                discharge_std_a=power.discharge_std_a,
                charge_a=power.charge_a,
                charge_std_a=power.charge_std_a,
                energy_kwh=1e-3 * power.energy_wh,
                energy_std_kwh=1e-3 * power.energy_std_wh,
            ),
        ]
        if cells is not None:
            is_checked = not math.isnan(cells.sum_error_v)
            frames.append(
                self._frame(
                    "soc_cells",
                    weakest_cell=math.nan if cells.weakest < 0 else float(cells.weakest),
                    weakest_soc_pct=cells.soc_pct,
                    weakest_soc_std_pct=cells.soc_std_pct,
                    cell_spread_pct=cells.spread_pct,
                    sum_error_v=cells.sum_error_v,
                    sum_check=float(is_checked + cells.is_sum_wrong),
                )
            )
        return frames

    def _frame(self, name: str, **values: float) -> can.Message:
        """Return a frame with the next counter."""
        data = self._layouts[name].encode(self._made[name], **values)
        self._made[name] += 1
        return _message(getattr(self.ids, name), data)


class SocReader:
    """Decode the frames of a `SocPublisher`.

    Parameters
    ----------
    ids : FrameIds, optional

    Attributes
    ----------
    refused : int
        Damaged frames.
    """

    def __init__(self, ids: FrameIds | None = None) -> None:
        self.ids = ids or FrameIds()
        self.refused = 0
        self._layouts = _layouts()

    def read(self, message: can.Message) -> SocContent | None:
        """Return the content of a frame; None for other frames and damaged ones."""
        if message.is_extended_id or message.is_error_frame or message.is_remote_frame:
            return None
        name = self.ids.published.get(message.arbitration_id)
        if name is None:
            return None
        values = self._layouts[name].decode(message.data)
        if values is None:
            self.refused += 1
            return None
        return _CONTENTS[name](values)


def _estimate_content(values: dict[str, float]) -> SocEstimate:
    return SocEstimate(
        values["soc_pct"],
        values["soc_std_pct"],
        Status(int(values["status"])),
        Reason(int(values["reason"])),
        values["age_s"],
    )


_CONTENTS: Final[dict[str, Callable[[dict[str, float]], SocContent]]] = {
    "soc_estimate": _estimate_content,
    "soc_detail": lambda values: SocDetail(
        values["soc_newton_pct"],
        values["soc_coulomb_pct"],
        values["residual_v"],
        int(values["samples"]),
    ),
    "soc_health": lambda values: SocHealth(**values),
    "soc_power": lambda values: SocPower(**values),
    "soc_cells": lambda values: SocCells(**values),
}


def reason_bits(reasons: Reason) -> int:
    """Return the 20 bits of the frame: a wrong sign of current is an implausible input there."""
    bits = int(reasons)
    if bits & Reason.SIGN_SUSPECT:
        bits = bits & ~Reason.SIGN_SUSPECT | Reason.IMPLAUSIBLE_INPUT
    return int(bits)


def standard_filter(frame_id: int) -> CanFilter:
    """Return python-can's filter for one standard id."""
    return {"can_id": frame_id, "can_mask": 0x7FF, "extended": False}


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values, None for NaN."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }


def _next_due(due_s: float, every_s: float, now_s: float) -> float:
    """Return the next due time on the grid, or on a new one after a pause."""
    following = due_s + every_s
    return following if following > now_s else now_s + every_s


def _message(frame_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=data)
