"""MQTT against a real mosquitto: discovery, states, last will, and a broker that goes away."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from watched import Watched

from cangauge.errors import InputError
from cangauge.service.config import MqttConfig
from cangauge.service.run import Service
from live import Command, leaf_model_path, waits
from running import RunningService, free_port
from served import Served

MOSQUITTO = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
if MOSQUITTO is None:
    pytest.skip("mosquitto is not installed (apt-get install mosquitto)", allow_module_level=True)
mqtt = pytest.importorskip("paho.mqtt.client", reason="needs the extra cangauge[mqtt]")

PASSWORD = "made up for this test"  # noqa: S105


class Broker:
    """A mosquitto on a port of its own that keeps nothing on disk."""

    def __init__(self, folder: Path, lines: str = "allow_anonymous true\n") -> None:
        self.port = free_port()
        self._config = folder / "mosquitto.conf"
        self._config.write_text(
            f"user root\nlistener {self.port} 127.0.0.1\npersistence false\n{lines}"
        )
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [MOSQUITTO, "-c", self._config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def end(self) -> None:
        self.process.send_signal(signal.SIGCONT)
        self.process.terminate()
        self.process.wait(5.0)


class Listener:
    """The latest message of each topic, as Home Assistant would see them."""

    def __init__(self, broker: Broker, user: str | None = None, ca: Path | None = None) -> None:
        self.latest: dict[str, str] = {}
        self.retained: set[str] = set()
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self._client.reconnect_delay_set(1, 1)
        if user:
            self._client.username_pw_set(user, PASSWORD)
        if ca:
            self._client.tls_set(str(ca))
        self._client.on_connect = lambda client, *_: client.subscribe("#")
        self._client.on_message = self._take
        self._client.connect_async("127.0.0.1" if ca is None else "localhost", broker.port)
        self._client.loop_start()

    def _take(self, client: Any, data: object, message: Any) -> None:
        self.latest[message.topic] = message.payload.decode()
        if message.retain:
            self.retained.add(message.topic)

    def state(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.latest.get("cangauge/bench/state", "{}"))
        return found

    @property
    def availability(self) -> str | None:
        return self.latest.get("cangauge/bench/availability")

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.end()


@pytest.fixture
def listener(broker: Broker) -> Iterator[Listener]:
    listener = Listener(broker)
    yield listener
    listener.close()


def section(port: int, more: str = "") -> str:
    return f'[mqtt]\nbroker = "127.0.0.1"\nport = {port}\ndevice = "bench"\nevery_s = 0.2\n{more}'


def test_home_assistant_finds_sensors_and_states(
    tmp_path: Path, broker: Broker, listener: Listener
) -> None:
    with RunningService(tmp_path, section(broker.port)) as running:
        assert waits(lambda: (listener.state().get("energy_kwh") or 0.0) > 0.0)
        state = listener.state()
        estimate = running.service.pipeline.latest
        assert state["soc_pct"] == pytest.approx(estimate.soc_pct, abs=0.5)
        assert 0.0 < state["soc_std_pct"] < 14.0  # a given start may be wrong
        assert 250.0 < state["voltage_v"] < 450.0
        assert listener.availability == "online"
        sensors = {
            topic.split("/")[3]: json.loads(text)
            for topic, text in listener.latest.items()
            if topic.startswith("homeassistant/sensor/bench/")
        }
        for key, sensor in sensors.items():
            assert f"value_json.{key}" in sensor["value_template"]
            assert key in state
            assert sensor["state_topic"] == "cangauge/bench/state"
            assert sensor["availability"][0]["topic"] == "cangauge/bench/availability"
        kinds = {
            key: (each.get("device_class"), each.get("unit_of_measurement"))
            for key, each in sensors.items()
        }
        assert kinds["soc_pct"] == ("battery", "%")
        assert kinds["current_a"] == ("current", "A")
        assert kinds["energy_kwh"] == ("energy_storage", "kWh")
        assert kinds["status"] == ("enum", None)
        assert "initialising" in sensors["status"]["options"]
        # An invalid SoC is unavailable; the current is not.
        assert "'invalid'" in sensors["soc_pct"]["availability"][1]["value_template"]
        assert len(sensors["current_a"]["availability"]) == 1
        late = Listener(broker)
        assert waits(lambda: "cangauge/bench/state" in late.retained)
        assert f"homeassistant/sensor/bench/{next(iter(sensors))}/config" in late.retained
        late.close()
    assert waits(lambda: listener.availability == "offline")


def test_a_broker_that_goes_or_hangs_costs_no_sample(
    tmp_path: Path, broker: Broker, listener: Listener
) -> None:
    with RunningService(tmp_path, section(broker.port)) as running:
        assert waits(lambda: listener.availability == "online")
        broker.end()
        before = running.service.pipeline.samples
        assert waits(lambda: running.service.pipeline.samples > before + 20)
        listener.latest.clear()
        broker.start()
        # A broker without memory has discovery, availability and state again.
        assert waits(lambda: listener.availability == "online")
        assert waits(lambda: "soc_pct" in listener.state())
        assert "homeassistant/sensor/bench/soc_pct/config" in listener.latest
        # A broker that hangs delays no stop.
        broker.process.send_signal(signal.SIGSTOP)
    assert running.summary is not None
    assert running.summary["frames"]["lost"] == 0


def test_a_killed_service_is_offline(tmp_path: Path, broker: Broker, listener: Listener) -> None:
    path = tmp_path / "run.toml"
    path.write_text(
        f'model = "{leaf_model_path()}"\ninterface = "virtual"\nchannel = "x"\n'
        f'status_socket = "{tmp_path / "s.sock"}"\n{section(broker.port)}'
    )
    service = Command("run", "--config", path)
    try:
        assert waits(lambda: listener.availability == "online")
    finally:
        service.process.kill()
        service.end()
    assert waits(lambda: listener.availability == "offline")


def test_the_last_will_of_a_killed_publisher(broker: Broker, listener: Listener) -> None:
    config = MqttConfig(broker="127.0.0.1", port=broker.port, device="bench", every_s=0.2)
    with Served(Watched().monitor.latest, mqtt=config) as served:
        assert waits(lambda: listener.availability == "online")
        served.process.kill()
        assert waits(lambda: listener.availability == "offline")


@pytest.mark.parametrize("place", ["file", "environment"])
def test_password_and_tls_are_used(
    tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificate = tmp_path / "ca.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj",
         "/CN=localhost", "-addext", "subjectAltName=DNS:localhost",
         "-keyout", tmp_path / "key.pem", "-out", certificate],
        check=True, capture_output=True,
    )  # fmt: skip
    secret = tmp_path / "password"
    secret.write_text(PASSWORD + "\n")
    secret.chmod(0o600)
    subprocess.run(
        ["mosquitto_passwd", "-b", "-c", tmp_path / "users", "car", PASSWORD],
        check=True, capture_output=True,
    )  # fmt: skip
    broker = Broker(
        tmp_path,
        f"cafile {certificate}\ncertfile {certificate}\nkeyfile {tmp_path / 'key.pem'}\n"
        f"allow_anonymous false\npassword_file {tmp_path / 'users'}\n",
    )
    listener = Listener(broker, "car", certificate)
    text = section(broker.port, 'tls = true\nca_file = "ca.pem"\nuser = "car"\n')
    text = text.replace("127.0.0.1", "localhost")
    if place == "file":
        text += 'password_file = "password"\n'
    else:
        monkeypatch.setenv("CANGAUGE_MQTT_PASSWORD", PASSWORD)
    try:
        with RunningService(tmp_path, text):
            assert waits(lambda: "soc_pct" in listener.state())
    finally:
        listener.close()
        broker.end()


@pytest.mark.parametrize(
    ("lines", "field"),
    [
        ('broker = ""\n', "mqtt.broker"),
        ('broker = "b"\nport = 0\n', "mqtt.port"),
        ('broker = "b"\ntopic_prefix = "a/#"\n', "mqtt.topic_prefix"),
        ('broker = "b"\ndevice = "a/b"\n', "mqtt.device"),
        ('broker = "b"\npassword = "x"\n', "mqtt.password"),
        ('broker = "b"\npassword_file = "run.toml"\n', "mqtt.password_file"),
        ('broker = "b"\npassword_file = "short"\n', "mqtt.user"),
        ('broker = "b"\ntls = true\nca_file = "short"\n', "mqtt.ca_file"),
    ],
)
def test_a_wrong_section_is_refused_by_key(tmp_path: Path, lines: str, field: str) -> None:
    (tmp_path / "short").write_text("x\n")
    path = tmp_path / "run.toml"
    path.write_text(f'model = "{leaf_model_path()}"\n[mqtt]\n{lines}')
    with pytest.raises(InputError) as caught:
        Service(path)
    assert caught.value.field == field


def test_the_port_and_the_device_have_defaults(
    tmp_path: Path, broker: Broker, listener: Listener
) -> None:
    status = Watched().monitor.latest
    for keys, port in (({}, 1883), ({"tls": True}, 8883)):
        nowhere = MqttConfig(broker="no.such.host.invalid", **keys)
        with Served(status, mqtt=nowhere) as served:
            assert waits(lambda: served.said(f"no.such.host.invalid:{port}: not reachable"))  # noqa: B023
    with Served(status, mqtt=MqttConfig(broker="127.0.0.1", port=broker.port)):
        assert waits(lambda: any(topic.endswith("/state") for topic in listener.latest))
    states = [topic for topic in listener.latest if topic.endswith("/state")]
    assert re.fullmatch(r"cangauge/cangauge_[A-Za-z0-9_-]+_virtual_x/state", states[0])
