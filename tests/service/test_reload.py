"""Reloading the configuration: what changes, what needs a restart, what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from functools import cache, partial
from itertools import groupby
from pathlib import Path

import can
import pytest

from cangauge._resources import shared_file
from cangauge.service.config import RunConfig, load_config
from cangauge.service.run import Service
from cangauge.service.setup import read_setup
from cangauge.types import Reason
from faults.large_dbc import SIGNALS
from live import LoggedLines, frames_of, leaf_model_path, short_log

MAP = 'dbc = ["pack.dbc"]\nname = "car"\ntemperature_source = "pack"\n' + SIGNALS


@cache
def drive_frames() -> list[list[can.Message]]:
    """Return the frames of each sample of a drive."""
    frames = frames_of(short_log(200.0))
    return [list(some) for _, some in groupby(frames, lambda each: each.timestamp)]


class Car:
    """A pipeline with its configuration file, its frames, and what was said."""

    def __init__(self, folder: Path, text: str = "") -> None:
        self.path = folder / "car.toml"
        self.model = folder / "model.json"
        shutil.copy(leaf_model_path(), self.model)
        self.write(text)
        self.service = Service(self.path)
        self.pipeline = self.service.pipeline
        self.logged = LoggedLines("cangauge.service.run")
        self.said = self.logged.lines

    def write(self, text: str) -> None:
        self.path.write_text(f'model = "model.json"\ninitial_soc = 80\n{text}')

    def drive(self, first: int, last: int) -> list[can.Message]:
        sent: list[can.Message] = []
        for frames in drive_frames()[first:last]:
            for frame in frames:
                self.pipeline.handle(can.Message.__copy__(frame))
            sent += self.pipeline.heartbeat()
        return sent

    def reload(self, text: str | None = None) -> bool:
        """Read the file, with another text if one is given; return whether it is used."""
        if text is not None:
            self.write(text)
        return self.service.apply(read_setup(partial(load_config, self.path))) is None


@pytest.fixture
def car(tmp_path: Path) -> Iterator[Car]:
    car = Car(tmp_path)
    car.drive(0, 1000)
    with car.logged:
        yield car


def test_a_reload_of_timeouts_leaves_the_estimate_bit_for_bit(car: Car, tmp_path: Path) -> None:
    assert car.reload("timeout_s = 0.5\nuntil_idle_s = 9\n")
    assert (car.service.config.timeout_s, car.service.config.until_idle_s) == (0.5, 9.0)
    assert car.said == ["configuration reloaded; changed: timeout_s, until_idle_s"]
    car.drive(1000, 1200)
    (tmp_path / "undisturbed").mkdir()
    undisturbed = Car(tmp_path / "undisturbed")
    undisturbed.drive(0, 1200)
    assert car.pipeline.latest == undisturbed.pipeline.latest


def test_another_model_in_the_same_file_takes_soc_over(car: Car) -> None:
    before = car.pipeline.latest
    text = json.loads(car.model.read_text())
    text["capacity_ah"] *= 0.9
    text["published"]["coefficients"]["k0"]["value"] += 1.0
    car.model.write_text(json.dumps(text))
    assert car.reload("")
    car.drive(1000, 1001)
    after = car.pipeline.latest
    assert after.soc_pct == pytest.approx(before.soc_pct, abs=0.25 * before.soc_std_pct)
    assert after.soc_std_pct == pytest.approx(before.soc_std_pct, rel=0.05)
    assert not after.reasons & Reason.DELAY_LINE_FILLING
    assert after.voltage_model_v != pytest.approx(before.voltage_model_v, abs=0.2)
    assert car.pipeline.samples == 1001


def test_a_reload_ignores_the_initial_soc(car: Car) -> None:
    before = car.pipeline.latest
    assert car.reload("initial_soc_std = 20\n")
    car.path.write_text('model = "model.json"\ninitial_soc = 20\n')
    assert car.reload()
    car.drive(1000, 1001)
    assert car.pipeline.latest.soc_pct == pytest.approx(before.soc_pct, abs=0.05)
    # Nor where none is known yet: the first one stays.
    car.write("")
    fresh = Car(car.path.parent)
    fresh.path.write_text('model = "model.json"\ninitial_soc = 20\n')
    assert fresh.reload()
    fresh.drive(0, 10)
    assert fresh.pipeline.latest.soc_pct == pytest.approx(80.0, abs=1.0)


def test_published_ids_change_and_their_counters_go_on(car: Car) -> None:
    """The counter is in the low bits of the second byte."""
    sent = car.drive(1000, 1020)
    assert {each.arbitration_id for each in sent} == {0x5A0, 0x5A1, 0x5A2, 0x5A3}
    last = [each.data[1] & 15 for each in sent if each.arbitration_id == 0x5A0][-1]
    assert car.reload("[ids]\nsoc_estimate = 0x100\n")
    sent = car.drive(1020, 1042)
    assert {each.arbitration_id for each in sent} == {0x100, 0x5A1, 0x5A2, 0x5A3}
    first = next(each for each in sent if each.arbitration_id == 0x100)
    assert first.data[1] & 15 == (last + 1) % 16


def test_another_name_of_the_model_keeps_the_signals_health(car: Car) -> None:
    car.model.write_text(car.model.read_text().replace('"name": "', '"name": "second '))
    decoder = car.pipeline.decoder
    assert car.reload("")
    assert car.pipeline.decoder is decoder


def test_a_reload_changes_the_vehicle_and_keeps_counts(car: Car) -> None:
    frames, wanted = car.pipeline.counts["frames"], car.pipeline.decoder.statistics.wanted
    assert car.reload('vehicle = "leaf_aze0"\n')
    assert car.pipeline.decoder.statistics.wanted == wanted > 0
    car.drive(1000, 1100)  # the frames of the other car: not wanted now
    assert car.pipeline.samples == 1000
    assert car.pipeline.counts["frames"] > frames
    assert 0x1DB in [each["can_id"] for each in car.pipeline.filters]
    assert car.reload("")
    car.drive(1100, 1110)
    assert car.pipeline.samples >= 1009


def test_a_dbc_or_map_that_changed_is_noticed(tmp_path: Path) -> None:
    shutil.copy(shared_file("dbc", "generic_pack.dbc"), tmp_path / "pack.dbc")
    (tmp_path / "map.toml").write_text(MAP)
    car = Car(tmp_path, 'map = "map.toml"\n')
    car.drive(0, 100)
    temperature_c = car.pipeline.latest_sample.temperature_c  # type: ignore[union-attr] # there is one
    (tmp_path / "map.toml").write_text(MAP + "offset = 5\n")
    assert car.reload()
    car.drive(100, 200)
    assert car.pipeline.latest_sample.temperature_c == pytest.approx(  # type: ignore[union-attr] # as above
        temperature_c + 5.0, abs=1.0
    )


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ("timeout_s = -1", "timeout_s"),
        ('map = "nowhere.toml"', "nowhere.toml"),
        ("[ids]\nsoc_estimate = 0x100\nsoc_detail = 0x900", "soc_detail"),
        ('vehicle = "leaf_aze0"\n[ids]\nsoc_estimate = 0x1DB\n', "0x1DB"),
        ('method = "coulomb"\n[ids]\nsoc_estimate = 0x100\n[limits]\nmin_voltage_v = 500\n', ""),
        (b'{"format": "cangauge-model"', "model.json"),
    ],
)
def test_an_invalid_configuration_or_model_is_refused_as_a_whole(
    car: Car, text: str | bytes, say: str
) -> None:
    pipeline = car.pipeline
    before = (pipeline.settings, pipeline.filters, pipeline.estimator, pipeline.latest)
    if isinstance(text, bytes):
        car.model.write_bytes(text)
        text = "timeout_s = 0.5\n"
    assert not car.reload(text)
    assert len(car.said) == 1
    assert car.said[0].startswith("warning: new configuration refused, the old one stays: ")
    assert say in car.said[0]
    assert "\n" not in car.said[0]
    assert (pipeline.settings, pipeline.filters, pipeline.estimator, pipeline.latest) == before
    assert 0x5A0 in {each.arbitration_id for each in car.drive(1000, 1001)}
    assert pipeline.samples == 1001


def test_an_error_of_a_library_refuses_the_configuration() -> None:
    def fail() -> RunConfig:
        raise RuntimeError("deep inside")

    assert "cannot be read: RuntimeError('deep inside')" in str(read_setup(fail))


def test_keys_that_need_a_restart_are_logged_and_unchanged(car: Car) -> None:
    text = 'channel = "can5"\ntime_source = "replay-clock"\n[ids]\nreplay_clock = 0x111\n'
    assert car.reload(text)
    assert car.pipeline.settings.time_source == "receive"
    assert car.pipeline.settings.ids.replay_clock == 0x5AF
    assert car.said[1] == (
        "warning: channel, time_source, ids.replay_clock: takes effect after a restart of"
        " the service"
    )
