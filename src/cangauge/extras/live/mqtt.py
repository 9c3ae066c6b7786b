"""Publish a running service's state to an MQTT broker, with Home Assistant's discovery.

Needs paho-mqtt (extra `mqtt`). Two threads do the work: one publishes the latest snapshot, paho's
own one has the network. A state that cannot be sent is dropped, since the next one replaces it.
"""

from __future__ import annotations

import json
import logging
import ssl
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from paho.mqtt.client import Client, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion

from cangauge._logging import emit
from cangauge._version import __version__
from cangauge.extras.live.addresses import MqttOptions, is_loopback_name
from cangauge.service.output import Output
from cangauge.service.status_client import Snapshot, value_at
from cangauge.types import Status

_LOG = logging.getLogger(__name__)

KEEPALIVE_S: Final = 10
"""A broker that is silent for this and half as long again counts as lost [s]."""
CONNECT_WITHIN_S: Final = 3.0
RETRY_S: Final = (1, 30)
"""First and longest pause between attempts to connect, doubled each time [s]."""
LEAVE_WITHIN_S: Final = 0.5
"""Time limit for saying goodbye to the broker [s]."""


@dataclass(frozen=True, slots=True)
class _Sensor:
    """One sensor of Home Assistant, and the place of its state in a status."""

    key: str
    place: str
    name: str
    unit: str | None = None
    device_class: str | None = None
    digits: int | None = None
    needs_soc: bool = False


_SENSORS: Final = (
    _Sensor("soc_pct", "estimate.soc_pct", "State of charge", "%", "battery", 1, needs_soc=True),
    # A class "battery" of the same unit would make two batteries of one pack.
    _Sensor(
        "soc_std_pct",
        "estimate.soc_std_pct",
        "State of charge, standard deviation",
        "%",
        None,
        2,
        needs_soc=True,
    ),
    _Sensor("status", "status", "Status", None, "enum"),
    _Sensor("current_a", "sample.current_a", "Current", "A", "current", 1),
    _Sensor("voltage_v", "sample.voltage_v", "Voltage", "V", "voltage", 1),
    _Sensor(
        "residual_v", "estimate.residual_v", "Voltage, measured less modelled", "V", "voltage", 3
    ),
    _Sensor("temperature_c", "sample.temperature_c", "Temperature", "°C", "temperature", 1),
    _Sensor("capacity_ah", "health.capacity_ah", "Capacity", "Ah", None, 1),
    _Sensor(
        "resistance_ratio",
        "health.resistance_ratio",
        "Resistance relative to the model's",
        None,
        None,
        2,
    ),
    _Sensor("current_offset_a", "health.offset_a", "Current sensor offset", "A", "current", 2),
    _Sensor(
        "discharge_a", "power.discharge_a", "Discharge current possible for 10 s", "A", "current", 0
    ),
    _Sensor("charge_a", "power.charge_a", "Charge current possible for 10 s", "A", "current", 0),
    _Sensor("energy_kwh", "power.energy_wh", "Energy left", "kWh", "energy_storage", 2),
    _Sensor("weakest_cell", "cells.weakest", "Weakest cell"),
    _Sensor(
        "weakest_soc_pct", "cells.soc_pct", "State of charge of the weakest cell", "%", None, 1
    ),
)


