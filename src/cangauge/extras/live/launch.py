"""Start what serves networks as a child of the service: live page, HTTP and MQTT (`serve`)."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cangauge._extras import require_extra
from cangauge._logging import emit
from cangauge.errors import InputError
from cangauge.extras.live.addresses import http_addresses, mqtt_password, mqtt_tls
from cangauge.service.output import Output

if TYPE_CHECKING:
    from cangauge.bus.vehicle import Vehicle
    from cangauge.service.config import RunConfig
    from cangauge.service.run import Service
    from cangauge.service.status_client import Snapshot

END_WITHIN_S: Final = 1.5
"""Time limit for the child to end by itself [s]: MQTT says goodbye to its broker."""
_LOG = logging.getLogger("cangauge.extras.live")


class Live(Output):
    """The child process. It is not started again: a unit of its own is (`live = "unit"`).

    Parameters
    ----------
    endpoint : Path
        Status socket of the service.
    config : RunConfig

    Attributes
    ----------
    process : subprocess.Popen
    """

    def __init__(self, endpoint: Path, config: RunConfig) -> None:
        self.process = subprocess.Popen(
            # -P: modules do not come from the working folder
            [sys.executable, "-P", "-m", "cangauge.extras.live.serve"],
            stdin=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # Ctrl-C ends the service, which ends the child
            text=True,
        )
        assert self.process.stdin is not None  # noqa: S101 - as it was made
        child_config = config.model_copy(update={"status_socket": str(endpoint)})
        with suppress(BrokenPipeError), self.process.stdin as stdin:
            stdin.write(child_config.model_dump_json())

    def on_snapshot(self, snapshot: Snapshot) -> None:  # noqa: ARG002 - it asks for itself
        """Report once if the child has ended."""
        code = self.process.poll()
        if code is not None and not self.trouble:
            self.trouble = (
                f"live page, status by HTTP and MQTT have ended (exit code {code}); the estimate"
                " continues. Restart the service, or serve them by a unit of their own:"
                ' live = "unit", and `cangauge live CONFIG`'
            )
            emit(_LOG.warning, "live.ended", self.trouble, exit_code=code)

    def close(self) -> None:
        """End the child."""
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(END_WITHIN_S)
        self.process.kill()
        self.process.wait()


def check(config: RunConfig) -> None:
    """Raise InputError if what a configuration asks to serve cannot be served."""
    if config.status_socket == "off":
        problem = "live page, status by HTTP and MQTT read the status socket"
        raise InputError(problem, field="status_socket", value="off", cure="remove it")
    for key, needed in (("http", "metrics"), ("dashboard", "live"), ("mqtt", "mqtt")):
        if getattr(config, key) is not None:
            require_extra(needed, key)
    http_addresses(config)
    if config.mqtt is not None:
        mqtt_password(config.mqtt)
        mqtt_tls(config.mqtt)


def _started_by_its_unit(_service: Service) -> Output:
    return Output()


def output_of(config: RunConfig, _vehicle: Vehicle) -> Callable[[Service], Output]:
    """Return what starts the child, or nothing where it is a unit; may raise InputError."""
    if os.name != "posix":
        problem = "live page, status by HTTP and MQTT need Linux or macOS"
        raise InputError(problem, field="dashboard", cure="run without them")
    check(config)
    if config.live == "unit":
        return _started_by_its_unit

    def start(service: Service) -> Output:
        if service.endpoint is None:
            problem = "live page, status by HTTP and MQTT need it, and it cannot be opened"
            raise InputError(problem, field="status_socket", cure="name a path for it")
        for address in http_addresses(config).values():
            address.listen().close()  # refused here if it is taken
        return Live(service.endpoint, config)

    return start
