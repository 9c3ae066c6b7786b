"""Publish a running service's state to an MQTT broker, with Home Assistant's discovery.

MQTT 3.1.1 takes few packets where nothing is subscribed. A broker may only confirm: one that sends
anything else is left, so that it cannot fill the memory. A state that cannot be sent is dropped,
since the next one replaces it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
import socket
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

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
"""A broker that does not confirm for so long counts as lost [s]. It sends the last will after half
as long again."""
CONNECT_WITHIN_S: Final = 3.0
LONGEST_PAUSE_S: Final = 30.0
"""Longest pause between attempts to connect [s]; it begins at 1 s and doubles each time."""

_KINDS: Final = {
    "CONNECT": 0x10,
    "CONNACK": 0x20,
    "PUBLISH": 0x31,  # retained, sent at most once (QoS 0)
    "PINGREQ": 0xC0,
    "PINGRESP": 0xD0,
    "DISCONNECT": 0xE0,
}
_REFUSALS: Final = {b"\4": "wrong user name or password", b"\5": "not authorised"}

_SENSORS: Final = {
    "soc_pct": ("estimate.soc_pct", "State of charge", "%", "battery", 1),
    # A class "battery" of the same unit would make two batteries of one pack.
    "soc_std_pct": (
        "estimate.soc_std_pct",
        "State of charge, standard deviation",
        "%",
        None,
        2,
    ),
    "status": ("status", "Status", None, "enum", None),
    "current_a": ("sample.current_a", "Current", "A", "current", 1),
    "voltage_v": ("sample.voltage_v", "Voltage", "V", "voltage", 1),
    "residual_v": ("estimate.residual_v", "Voltage, measured less modelled", "V", "voltage", 3),
    "temperature_c": ("sample.temperature_c", "Temperature", "°C", "temperature", 1),
    "capacity_ah": ("health.capacity_ah", "Capacity", "Ah", None, 1),
    "resistance_ratio": (
        "health.resistance_ratio",
        "Resistance relative to the model's",
        None,
        None,
        2,
    ),
    "current_offset_a": ("health.offset_a", "Current sensor offset", "A", "current", 2),
    "discharge_a": (
        "power.discharge_a",
        "Discharge current possible for 10 s",
        "A",
        "current",
        0,
    ),
    "charge_a": ("power.charge_a", "Charge current possible for 10 s", "A", "current", 0),
    "energy_kwh": ("power.energy_wh", "Energy left", "kWh", "energy_storage", 2),
    "weakest_cell": ("cells.weakest", "Weakest cell", None, None, None),
    "weakest_soc_pct": (
        "cells.soc_pct",
        "State of charge of the weakest cell",
        "%",
        None,
        1,
    ),
}
"""Sensors of Home Assistant: place of the state in a status; name, unit, class and digits."""


def state(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state to publish for a status: one flat JSON object."""
    values = {key: value_at(status, place) for key, (place, *_) in _SENSORS.items()}
    if (energy_wh := values["energy_kwh"]) is not None:
        values["energy_kwh"] = 1e-3 * energy_wh
    return values | {"reasons": status["reasons"]}


def packet(kind: str, *parts: bytes | str) -> bytes:
    """Return a packet: its kind, its length in groups of seven bits, and its parts.

    A text has its length before it.
    """
    content = b""
    for part in parts:
        if isinstance(part, str):
            content += len(part.encode()).to_bytes(2, "big") + part.encode()
        else:
            content += part
    head, left = [_KINDS[kind]], len(content)
    while left > 0x7F:
        head.append(left & 0x7F | 0x80)
        left >>= 7
    return bytes([*head, left]) + content


