"""`cangauge live`: live page, status by HTTP and MQTT of a service, as a program of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cangauge.cli.options import argument, option


def live_command(
    config: Annotated[Path, argument("FILE.toml", "Configuration of `cangauge run`.")],
    *,
    endpoint: Annotated[
        Path | None,
        option(
            "--endpoint",
            "PATH",
            "Unix socket of the service. Default: the service running on this machine.",
        ),
    ] = None,
) -> None:
    """Serve the live page, the status by HTTP and MQTT of a running service.

    Reads `dashboard`, `http`, `http_token_file` and `[mqtt]` of the service's configuration. With
    `live = "unit"` there, `cangauge run` leaves them to this program. It ends when the service
    ends: systemd starts both (contrib/systemd/cangauge-live@.service).

    Examples
    --------
    `cangauge live /etc/cangauge/can0.toml --endpoint /run/cangauge/can0/status.sock`
    """
    from cangauge.errors import InputError
    from cangauge.extras.live.launch import check
    from cangauge.extras.live.serve import serve
    from cangauge.service.config import load_config
    from cangauge.service.events import logging_to
    from cangauge.service.status_client import find_socket

    loaded = load_config(config)
    if loaded.http is None and loaded.dashboard is None and loaded.mqtt is None:
        cure = 'add dashboard = "8642", http = "9464" or [mqtt]'
        raise InputError("serves nothing", source=config, cure=cure)
    with logging_to(loaded.log_format, loaded.log_level), loaded.naming_keys():
        check(loaded)
        is_auto = loaded.status_socket == "auto"
        own = find_socket() if is_auto else Path(loaded.status_socket)
        serve(endpoint or own, loaded)
