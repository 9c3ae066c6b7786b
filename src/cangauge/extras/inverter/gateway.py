"""A gateway between a battery and its inverter that replaces the state of charge, and nothing else.

The battery's bus is the one that the service listens to; the inverter has a bus of its own, since a
frame cannot be replaced on the bus that carries it. Every frame is handed on unchanged, in both
directions. Only the SoC of one message is replaced, while the estimate is VALID and its samples are
current; on any doubt the battery's own value passes at once. A gateway that ends, ends the frames:
the inverter then stops by itself, as if the battery had been unplugged.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from copy import copy
from typing import TYPE_CHECKING, Final

import can

from cangauge._logging import emit
from cangauge._resources import shared_file
from cangauge.bus.database import BitField, load_dbc
from cangauge.bus.reconnecting import ReconnectingBus
from cangauge.errors import InputError
from cangauge.service.output import Output
from cangauge.service.setup import inverter_address
from cangauge.service.status_client import Snapshot
from cangauge.service.worker import start_thread
from cangauge.types import Estimate, Sample

if TYPE_CHECKING:
    from cangauge.bus.vehicle import Vehicle
    from cangauge.service.config import RunConfig
    from cangauge.service.run import Service

DOUBT_S: Final = 0.5
"""Time after which an estimate that is not confirmed is no longer sent [s]."""
POLL_S: Final = 0.005
"""Longest wait on either bus [s]: what a frame is late on the other."""
CLOSE_WITHIN_S: Final = 1.0
FULL_PCT: Final = 100.0
"""SoC at which an inverter ends the charge [%]."""
_SOC: Final = "soc_pct"
"""Beginning of the names of the signals that hold the SoC, in a profile's DBC."""

_LOG = logging.getLogger(__name__)


FrameId = tuple[int, bool]
"""Id, and whether it is an extended one."""


def soc_fields(profile: str) -> dict[FrameId, list[tuple[BitField, float]]]:
    """Return bits and step [%] of the SoC in the frames of a profile, by id."""
    database = load_dbc(shared_file("dbc", f"inverter_{profile}.dbc"))
    found: dict[FrameId, list[tuple[BitField, float]]] = {}
    for message in database.messages:
        fields = [
            (BitField.of(signal, message.length), float(signal.scale))
            for signal in message.signals
            if signal.name.startswith(_SOC)
        ]
        if fields:
            found[message.frame_id, message.is_extended_frame] = fields
    return found