def message(topic: str, content: str | dict[str, Any]) -> bytes:
    """Return the packet of a text, or of an object as JSON, for a topic."""
    text = content if isinstance(content, str) else json.dumps(content, ensure_ascii=False)
    return packet("PUBLISH", topic, text.encode())


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
        self._port = config.port or (8883 if config.tls else 1883)
        self._state_topic = f"{config.topic_prefix}/{self._device}/state"
        self._availability_topic = f"{config.topic_prefix}/{self._device}/availability"
        self._latest: Snapshot | None = None
        self._tls, password = mqtt_tls(config), mqtt_password(config)
        if password is not None and self._tls is None and not is_loopback_name(config.broker):
            text = "the password is sent unencrypted: set tls = true in [mqtt]"
            self._emit(logging.WARNING, "mqtt.unencrypted", text)
        # A new session, with a last will that is confirmed and retained.
        user = [text for text in (config.user, password) if text is not None]
        flags = 0b00101110 | (0, 0x80, 0xC0)[len(user)]
        head = bytes([4, flags]) + KEEPALIVE_S.to_bytes(2, "big")
        will = self._availability_topic, "offline"
        self._connect = packet("CONNECT", "MQTT", head, f"cangauge-{self._device}", *will, *user)
        self._writer: asyncio.StreamWriter | None = None
        self._publishing = asyncio.ensure_future(self._run())

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Make a snapshot the latest one."""
        self._latest = snapshot

    def close(self) -> None:
        """Say goodbye to the broker, which then forgets the last will; without waiting."""
        self._publishing.cancel()
        if self._writer is not None:
            self._writer.write(message(self._availability_topic, "offline") + packet("DISCONNECT"))
            self._writer.close()

    async def _run(self) -> None:
        pause_s = 1.0
        while True:
            try:
                async with asyncio.timeout(CONNECT_WITHIN_S):
                    reader, writer = await asyncio.open_connection(
                        self._config.broker, self._port, ssl=self._tls
                    )
                    writer.write(self._connect)
                    confirmed = await reader.readexactly(4)
            except (OSError, EOFError):
                text = f"not reachable; tried again after at most {LONGEST_PAUSE_S:g} s"
                self._emit(logging.WARNING, "mqtt.unreachable", text)
            else:
                if confirmed in {packet("CONNACK", b"\0\0"), packet("CONNACK", b"\1\0")}:
                    pause_s = 1.0
                    await self._publish_to(reader, writer)
                else:
                    text = _REFUSALS.get(confirmed[3:], f"it answered 0x{confirmed.hex()}")
                    self._emit(logging.WARNING, "mqtt.refused", f"refused the connection: {text}")
                writer.close()
            await asyncio.sleep(pause_s)
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)

    async def _publish_to(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Publish until the connection is lost.

        Also while the service does not answer: its latest state then grows old.
        """
        self._emit(logging.INFO, "mqtt.connected", "connected")
        self._writer, is_new, due_s = writer, True, time.monotonic()
        try:
            while True:
                if self._latest is not None and time.monotonic() >= due_s:
                    status = self._latest.at(time.monotonic())
                    if is_new:
                        writer.writelines(self._introduction(status))
                    writer.write(message(self._state_topic, state(status)))
                    is_new, due_s = False, time.monotonic() + self._config.every_s
                writer.write(packet("PINGREQ"))
                async with asyncio.timeout(KEEPALIVE_S):
                    await writer.drain()
                    answer = await reader.readexactly(2)
                if answer != packet("PINGRESP"):
                    raise ConnectionError(f"it sent 0x{answer.hex()}, which nobody asked for")
                left_s = due_s - time.monotonic()
                await asyncio.sleep(min(max(left_s, 0.1), KEEPALIVE_S))
        except (OSError, EOFError) as error:
            reason = str(error) or type(error).__name__
            text = f"connection lost ({reason}); the estimate continues"
            self._emit(logging.WARNING, "mqtt.lost", text)
            self._writer = None

    def _introduction(self, status: Mapping[str, Any]) -> list[bytes]:
        """Return the packets that make the sensors known."""
        prefix, found = self._config.discovery_prefix, [message(self._availability_topic, "online")]
        for key in _SENSORS if prefix else ():
            topic = f"{prefix}/sensor/{self._device}/{key}/config"
            found.append(message(topic, self._sensor(key, status)))
        return found

    def _sensor(self, key: str, status: Mapping[str, Any]) -> dict[str, Any]:
        """Return Home Assistant's configuration of a sensor."""
        _, name, unit, device_class, digits = _SENSORS[key]
        availability = [{"topic": self._availability_topic}]
        if key in {"soc_pct", "soc_std_pct"}:
            # An invalid SoC is shown as unavailable, never as a number that looks sound.
            template = "{{ 'offline' if value_json.status == 'invalid' else 'online' }}"
            availability.append({"topic": self._state_topic, "value_template": template})
        content: dict[str, Any] = {
            "name": name,
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
            "unit_of_measurement": unit,
            "device_class": device_class,
            "suggested_display_precision": digits,
        }
        if device_class == "enum":
            content["options"] = [each.name.lower() for each in Status]
            content["json_attributes_topic"] = self._state_topic
            content["json_attributes_template"] = "{{ {'reasons': value_json.reasons} | tojson }}"
        elif key != "weakest_cell":
            content["state_class"] = "measurement"
        return {key: value for key, value in content.items() if value is not None}

    def _emit(self, level: int, event: str, text: str) -> None:
        text = f"MQTT broker {self._config.broker}:{self._port}: {text}"
        emit(_LOG, level, event, text, limit="mqtt")
