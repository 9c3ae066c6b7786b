"""The process that speaks to networks: the live page, status and metrics, MQTT.

`python -m cangauge.extras.live.process` is started by `launch`. The first line on stdin says what
to serve, on which inherited sockets; each further line is a snapshot of the service. Lines on
stdout go to the service. The end of stdin ends the process.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import threading
from collections.abc import Mapping
from typing import IO, Any, Final

from cangauge._logging import emit
from cangauge.service.events import RateLimitedHandler
from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot

NICE: Final = 5
"""Lower priority, so that the estimate comes first."""
ALIVE_EVERY_S: Final = 1.0
_LINE_BYTES: Final = 1 << 20

_LOG = logging.getLogger("cangauge.extras.live")  # this module is `__main__`
_TELLING: Final = threading.Lock()


def tell(**content: object) -> None:
    """Send the service a line; from any thread."""
    left = json.dumps(content).encode() + b"\n"
    with _TELLING:
        while left:
            left = left[os.write(1, left) :]


class _Told(RateLimitedHandler):
    """Hands the events of this process to the service, which writes them as its own."""

    def emit(self, record: logging.LogRecord) -> None:
        fields = dict(getattr(record, "fields", {}))
        if hasattr(record, "suppressed"):
            fields["repeats_suppressed"] = record.suppressed
        event = str(getattr(record, "event", "live.log"))
        tell(
            log={
                "logger": record.name,
                "level": record.levelno,
                "event": event,
                "text": record.getMessage(),
                "limit": str(getattr(record, "limit", event)),
                "fields": fields,
            }
        )


def outputs_of(asks: Mapping[str, Any]) -> list[Output]:
    """Return what is asked for, each on the running loop; imported only where it is."""
    outputs: list[Output] = []
    if "http" in asks:
        from cangauge.extras.live.http import StatusServer  # noqa: PLC0415

        outputs.append(StatusServer(**asks["http"]))
    if "dashboard" in asks:
        from cangauge.extras.live.server import LivePage  # noqa: PLC0415

        outputs.append(LivePage(**asks["dashboard"]))
    if "mqtt" in asks:
        from cangauge.extras.live.addresses import MqttOptions  # noqa: PLC0415
        from cangauge.extras.live.mqtt import MqttPublisher  # noqa: PLC0415

        outputs.append(MqttPublisher(MqttOptions(**asks["mqtt"])))
    return outputs


async def _serve(asks: Mapping[str, Any], lines: IO[bytes], told: RateLimitedHandler) -> None:
    reader = asyncio.StreamReader(limit=_LINE_BYTES)
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), lines)

    async def tell_that_it_lives() -> None:
        while True:
            tell(alive=True)
            told.release_due()
            await asyncio.sleep(ALIVE_EVERY_S)

    living = asyncio.ensure_future(tell_that_it_lives())
    outputs = outputs_of(asks)
    os.nice(NICE)  # once it has started
    while line := await reader.readline():
        snapshot = Snapshot(**json.loads(line))
        for output in outputs:
            output.on_snapshot(snapshot)
    living.cancel()
    for output in outputs:
        output.close()


def main() -> None:
    """Serve until stdin ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the service ends this process
        signal.signal(number, signal.SIG_IGN)
    lines = open(0, "rb", buffering=0)  # noqa: SIM115 - stdin, which ends with the process
    asks: Mapping[str, Any] = json.loads(lines.readline())
    told = _Told()
    logging.getLogger().handlers[:] = [told]
    logging.getLogger("cangauge").setLevel(asks["level"])
    try:
        asyncio.run(_serve(asks, lines, told))
    except RuntimeError as error:  # no thread can be started; the service tries again
        emit(_LOG, logging.ERROR, "live.failed", str(error))


if __name__ == "__main__":
    main()