class Gateway(Output):
    """Hand frames on between a battery's and an inverter's bus, in a thread.

    Parameters
    ----------
    battery, inverter : ReconnectingBus
        Open ones, of the gateway alone.
    fields : mapping
        Of `soc_fields`.
    own_ids : callable
        Returns the ids that the service itself sends on the battery's bus: not for the inverter.
    """

    def __init__(
        self,
        battery: ReconnectingBus,
        inverter: ReconnectingBus,
        fields: Mapping[FrameId, list[tuple[BitField, float]]],
        own_ids: Callable[[], frozenset[int]] = frozenset,
    ) -> None:
        self._battery, self._inverter = battery, inverter
        self._fields, self._own_ids = fields, own_ids
        self._ever_own: set[int] = set()  # also those before a reload: their frames may still come
        # A single interval may be a gap: from the third sample on the period is known.
        self._sampled_s, self._interval_s, self._current_until_s = math.inf, -math.inf, -math.inf
        self._soc: tuple[float, float] | None = None  # [%], and until when it is confirmed
        self._without_fd: list[ReconnectingBus] = []  # already logged
        self._done = threading.Event()
        self._replaces: bool | None = None
        self._thread = start_thread(self._run, "cangauge-inverter")

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        """Note that samples come, and how often: one long interval is a gap, not a period."""
        del estimate
        interval_s = sample.time_s - self._sampled_s
        period_s = min(interval_s, self._interval_s)
        self._sampled_s, self._interval_s = sample.time_s, interval_s
        self._current_until_s = time.monotonic() + period_s + DOUBT_S

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Take the SoC if it is valid, else none."""
        soc_pct = snapshot.status["estimate"]["soc_pct"]
        if snapshot.status["status"] != "valid" or soc_pct is None or not math.isfinite(soc_pct):
            self._soc = None
        else:
            self._soc = soc_pct, snapshot.made_s + DOUBT_S

    def close(self) -> None:
        """End the gateway; log how many frames each bus could not take."""
        self._done.set()
        self._thread.join(CLOSE_WITHIN_S)
        for bus in (self._battery, self._inverter):
            bus.close()
            if bus.unsent:
                text = f"{bus.unsent} frames could not be handed on to {bus.name}"
                emit(_LOG.warning, "inverter.unsent", text)

    def soc_pct(self, now_s: float) -> float | None:
        """Return the SoC that may be sent at a monotonic time [s]; None: the battery's own."""
        soc = self._soc
        if soc is None or now_s > min(soc[1], self._current_until_s):
            return None
        return min(max(soc[0], 0.0), 100.0)

    def replaced(self, frame: can.Message, now_s: float) -> can.Message:
        """Return a frame of the battery as the inverter gets it."""
        fields = self._fields.get((frame.arbitration_id, frame.is_extended_id))
        if fields is None or frame.is_remote_frame:
            return frame
        soc_pct = self.soc_pct(now_s)
        self._note(is_replaced=soc_pct is not None)
        if soc_pct is None:
            return frame
        data = bytearray(frame.data)
        for field, step in fields:
            if field.shift + field.width <= 8 * len(data):  # older batteries have shorter frames
                steps = round(soc_pct / step)
                if steps * step >= FULL_PCT > soc_pct:
                    steps -= 1  # rounding ends no charge
                field.put(data, steps)
        replaced = copy(frame)
        replaced.data = data
        return replaced

    def _note(self, *, is_replaced: bool) -> None:
        """Log and state a change of the SoC sent to the inverter."""
        if is_replaced is self._replaces:
            return
        self._replaces = is_replaced
        self.trouble = "" if is_replaced else "the inverter gets the battery's own SoC"
        text = "the inverter gets the estimated SoC" if is_replaced else self.trouble
        emit(_LOG.info if is_replaced else _LOG.warning, "inverter.soc", text)

    def _run(self) -> None:
        try:
            while not self._done.is_set():
                self._hand_on_pending()
        except Exception as error:  # noqa: BLE001 - of a driver; the thread would end unnoticed
            if not self._done.is_set():
                self.trouble = (
                    f"the inverter gets no frames any more: {error!r}; restart the service"
                )
                emit(_LOG.error, "inverter.failed", self.trouble)

    def _hand_on_pending(self) -> None:
        """Hand on what has come in both directions."""
        frames = self._battery.receive_pending(POLL_S)
        self._ever_own |= self._own_ids()
        for frame in frames:
            is_own = not frame.is_extended_id and frame.arbitration_id in self._ever_own
            if not is_own and self._is_current(frame, self._battery):
                self._hand_on(self.replaced(frame, time.monotonic()), self._inverter)
        for frame in self._inverter.receive_pending(POLL_S):
            if self._is_current(frame, self._inverter):
                self._hand_on(frame, self._battery)

    def _is_current(self, frame: can.Message, bus: ReconnectingBus) -> bool:
        """Return whether a frame is recent: it is not if it came while this process was stopped.

        The battery may have lowered its limits since, and sends the next frames at once. The
        process may stop between two frames, so that each one is checked.
        """
        has_other_clock = bus.address.stamps == "driver"
        if has_other_clock or time.time() - frame.timestamp <= DOUBT_S:
            return True
        text = f"frames of {bus.name} that had waited longer than {DOUBT_S} s are dropped"
        emit(_LOG.warning, "inverter.late", text)
        return False

    def _hand_on(self, frame: can.Message, bus: ReconnectingBus) -> None:
        """Send what a bus can carry: a frame that it cannot would count as a lost bus."""
        if bus.carries_fd or bus.is_away or not frame.is_fd:
            bus.post(frame, DOUBT_S)
            return
        bus.unsent += 1
        if bus not in self._without_fd:
            self._without_fd.append(bus)
            text = f"{bus.name} is not open for CAN FD: frames such as 0x{frame.arbitration_id:X}"
            emit(_LOG.warning, "inverter.no_fd", f"{text} are dropped")


def output_of(_config: RunConfig, _vehicle: Vehicle) -> Callable[[Service], Gateway]:
    """Return what makes the gateway; `Setup` has checked the buses."""
    return make_output


def make_output(service: Service) -> Gateway:
    """Open both buses and return the gateway; may raise InputError."""
    config = service.config.publish
    if config is None:
        raise ValueError("no [publish]")
    battery = ReconnectingBus(service.address, [])
    inverter = ReconnectingBus(inverter_address(config), [])
    battery.open()
    try:
        inverter.open()
    except InputError:
        battery.close()
        raise

    def own_ids() -> frozenset[int]:  # those of the present configuration
        asked = service.pipeline.vehicle.poll_targets if service.config.poll else ()
        return frozenset(service.pipeline.settings.ids.published).union(
            target.request_id for target in asked
        )

    text = f"frames are handed on between {battery.name} and the inverter on {inverter.name}"
    emit(_LOG.info, "inverter.ready", text, profile=config.profile)
    return Gateway(battery, inverter, soc_fields(config.profile), own_ids)
