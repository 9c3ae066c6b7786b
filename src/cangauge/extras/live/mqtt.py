"""Publish a running service's state to an MQTT broker, with Home Assistant's discovery.

Needs paho-mqtt (extra `mqtt`), whose thread does the network I/O. A state that cannot be sent is
dropped, because the next one replaces it. Nothing is subscribed. If the broker sends a message
anyway, the connection is closed: paho keeps messages of QoS 2 without a limit.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
import socket
import time
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from paho.mqtt.client import Client, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion

from cangauge._logging import emit
from cangauge._version import __version__
from cangauge.extras.live.addresses import is_loopback_name, mqtt_password, mqtt_tls
from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot, value_at
from cangauge.types import Status

if TYPE_CHECKING:
    from cangauge.service.config import MqttConfig

_LOG = logging.getLogger(__name__)

KEEPALIVE_S: Final = 10
"""A broker that is silent for this and half as long again counts as lost [s]."""
CONNECT_WITHIN_S: Final = 3.0
RETRY_S: Final = (1, 30)
"""First and longest pause between attempts to connect, doubled each time [s]."""
LEAVE_WITHIN_S: Final = 0.5
"""Time limit for saying goodbye to the broker [s]."""
_SENSORS: Final = tomllib.loads(
    Path(__file__).with_name("sensors.toml").read_text(encoding="utf-8")
)
"""Sensors of Home Assistant: place of the state in a status, and settings."""


def state(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state to publish for a status: one flat JSON object."""
    values = {key: value_at(status, each["place"]) for key, each in _SENSORS.items()}
    if (energy_wh := values["energy_kwh"]) is not None:
        values["energy_kwh"] = 1e-3 * energy_wh
    return values | {"reasons": status["reasons"]}


