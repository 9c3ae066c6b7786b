"""Selection of effects by left-out logs, and their joint fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_fit import CELLS, trips

from cangauge.errors import InputError
from cangauge.identify.effect_search import (
    NOT_IDENTIFIABLE,
    SEARCHED,
    Selected,
    linearize,
    offered,
    parse_effect_ids,
)
from cangauge.identify.fit import fit
from cangauge.identify.least_squares import N
from cangauge.identify.rows import fit_rows
from cangauge.logs.log import Log
from cangauge.model.effects.base import Signals
from cangauge.model.effects.library import LIBRARY
from cangauge.model.extended import ExtendedModel
from cangauge.model.published import CAPACITY_AH

BASE = ExtendedModel(CELLS, CAPACITY_AH)


def with_effect(log: Log, effect_id: str, values: dict[str, float]) -> Log:
    """The log as a pack with an effect would have given it."""
    effect = LIBRARY[effect_id]
    full = {**effect.neutral(BASE.pack), **values}
    signals = Signals.of(log)
    rows = np.arange(len(log))
    start = log.first_soc()
    assert start is not None
    plain, changed = (
        model.predict(signals, start[1], rows, initial_row=start[0])
        for model in (BASE, BASE.with_effect(effect, full))
    )
    return replace(log, voltage_v=log.voltage_v + changed.voltage_v - plain.voltage_v)


@pytest.mark.parametrize(
    ("effect_id", "values"),
    [
        ("hysteresis", {"half_width_v": 1.5, "travel_pct": 2.0}),
        pytest.param("slow_diffusion", {"ohm": 0.04, "tau_s": 1400.0}, marks=pytest.mark.nightly),
        pytest.param("fast_polarization", {"ohm": 0.03, "tau_s": 3.5}, marks=pytest.mark.nightly),
    ],
)
def test_auto_finds_a_true_effect(effect_id: str, values: dict[str, float]) -> None:
    logs = [with_effect(log, effect_id, values) for log in trips(9)]
    plain = fit(logs, capacity_ah=CAPACITY_AH, effects="none")
    found = fit(logs, capacity_ah=CAPACITY_AH, effects="auto")
    ids = [entry["id"] for entry in found.model.effects]
    assert effect_id in ids
    assert found.model.noise.voltage_rmse_v < plain.model.noise.voltage_rmse_v
    assert found.voltage_rmse_v < 1.1 * found.model.noise.voltage_rmse_v
    name, size = next(iter(values.items()))
    fitted = found.model.effects[ids.index(effect_id)]["parameters"]
    assert isinstance(fitted, dict)
    assert fitted[name] == pytest.approx(size, rel=0.4)


def test_auto_takes_nothing_on_logs_without_effects() -> None:
    found = fit(trips(8), capacity_ah=CAPACITY_AH, effects="auto")
    assert found.model.effects == []
    assert any("no effect lowers the error" in text for text in found.remarks)


def test_effects_are_searched_only_where_asked_for() -> None:
    assert fit(trips(5), capacity_ah=CAPACITY_AH).effects is None
    assert fit(trips(5), capacity_ah=CAPACITY_AH, effects="none").effects is None
    assert fit(trips(5), capacity_ah=CAPACITY_AH, effects="auto").effects is not None


def test_named_effects_are_all_taken_and_reported() -> None:
    logs = [with_effect(log, "resistance_asymmetry", {"charging_ohm": 0.02}) for log in trips(4)]
    found = fit(logs, capacity_ah=CAPACITY_AH, effects=["resistance_asymmetry", "hysteresis"])
    parameters = {str(entry["id"]): entry["parameters"] for entry in found.model.effects}
    assert set(parameters) == {"resistance_asymmetry", "hysteresis"}
    charging = parameters["resistance_asymmetry"]
    assert isinstance(charging, dict)
    assert charging["charging_ohm"] == pytest.approx(0.02, rel=0.3)
    steps = found.to_dict()["effect_search"]
    assert isinstance(steps, list)
    assert [step["step"] for step in steps] == ["added", "added"]


def test_columns_are_the_derivative_of_the_voltage() -> None:
    log = trips(1)[0]
    rows = fit_rows(log, CAPACITY_AH, low_pass_s=())
    effect_ids = [effect_id for effect_id in LIBRARY if effect_id not in NOT_IDENTIFIABLE]
    chosen = offered(effect_ids, BASE)
    count = sum(len(item.amplitudes) for item in chosen)
    linear = linearize(BASE, rows, Selected(tuple(chosen)), np.zeros(count))
    signals = Signals.of(log)
    start = log.first_soc()
    assert start is not None

    def residual_v(model: ExtendedModel) -> np.ndarray:
        return model.predict(signals, start[1], rows.at, initial_row=start[0]).residual_v

    column = 0
    for item in chosen:
        for number, step in enumerate(item.steps.tolist()):
            values = item.values(step * (np.arange(item.steps.size) == number))
            change = residual_v(BASE) - residual_v(BASE.with_effect(item.effect, values))
            found = linear.table[:, column - count] * step
            assert found == pytest.approx(change, abs=1e-6 + 1e-6 * np.abs(change).max())
            column += 1
    assert column == count


def test_a_resistance_acts_through_the_effects_that_scale_its_drop() -> None:
    log = trips(1)[0]
    rows, start = fit_rows(log, CAPACITY_AH, low_pass_s=()), log.first_soc()
    assert start is not None
    [item] = [
        each
        for each in offered(["resistance_soc"], BASE)
        if each.shape["delayed"] == 1.0 and each.shape["width_pct"] == 40.0
    ]
    about, step_ohm = np.array([0.8, 0.4]), 1e-3

    def model(first_ohm: float) -> ExtendedModel:
        ohm = (first_ohm, *CELLS.loads.resistance_ohm[1:])
        loads = CELLS.loads.model_copy(update={"resistance_ohm": ohm})
        changed = ExtendedModel(replace(CELLS, loads=loads), CAPACITY_AH)
        return changed.with_effect(item.effect, item.values(about))

    def voltage_v(first_ohm: float) -> np.ndarray:
        row, soc_pct = start
        return (
            model(first_ohm).predict(Signals.of(log), soc_pct, rows.at, initial_row=row).voltage_v
        )

    now_ohm = CELLS.loads.resistance_ohm[0]
    by_ohm = (voltage_v(now_ohm + step_ohm) - voltage_v(now_ohm)) / step_ohm
    found = linearize(model(now_ohm), rows, Selected((item,)), about).table[:, N + 1]
    assert found == pytest.approx(by_ohm, abs=1e-6 * np.abs(by_ohm).max())
    assert not np.allclose(found, rows.current_a, rtol=0.01)


def test_columns_of_the_equation_are_not_offered() -> None:
    taus = [
        item.shape["tau_s"]
        for item in offered(SEARCHED, BASE)
        if item.effect.id in {"fast_polarization", "slow_diffusion"}
    ]
    assert taus
    assert all(max(tau / own, own / tau) > 2.0 for tau in taus for own in (10.0, 140.0))
    assert "resistance_temperature" not in SEARCHED


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["gremlin"], "unknown effect"),
        (["capacity"], "--capacity-ah"),
        (["voltage_offset"], "the curve absorbs it"),
        (["resistance_temperature"], "the equation has it"),
        (["hysteresis", "hysteresis"], "given twice"),
        (["auto,hysteresis"], "together with others"),
    ],
)
def test_bad_ids_are_refused(given: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_effect_ids(given)


def test_ids_may_be_repeated_and_separated_by_commas() -> None:
    assert parse_effect_ids(["hysteresis, slow_diffusion", "time_skew"]) == (
        "hysteresis", "slow_diffusion", "time_skew",
    )  # fmt: skip
    assert parse_effect_ids(["none"]) == ()


def test_published_equation_has_no_effects() -> None:
    with pytest.raises(InputError, match="without effects"):
        fit(trips(2), capacity_ah=CAPACITY_AH, equation="published", effects="hysteresis")
