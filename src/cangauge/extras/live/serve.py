"""Serve a running service over networks: the live page, status and metrics by HTTP, and MQTT.

One program, a client of the service's status socket. It runs as `cangauge live`, or as a child of
`cangauge run`. Nothing that happens here can delay the estimate. It ends when the service ends.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import time
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Final

from cangauge._logging import emit
from cangauge.errors import CangaugeError
from cangauge.extras.live.addresses import http_addresses
from cangauge.service.config import RunConfig
from cangauge.service.events import logging_to, release_held
from cangauge.service.output import Output
from cangauge.service.status_client import (
    SHOW_EVERY_S,
    NotRunningError,
    Snapshot,
    fetch_status,
    is_served,
)

NICE: Final = 5
"""Lower priority, so that the estimate comes first."""
_LOG = logging.getLogger("cangauge.extras.live")  # this module may be `__main__`


def outputs_of(config: RunConfig, bus: str) -> list[Output]:
    """Return what a configuration asks to serve, on the running loop.

    Parameters
    ----------
    config : RunConfig
    bus : str
        Name of the service's bus.

    Raises
    ------
    InputError
        If an address cannot be bound, or a secret cannot be read.
    """
    outputs: list[Output] = []
    addresses = http_addresses(config)
    if (address := addresses.get("http")) is not None:
        from cangauge.extras.live.http import STATUS, Site  # noqa: PLC0415

        outputs.append(Site(address, "status: http://{}/status", STATUS))
    if (address := addresses.get("dashboard")) is not None:
        from cangauge.extras.live.server import LivePage  # noqa: PLC0415

        outputs.append(LivePage(address))
    if config.mqtt is not None:
        from cangauge.extras.live.mqtt import MqttPublisher  # noqa: PLC0415

        outputs.append(MqttPublisher(config.mqtt, bus))
    return outputs


def serve(endpoint: Path, config: RunConfig) -> None:
    """Serve until the service ends, or until SIGINT or SIGTERM.

    Parameters
    ----------
    endpoint : Path
        Status socket of the service.
    config : RunConfig

    Raises
    ------
    NotRunningError
        If no service answers at the start.
    InputError
        As of `outputs_of`.
    """
    bus = fetch_status(endpoint)["bus"]
    with suppress(asyncio.CancelledError):
        asyncio.run(_serve(endpoint, config, bus))


async def _serve(endpoint: Path, config: RunConfig, bus: str) -> None:
    task = asyncio.current_task()
    assert task is not None  # noqa: S101 - within asyncio.run
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    with ExitStack() as stack:
        outputs = [stack.enter_context(closing(each)) for each in outputs_of(config, bus)]
        os.nice(NICE)  # once it has started
        while True:
            began_s = time.monotonic()
            try:
                status = await asyncio.to_thread(fetch_status, endpoint)
            except NotRunningError:
                # One that hangs shows as one whose latest status grows old.
                if not await asyncio.to_thread(is_served, endpoint):
                    emit(_LOG.info, "live.ended", f"the service at {endpoint} has ended")
                    return
            else:
                snapshot = Snapshot(time.monotonic(), status)
                for output in outputs:
                    output.on_snapshot(snapshot)
            release_held()
            await asyncio.sleep(began_s + SHOW_EVERY_S - time.monotonic())


def main() -> None:
    """Run as a child of `cangauge run`, which writes its configuration on stdin.

    `status_socket` there is the path of the socket.
    """
    config = RunConfig.model_validate_json(sys.stdin.read())
    with logging_to(config.log_format, config.log_level):
        try:
            serve(Path(config.status_socket), config)
        except (CangaugeError, RuntimeError) as error:  # RuntimeError: no thread can be started
            emit(_LOG.error, "live.failed", str(error))
            sys.exit(1)


if __name__ == "__main__":
    main()