class MqttPublisher(Output):
    """Publish the latest snapshot on the running loop, every `every_s` [s].

    The state is one JSON object at `TOPIC_PREFIX/DEVICE/state`.
    `TOPIC_PREFIX/DEVICE/availability` is "online" or, also by the last will, "offline". Both are
    retained. Without a `discovery_prefix` Home Assistant finds nothing.

    Parameters
    ----------
    config : MqttConfig
    bus : str
        Name of the service's bus, in the default name of the device.

    Raises
    ------
    InputError
        If the password or the certificates cannot be read.
    """

    def __init__(self, config: MqttConfig, bus: str) -> None:
        default = re.sub(r"[^A-Za-z0-9_-]+", "_", f"cangauge_{socket.gethostname()}_{bus}")
        self._config, self._device = config, config.device or default
        port = config.port or (8883 if config.tls else 1883)
        self._place = f"{config.broker}:{port}"
        self._state_topic = f"{config.topic_prefix}/{self._device}/state"
        self._availability_topic = f"{config.topic_prefix}/{self._device}/availability"
        self._latest: Snapshot | None = None
        self._is_new = self._is_closed = False
        name = f"cangauge-{self._device}"
        self._client = client = Client(CallbackAPIVersion.VERSION2, client_id=name)
        client.connect_timeout = CONNECT_WITHIN_S
        client.reconnect_delay_set(*RETRY_S)
        client.will_set(self._availability_topic, "offline", qos=1, retain=True)
        client.max_queued_messages_set(1)
        password, context = mqtt_password(config), mqtt_tls(config)
        if config.user is not None:
            client.username_pw_set(config.user, password)
        if context is not None:
            client.tls_set_context(context)
        elif password is not None and not is_loopback_name(config.broker):
            text = f"the password for {self._place} is sent unencrypted: set tls = true in [mqtt]"
            emit(_LOG.warning, "mqtt.unencrypted", text)
        client.on_log = self._on_log
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_connect_fail = self._on_connect_fail
        client.connect_async(config.broker, port, KEEPALIVE_S)
        client.loop_start()
        self._publishing = asyncio.ensure_future(self._run())

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Make a snapshot the latest one."""
        self._latest = snapshot

    def close(self) -> None:
        """Say goodbye to the broker, within a limited time."""
        self._is_closed = True
        self._publishing.cancel()
        if self._client.is_connected():
            # A clean end makes the broker forget the last will.
            self._send(self._availability_topic, "offline").wait_for_publish(LEAVE_WITHIN_S)
        self._client.disconnect()

    async def _run(self) -> None:
        """Publish; also while the service does not answer, whose latest state grows old."""
        while True:
            await asyncio.sleep(self._config.every_s)
            if self._latest is not None and self._client.is_connected():
                self._publish(self._latest.at(time.monotonic()))

    def _publish(self, status: Mapping[str, Any]) -> None:
        if self._is_new:
            self._is_new = False
            if prefix := self._config.discovery_prefix:
                for key in _SENSORS:
                    topic = f"{prefix}/sensor/{self._device}/{key}/config"
                    self._send(topic, json.dumps(self._found(key, status), ensure_ascii=False))
            self._send(self._availability_topic, "online")
        self._send(self._state_topic, json.dumps(state(status), ensure_ascii=False))

    def _found(self, key: str, status: Mapping[str, Any]) -> dict[str, Any]:
        """Return Home Assistant's configuration of a sensor."""
        availability = [{"topic": self._availability_topic}]
        if key in {"soc_pct", "soc_std_pct"}:
            # An invalid SoC is shown as unavailable, never as a number that looks sound.
            template = "{{ 'offline' if value_json.status == 'invalid' else 'online' }}"
            availability.append({"topic": self._state_topic, "value_template": template})
        content: dict[str, Any] = {
            "unique_id": f"{self._device}_{key}",
            "state_topic": self._state_topic,
            "value_template": f"{{{{ value_json.{key} }}}}",
            "availability": availability,
            "availability_mode": "all",
            "device": {
                "identifiers": [self._device],
                "name": f"Battery on {status['bus']}",
                "manufacturer": "cangauge",
                "model": status["vehicle"],
                "sw_version": __version__,
            },
            **_SENSORS[key]["settings"],
        }
        if key == "status":
            content["options"] = [each.name.lower() for each in Status]
            content["json_attributes_topic"] = self._state_topic
            content["json_attributes_template"] = "{{ {'reasons': value_json.reasons} | tojson }}"
        return content

    def _send(self, topic: str, text: str) -> MQTTMessageInfo:
        # QoS 0: unlike the others it is never queued for a broker that is away.
        return self._client.publish(topic, text, qos=0, retain=True)

    def _on_log(self, client: Client, _userdata: object, _level: object, text: str) -> None:
        # paho reports a message of QoS 2 before its release in its log only.
        connection = client.socket()
        if text.startswith("Received PUBLISH") and isinstance(connection, socket.socket):
            self._emit(_LOG.warning, "mqtt.flooded", "it sent a message without a subscription")
            with suppress(OSError):  # the broker has closed it
                connection.shutdown(socket.SHUT_RDWR)

    def _on_connect(
        self, _client: Client, _userdata: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        if reason.is_failure:
            self._emit(_LOG.warning, "mqtt.refused", f"refused the connection: {reason}")
            return
        self._is_new = True
        self._emit(_LOG.info, "mqtt.connected", "connected")

    def _on_disconnect(
        self, _client: Client, _userdata: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        if not self._is_closed:
            text = f"connection lost ({reason}); the estimate continues"
            self._emit(_LOG.warning, "mqtt.lost", text)

    def _on_connect_fail(self, _client: Client, _userdata: object) -> None:
        text = f"not reachable; tried again after at most {RETRY_S[1]} s"
        self._emit(_LOG.warning, "mqtt.unreachable", text)

    def _emit(self, log: Any, event: str, text: str) -> None:
        emit(log, event, f"MQTT broker {self._place}: {text}")
