"""`cangauge live`: live page, status by HTTP and MQTT of a service, as a program of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cangauge.cli.options import argument


def live_command(
    config: Annotated[Path, argument("FILE.toml", "Configuration of `cangauge run`.")],
) -> None:
    """Serve the live page, the status by HTTP and MQTT of a running service.

    The settings are `dashboard`, `http`, `http_token_file` and `[mqtt]` of the service's
    configuration. The service is found by its bus, or by `status_socket`. Set `live = "unit"` in
    the configuration: `cangauge run` then does not serve these itself. `cangauge live` ends with
    the service. systemd can start both (contrib/systemd/cangauge-live@.service).

    Examples
    --------
    `cangauge live /etc/cangauge/can0.toml`
    """
    from cangauge.errors import InputError
    from cangauge.extras.live.launch import check
    from cangauge.extras.live.serve import serve
    from cangauge.service.config import load_config
    from cangauge.service.events import logging_to
    from cangauge.service.setup import address_of
    from cangauge.service.status_client import find_socket, socket_path

    loaded = load_config(config)
    if loaded.http is None and loaded.dashboard is None and loaded.mqtt is None:
        cure = 'add dashboard = "8642", http = "9464" or [mqtt]'
        raise InputError("serves nothing", source=config, cure=cure)
    with logging_to(loaded.log_format, loaded.log_level), loaded.naming_keys():
        check(loaded)
        endpoint = Path(loaded.status_socket)
        if loaded.status_socket == "auto":
            endpoint = find_socket(socket_path(str(address_of(loaded))).name)
        serve(endpoint, loaded)
