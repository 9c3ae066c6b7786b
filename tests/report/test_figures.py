"""Figures and HTML of results, as a notebook shows them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bokeh.embed import json_item

import cangauge
from cangauge.diagnosis import Diagnosis
from cangauge.identify.identification import Identification
from cangauge.logs.log import Log
from cangauge.model.published import CAPACITY_AH
from synthetic import synthetic_log


@pytest.fixture(scope="module")
def drive() -> Log:
    return synthetic_log(hours=0.6, start_pct=85.0, end_pct=60.0, noise_v=0.3, name="<drive>")


@pytest.fixture(scope="module")
def identified(drive: Log) -> Identification:
    return cangauge.fit([drive], capacity_ah=CAPACITY_AH)


@pytest.fixture(scope="module")
def diagnosis(drive: Log, identified: Identification) -> Diagnosis:
    late = synthetic_log(hours=0.6, start_pct=85.0, end_pct=60.0, noise_v=0.3, seed=8, name="<a&b>")
    return cangauge.diagnose(
        [replace(late, voltage_v=late.voltage_v + 6.0)], identified.model, [drive]
    )


def names_drawn(plot: Any) -> set[str]:
    return {each.name for each in plot.select({"type": object}) if getattr(each, "name", None)}


def axis_labels(plot: Any) -> list[str]:
    return [child.yaxis[0].axis_label for child in plot.children]


def test_log_plots_its_channels(drive: Log) -> None:
    labels = ["current [A]", "voltage [V]", "temperature [°C]", "state of charge [%]"]
    assert axis_labels(drive.plot()) == labels
    assert axis_labels(replace(drive, soc_pct=None).plot()) == labels[:3]
    json_item(drive.plot())


def test_estimate_plots_band_and_reference(drive: Log, identified: Identification) -> None:
    table = cangauge.estimate(drive, identified.model)
    plot = table.plot(drive)
    soc = plot.children[0]
    legend = {item.label.value for item in soc.legend[0].items}
    assert {"estimate", "±2σ", "Newton", "Coulomb", "reference"} <= legend
    json_item(plot)
    json_item(table.plot())


def test_fit_plots_curve_and_residuals(identified: Identification) -> None:
    plot = identified.plot()
    (line,) = [each for each in plot.children[0].renderers if each.name == "pseudo-OCV"]
    assert "measured, less drop" in names_drawn(plot.children[0])
    curve = line.data_source.data
    model = identified.voltage_model
    expected = model.pseudo_ocv(np.asarray(curve["x"], dtype=float))
    assert np.asarray(curve["y"]) == pytest.approx(expected, abs=1e-3)
    json_item(plot)
