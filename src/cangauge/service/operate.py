"""Everything around the loop that operators need, opened in order and closed again."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from cangauge.bus.receive import BusPort
from cangauge.errors import InputError
from cangauge.events import emit
from cangauge.service.config import RunConfig
from cangauge.service.endpoint import Endpoint
from cangauge.service.gauge import Gauge
from cangauge.service.monitor import Monitor
from cangauge.service.notify import Notifier
from cangauge.service.record import Recorder
from cangauge.service.snapshot import Identity
from cangauge.service.status_socket import default_path, has_unix_sockets

_LOG = logging.getLogger(__name__)


@contextmanager
def operated(
    config: RunConfig, vehicle: str, gauge: Gauge, port: BusPort, recorder: Recorder | None
) -> Iterator[Monitor]:
    """Yield the monitor of a service whose status is served and of which systemd knows.

    Raises
    ------
    InputError
        If something was asked for that cannot be served. A status socket that nobody asked for
        is done without.
    """
    identity = Identity(
        bus=port.name,
        vehicle=vehicle,
        model=config.model,
        method=config.method,
        time_source=config.time_source,
        began_s=time.time(),
    )
    with ExitStack() as stack:
        notifier = Notifier.from_environment()
        stack.callback(notifier.close)
        monitor = Monitor(gauge, port, identity=identity, notifier=notifier, record=recorder)
        _serve(config, monitor, stack)
        emit(
            _LOG,
            logging.INFO,
            "service.ready",
            f"listening on {port.name}; time source: {config.time_source}; Ctrl-C ends",
            bus=port.name,
            vehicle=vehicle,
            model=config.model,
        )
        notifier.ready(f"listening on {port.name}")
        stack.callback(notifier.stopping)
        yield monitor


def _serve(config: RunConfig, monitor: Monitor, stack: ExitStack) -> None:
    unix_path = config.unix_path()
    if config.status_socket == "auto" and has_unix_sockets():
        try:
            unix_path = default_path(monitor.latest.identity.bus)
        except InputError as error:
            emit(_LOG, logging.WARNING, "status.unavailable", f"no status socket: {error}")
    http = config.http_address()
    if unix_path is None and http is None:
        return
    endpoint = Endpoint(lambda: monitor.latest, unix_path=unix_path, http=http)
    stack.enter_context(endpoint)
    if unix_path is not None:
        emit(_LOG, logging.DEBUG, "status.listening", f"status at {unix_path}", path=str(unix_path))
    if http is not None:
        emit(
            _LOG,
            logging.INFO,
            "http.listening",
            f"http://{http.host}:{endpoint.port}/metrics"
            + (", with a token" if http.token else ", without a token"),
            port=endpoint.port,
        )
