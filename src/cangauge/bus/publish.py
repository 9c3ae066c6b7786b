"""Published frames: SOC_ESTIMATE and SOC_DETAIL, made and read.

Normally the clock of the loop sets the rate (`SocPublisher.beat`), with or without samples: a
SOC_ESTIMATE at each beat, a SOC_DETAIL at every tenth.

During a replay at another speed, log time sets the rate (`SocPublisher.publish`): SOC_ESTIMATE
with the first sample of every 100 ms, SOC_DETAIL with the first of every second and, as an
acknowledgement, at the latest after `acknowledge_every` samples. Beats continue in the silences.

Counter and CRC are those of AUTOSAR E2E profile 2, with the data ids in the DBC.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import can
from can.typechecking import CanFilter
from cantools.database.can import Database

from cangauge._resources import shared_file
from cangauge.bus.database import SignalCodec, load_dbc, signal_codec
from cangauge.bus.protection import E2eRule
from cangauge.bus.time_source import REPLAY_CLOCK_ID
from cangauge.errors import InputError
from cangauge.estimation.validity import Estimate, Reason, Status

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

    def __post_init__(self) -> None:
        seen: dict[int, str] = {}
        for name in ("soc_estimate", "soc_detail", "replay_clock"):
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


def _layouts() -> tuple[_Layout, _Layout]:
    path = shared_file("dbc", "soc_estimate.dbc")
    database = load_dbc(path)
    return _Layout(database, "SOC_ESTIMATE", path), _Layout(database, "SOC_DETAIL", path)


class SocPublisher:
    """Encode estimates as SOC_ESTIMATE and SOC_DETAIL frames.

    Parameters
    ----------
    ids : FrameIds, optional
    acknowledge_every : int, optional
        Send SOC_DETAIL after this number of samples, and at a beat with unacknowledged ones.
    """

    def __init__(self, ids: FrameIds | None = None, acknowledge_every: int | None = None) -> None:
        self.ids = ids or FrameIds()
        self._acknowledge_every = acknowledge_every
        self._estimate, self._detail = _layouts()
        self._estimates_made = 0
        self._details_made = 0
        self._beats = 0
        self._estimate_due_s = -math.inf
        self._detail_due_s = -math.inf
        self._acknowledged = 0

    def beat(self, estimate: Estimate, samples: int, age_s: float) -> list[can.Message]:
        """Return the frames of one beat; due every `ESTIMATE_EVERY_S`.

        Parameters
        ----------
        estimate : Estimate
        samples : int
            Samples processed so far, including refused ones.
        age_s : float
            Time since the latest of them [s]; NaN: none yet.
        """
        frames = [self.estimate_frame(estimate, age_s)]
        is_due = self._beats % DETAIL_EVERY_BEATS == 0
        self._beats += 1
        if is_due or (self._acknowledge_every is not None and samples != self._acknowledged):
            frames.append(self.detail_frame(estimate, samples))
        return frames

    def publish(self, estimate: Estimate, samples: int) -> list[can.Message]:
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
        return frames

    def restart(self) -> None:
        """Reset the due times: a new log may begin earlier."""
        self._estimate_due_s = self._detail_due_s = -math.inf

    def estimate_frame(self, estimate: Estimate, age_s: float = 0.0) -> can.Message:
        """Return SOC_ESTIMATE with the next counter; arguments as in `beat`."""
        data = self._estimate.encode(
            self._estimates_made,
            soc_pct=estimate.soc_pct,
            soc_std_pct=estimate.soc_std_pct,
            age_s=age_s if math.isnan(age_s) else min(math.floor(age_s), AGE_AT_MOST_S),
            reason=float(estimate.reasons),
            status=float(estimate.status),
        )
        self._estimates_made += 1
        return _message(self.ids.soc_estimate, data)

    def detail_frame(self, estimate: Estimate, samples: int) -> can.Message:
        """Return SOC_DETAIL with the next counter."""
        data = self._detail.encode(
            self._details_made,
            soc_newton_pct=estimate.soc_newton_pct,
            soc_coulomb_pct=estimate.soc_coulomb_pct,
            samples=float(samples % SAMPLES_MODULO),
            residual_v=estimate.residual_v,
        )
        self._details_made += 1
        self._acknowledged = samples
        return _message(self.ids.soc_detail, data)


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
        self._estimate, self._detail = _layouts()

    def read(self, message: can.Message) -> SocEstimate | SocDetail | None:
        """Return the content of a frame; None for other frames and damaged ones."""
        if message.is_extended_id or message.is_error_frame or message.is_remote_frame:
            return None
        if message.arbitration_id == self.ids.soc_estimate:
            values = self._estimate.decode(message.data)
            if values is not None:
                return SocEstimate(
                    values["soc_pct"],
                    values["soc_std_pct"],
                    Status(int(values["status"])),
                    Reason(int(values["reason"])),
                    values["age_s"],
                )
        elif message.arbitration_id == self.ids.soc_detail:
            values = self._detail.decode(message.data)
            if values is not None:
                return SocDetail(
                    values["soc_newton_pct"],
                    values["soc_coulomb_pct"],
                    values["residual_v"],
                    int(values["samples"]),
                )
        else:
            return None
        self.refused += 1
        return None


def standard_filter(frame_id: int) -> CanFilter:
    """Return python-can's filter for one standard id."""
    return {"can_id": frame_id, "can_mask": 0x7FF, "extended": False}


def _next_due(due_s: float, every_s: float, now_s: float) -> float:
    """Return the next due time on the grid, or on a new one after a pause."""
    following = due_s + every_s
    return following if following > now_s else now_s + every_s


def _message(frame_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=data)
