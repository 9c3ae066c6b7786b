"""The recipes of CONTRIBUTING.md, followed step by step."""

from __future__ import annotations

import can
import numpy as np
import pytest

import cangauge
from cangauge.bus.decoder import SampleDecoder
from cangauge.bus.mapping import SignalMap, TemperatureMap, VehicleMap, VoltageMap
from cangauge.bus.vehicle import PRESETS, Preset, Vehicle
from cangauge.extras.report.charts import BLUE, Figure
from cangauge.extras.report.page import Page, Tile
from cangauge.model.effects.base import Effect, Parameter
from cangauge.model.effects.library import LIBRARY
from cangauge.replay.encoder import FrameEncoder
from cangauge.types import Sample
from synthetic import synthetic_log

HEATER_DROP = Effect(
    id="heater_drop",
    fault="voltage_reading",
    parameters=(Parameter("drop_v", "V", -0.04, 0.04),),
    equation="U = OCV − drop",
    about="A constant, as an example.",
    drive=lambda load, values, *_: np.full_like(load.current_a, -values["drop_v"]),
)
"""A constant drop at every current, as a worked example."""


def test_an_effect_of_your_own_is_identified(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LIBRARY, "heater_drop", HEATER_DROP)  # type: ignore[misc] # a dict
    log = synthetic_log(hours=1.0, seed=4)
    model = cangauge.fit([log], capacity_ah=60.0).model
    entry = {"id": "heater_drop", "parameters": {"drop_v": 2.0}}
    worse = model.model_copy(update={"effects": [entry]})
    difference = model.predict(log).voltage_v - worse.predict(log).voltage_v
    assert difference == pytest.approx(2.0)


def test_a_preset_of_your_own_decodes(monkeypatch: pytest.MonkeyPatch) -> None:
    preset = Preset(
        dbc="generic_pack.dbc",
        about="an example",
        mapping=VehicleMap(
            name="mine",
            current=SignalMap(signal="current_a", sign=-1),
            voltage=VoltageMap(signal="voltage_v"),
            temperature=TemperatureMap(signal="temperature_c"),
        ),
    )
    monkeypatch.setitem(PRESETS, "mine", preset)
    vehicle = Vehicle.load("mine")
    decoder, samples = SampleDecoder(vehicle), []
    for frame in FrameEncoder(vehicle).encode(Sample(1.0, 12.0, 380.0, 21.0)):
        frame.timestamp = 1.0
        assert isinstance(frame, can.Message)
        samples.append(decoder.handle(frame))
    (sample,) = [each for each in samples if each is not None]
    assert sample.current_a == pytest.approx(12.0, abs=0.01)


def test_a_page_of_your_own_renders() -> None:
    figure = Figure("Voltage", "time [s]", "voltage [V]", "It falls.", hover="@y")
    figure.line("voltage", np.array([0.0, 1.0]), np.array([380.0, 379.0]), BLUE)
    page = Page(
        title="My page",
        lead="The voltage falls.",
        subtitle="an example",
        tiles=[Tile("voltage", "380 V")],
        sections={"One": ["Words & more", figure]},
    )
    text = page.html()
    assert "<title>My page" in text
    assert "Words &amp; more" in text
    assert "Content-Security-Policy" in text  # nothing is fetched