def state(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state to publish for a status: one flat JSON object."""
    values = {sensor.key: value_at(status, sensor.place) for sensor in _SENSORS}
    if (energy_wh := values["energy_kwh"]) is not None:
        values["energy_kwh"] = 1e-3 * energy_wh
    return values | {"reasons": status["reasons"]}


class MqttPublisher(Output):
    """Publish the latest snapshot from a thread, every `every_s` [s].

    The state is one JSON object at `TOPIC_PREFIX/DEVICE/state`.
    `TOPIC_PREFIX/DEVICE/availability` is "online" or, also by the last will, "offline". Both are
    retained. Without a `discovery_prefix` Home Assistant finds nothing.
    """

    def __init__(self, options: MqttOptions) -> None:
        self._place = f"{options.broker}:{options.port}"
        self._device, self._every_s = options.device, options.every_s
        self._discovery_prefix = options.discovery_prefix
        self._state_topic = f"{options.topic_prefix}/{options.device}/state"
        self._availability_topic = f"{options.topic_prefix}/{options.device}/availability"
        self._latest: Snapshot | None = None
        self._done = threading.Event()
        self._is_new = threading.Event()
        name = f"cangauge-{options.device}"
        self._client = client = Client(CallbackAPIVersion.VERSION2, client_id=name)
        client.connect_timeout = CONNECT_WITHIN_S
        client.reconnect_delay_set(*RETRY_S)
        client.will_set(self._availability_topic, "offline", qos=1, retain=True)
        client.max_queued_messages_set(1)
        if options.user is not None:
            client.username_pw_set(options.user, options.password)
        if options.tls:
            client.tls_set_context(ssl.create_default_context(cafile=options.ca_file))
        elif options.password is not None and not is_loopback_name(options.broker):
            text = f"the password for {self._place} is sent unencrypted: set tls = true in [mqtt]"
            emit(_LOG, logging.WARNING, "mqtt.unencrypted", text)
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_connect_fail = self._on_connect_fail
        client.connect_async(options.broker, options.port, KEEPALIVE_S)
        client.loop_start()
        self._thread = threading.Thread(target=self._run, name="cangauge-mqtt", daemon=True)
        self._thread.start()

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Make a snapshot the latest one."""
        self._latest = snapshot

    def close(self) -> None:
        """Say goodbye to the broker, within a limited time."""
        self._done.set()
        self._thread.join(2.0 * LEAVE_WITHIN_S)

    def _run(self) -> None:
        try:
            while not self._done.wait(self._every_s):
                self._publish()
            if self._client.is_connected():
                # A clean end makes the broker forget the last will.
                self._send(self._availability_topic, "offline").wait_for_publish(LEAVE_WITHIN_S)
            self._client.disconnect()
        except Exception as error:  # noqa: BLE001 - an error here must not end the page
            emit(_LOG, logging.ERROR, "mqtt.failed", f"MQTT has ended: {error!r}")

    def _publish(self) -> None:
        if self._latest is None or not self._client.is_connected():
            return
        status = self._latest.at(time.monotonic())
        if self._is_new.is_set():
            self._is_new.clear()
            if self._discovery_prefix:
                for sensor in _SENSORS:
                    topic = f"{self._discovery_prefix}/sensor/{self._device}/{sensor.key}/config"
                    self._send(topic, json.dumps(self._found(sensor, status), ensure_ascii=False))
            self._send(self._availability_topic, "online")
        self._send(self._state_topic, json.dumps(state(status), ensure_ascii=False))

    def _found(self, sensor: _Sensor, status: Mapping[str, Any]) -> dict[str, Any]:
        """Return Home Assistant's configuration of a sensor."""
        availability = [{"topic": self._availability_topic}]
        if sensor.needs_soc:
            # An invalid SoC is shown as unavailable, never as a number that looks sound.
            template = "{{ 'offline' if value_json.status == 'invalid' else 'online' }}"
            availability.append({"topic": self._state_topic, "value_template": template})
        content: dict[str, Any] = {
            "name": sensor.name,
            "unique_id": f"{self._device}_{sensor.key}",
            "state_topic": self._state_topic,
            "value_template": f"{{{{ value_json.{sensor.key} }}}}",
            "availability": availability,
            "availability_mode": "all",
            "device": {
                "identifiers": [self._device],
                "name": f"Battery on {status['bus']}",
                "manufacturer": "cangauge",
                "model": status["vehicle"],
                "sw_version": __version__,
            },
            "unit_of_measurement": sensor.unit,
            "device_class": sensor.device_class,
            "suggested_display_precision": sensor.digits,
        }
        if sensor.device_class == "enum":
            content["options"] = [each.name.lower() for each in Status]
            content["json_attributes_topic"] = self._state_topic
            content["json_attributes_template"] = "{{ {'reasons': value_json.reasons} | tojson }}"
        elif sensor.key != "weakest_cell":
            content["state_class"] = "measurement"
        return {key: value for key, value in content.items() if value is not None}

    def _send(self, topic: str, text: str) -> MQTTMessageInfo:
        # QoS 0: unlike the others it is never queued for a broker that is away.
        return self._client.publish(topic, text, qos=0, retain=True)

    def _on_connect(
        self, _client: Client, _userdata: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        if reason.is_failure:
            self._emit(logging.WARNING, "mqtt.refused", f"refused the connection: {reason}")
            return
        self._is_new.set()
        self._emit(logging.INFO, "mqtt.connected", "connected")

    def _on_disconnect(
        self, _client: Client, _userdata: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        if not self._done.is_set():
            text = f"connection lost ({reason}); the estimate continues"
            self._emit(logging.WARNING, "mqtt.lost", text)

    def _on_connect_fail(self, _client: Client, _userdata: object) -> None:
        text = f"not reachable; tried again after at most {RETRY_S[1]} s"
        self._emit(logging.WARNING, "mqtt.unreachable", text)

    def _emit(self, level: int, event: str, text: str) -> None:
        emit(_LOG, level, event, f"MQTT broker {self._place}: {text}", limit="mqtt")
