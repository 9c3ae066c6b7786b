"""Serve a running service over networks: the live page, status and metrics by HTTP, and MQTT.

One program, a client of the service's status socket. It runs as `cangauge live`, or as a child of
`cangauge run`. Nothing that happens here can delay the estimate. It ends when the service ends.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import sys
import time
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from socket import socket
from typing import Any, Final

from cangauge._logging import emit
from cangauge.errors import CangaugeError
from cangauge.extras.live.addresses import HttpAddress, MqttOptions
from cangauge.service.events import LogFormat, LogLevel, logging_to, release_held
from cangauge.service.output import Output
from cangauge.service.status_client import (
    SHOW_EVERY_S,
    EndedError,
    NotRunningError,
    Snapshot,
    fetch_status,
)

NICE: Final = 5
"""Lower priority, so that the estimate comes first."""
_LOG = logging.getLogger("cangauge.extras.live")  # this module may be `__main__`


@dataclass(frozen=True)
class Offer:
    """What a configuration asks to serve, with its secrets.

    Parameters
    ----------
    http : HttpAddress or None
        Of `/status`, `/healthz` and `/metrics`.
    dashboard : HttpAddress or None
        Of the live page.
    mqtt : MqttOptions or None
        Broker, and what to publish there.
    """

    http: HttpAddress | None = None
    dashboard: HttpAddress | None = None
    mqtt: MqttOptions | None = None

    def check_free(self) -> None:
        """Raise InputError if an address cannot be bound."""
        for address in (self.http, self.dashboard):
            if address is not None:
                address.listen().close()

    def outputs(self) -> list[Output]:
        """Return what serves on the running loop; raise InputError as `check_free`."""
        outputs: list[Output] = []
        if self.http is not None:
            from cangauge.extras.live.http import StatusServer  # noqa: PLC0415

            outputs.append(StatusServer(self.http, _listen(self.http, "status: http://{}/status")))
        if self.dashboard is not None:
            from cangauge.extras.live.server import LivePage  # noqa: PLC0415

            outputs.append(
                LivePage(self.dashboard, _listen(self.dashboard, "live page: http://{}/"))
            )
        if self.mqtt is not None:
            from cangauge.extras.live.mqtt import MqttPublisher  # noqa: PLC0415

            outputs.append(MqttPublisher(self.mqtt))
        return outputs


def _listen(address: HttpAddress, text: str) -> socket:
    """Return a listening socket, and log where it is."""
    listening = address.listen()
    port = listening.getsockname()[1]
    text = text.format(replace(address, port=port))
    token = "with a token" if address.token else "without a token"
    emit(_LOG, logging.INFO, f"{address.key}.listening", f"{text}, {token}", port=port)
    return listening


def serve(endpoint: Path, offer: Offer) -> None:
    """Serve until the service ends, or until SIGINT or SIGTERM.

    Parameters
    ----------
    endpoint : Path
        Status socket of the service.
    offer : Offer

    Raises
    ------
    NotRunningError
        If no service answers at the start.
    InputError
        If an address cannot be bound.
    """
    fetch_status(endpoint)
    with suppress(asyncio.CancelledError):
        asyncio.run(_serve(endpoint, offer))


async def _serve(endpoint: Path, offer: Offer) -> None:
    task = asyncio.current_task()
    assert task is not None  # noqa: S101 - within asyncio.run
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    with ExitStack() as stack:
        outputs = [stack.enter_context(each) for each in offer.outputs()]
        os.nice(NICE)  # once it has started
        while True:
            began_s = time.monotonic()
            # A service that does not answer shows as one whose latest status grows old.
            with suppress(NotRunningError):
                try:
                    status = await asyncio.to_thread(fetch_status, endpoint)
                except EndedError:
                    emit(_LOG, logging.INFO, "live.ended", f"the service at {endpoint} has ended")
                    return
                snapshot = Snapshot(time.monotonic(), status)
                for output in outputs:
                    output.on_snapshot(snapshot)
            release_held()
            await asyncio.sleep(began_s + SHOW_EVERY_S - time.monotonic())


def to_json(endpoint: Path, offer: Offer, log_format: LogFormat, log_level: LogLevel) -> str:
    """Return what `main` reads."""
    content = {"endpoint": str(endpoint), "offer": asdict(offer)}
    return json.dumps(content | {"log_format": log_format, "log_level": log_level})


def main() -> None:
    """Run as a child of `cangauge run`, with `to_json` on stdin: it has secrets."""
    given = json.load(sys.stdin)
    kinds: dict[str, type[Any]] = {
        "http": HttpAddress,
        "dashboard": HttpAddress,
        "mqtt": MqttOptions,
    }
    asked = {key: kinds[key](**value) for key, value in given["offer"].items() if value is not None}
    with logging_to(given["log_format"], given["log_level"]):
        try:
            serve(Path(given["endpoint"]), Offer(**asked))
        except (CangaugeError, RuntimeError) as error:  # RuntimeError: no thread can be started
            emit(_LOG, logging.ERROR, "live.failed", str(error))
            sys.exit(1)


if __name__ == "__main__":
    main()
