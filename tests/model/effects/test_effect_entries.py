"""Effects in a model file: read back, and refused with the field named."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stepping import EFFECTS, MODEL, PACK, irregular_signals, middle, within

from cangauge.errors import InputError
from cangauge.model.effects.base import LEEWAY, Effect, Pack
from cangauge.model.effects.library import LIBRARY, effect_entries, effect_of, parse_effects
from cangauge.model.extended import ExtendedModel
from cangauge.model.published import CAPACITY_AH

OFFSET = {"id": "current_offset", "parameters": {"offset_a": 1.5}}


def test_all_effects_survive_json() -> None:
    effects = [(effect, middle(effect)) for effect in EFFECTS]
    text = json.dumps(effect_entries(effects), allow_nan=False)
    assert parse_effects(json.loads(text), PACK) == effects


@given(st.sampled_from(EFFECTS), st.floats(0.0, 1.0))
def test_everything_in_bounds_is_taken(effect: Effect, part: float) -> None:
    values = {item.name: within(item, part) for item in effect.parameters}
    assert parse_effects(effect_entries([(effect, values)]), PACK) == [(effect, values)]


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_far_out_of_bounds_is_refused_naming_the_parameter(effect: Effect) -> None:
    for parameter in effect.parameters:
        low, high = parameter.bounds(PACK)
        widths = 2.5 if parameter.scale == "one" else 1.2 * LEEWAY
        for wrong in (high + widths * (high - low), low - widths * (high - low)):
            values = middle(effect) | {parameter.name: wrong}
            with pytest.raises(InputError, match="must lie within") as error:
                parse_effects([OFFSET | {}, *effect_entries([(effect, values)])][-1:], PACK)
            assert error.value.field == f"effects.0.parameters.{parameter.name}"


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
@pytest.mark.parametrize("part", [0.0, 1.0])
def test_an_effect_keeps_its_size_where_others_took_the_resistance(
    effect: Effect, part: float
) -> None:
    """RC elements that clean logs show leave a model of the same pack little resistance."""
    values = {item.name: within(item, part) for item in effect.parameters}
    little = replace(PACK, resistance_ohm=0.2 * PACK.resistance_ohm)
    assert effect.within(values, little) == values
    assert parse_effects(effect_entries([(effect, values)]), little) == [(effect, values)]


def test_a_bound_of_zero_stays_zero() -> None:
    """The leeway of bounds that are relative to the pack must not let a resistance turn sign."""
    entry = {
        "id": "slow_diffusion",
        "parameters": {"ohm": -0.001, "tau_s": 500.0, "activation_k": 0.0},
    }
    with pytest.raises(InputError, match="must lie within 0 "):
        parse_effects([entry], PACK)


def test_a_file_from_before_a_parameter_means_what_it_meant() -> None:
    parameters = {"ohm": 0.001, "tau_s": 500.0, "activation_k": 0.0}
    ((_, values),) = parse_effects([{"id": "slow_diffusion", "parameters": parameters}], PACK)
    assert values == parameters | {"spread": 0.0, "by_slope": 0.0}


@pytest.mark.parametrize(
    ("effect_id", "given", "then"),
    [
        ("charge_transfer", {"scale_v": 5.0, "exchange_a": 3.0, "bend_only": 1.0},
         {"activation_k": 5000.0}),
        ("core_temperature", {"rise_k": 4.0, "tau_s": 900.0}, {"late": 0.0}),
        ("resistance_temperature",
         {"share": 0.5, "activation_k": 2500.0, "delayed": 1.0, "reference_c": 20.0},
         {"lag_s": 0.0}),
    ],
)  # fmt: skip
def test_a_file_from_before_cells_had_an_inside_means_what_it_meant(
    effect_id: str, given: dict[str, float], then: dict[str, float]
) -> None:
    ((_, values),) = parse_effects([{"id": effect_id, "parameters": given}], PACK)
    assert values == given | then


@pytest.mark.parametrize(
    ("entries", "field", "words"),
    [
        ([7], "effects.0", "fields id and parameters"),
        ([OFFSET, {"id": "capacity"}], "effects.1", "fields id and parameters"),
        ([OFFSET | {"note": ""}], "effects.0", "no others"),
        ([{"id": "gremlin", "parameters": {}}], "effects.0.id", "known are current_offset"),
        ([{"id": ["x"], "parameters": {}}], "effects.0.id", "no effect"),
        ([OFFSET, OFFSET], "effects.1.id", "twice"),
        ([OFFSET | {"parameters": {}}], "effects.0.parameters", "offset_a"),
        ([OFFSET | {"parameters": [1]}], "effects.0.parameters", "offset_a"),
        ([OFFSET | {"parameters": {"offset": 1.0}}], "effects.0.parameters", "offset_a"),
        ([OFFSET | {"parameters": {"offset_a": "1"}}], "effects.0.parameters.offset_a", "number"),
        ([OFFSET | {"parameters": {"offset_a": True}}], "effects.0.parameters.offset_a", "number"),
        ([OFFSET | {"parameters": {"offset_a": math.nan}}], "effects.0.parameters.offset_a",
         "finite"),
        ([OFFSET | {"parameters": {"offset_a": 90.0}}], "effects.0.parameters.offset_a", " A for"),
    ],
)  # fmt: skip
def test_bad_entries_name_the_field(entries: list[object], field: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        parse_effects(entries, PACK)
    assert error.value.field == field


def test_an_unknown_id_lists_the_known_ones() -> None:
    with pytest.raises(InputError) as error:
        effect_of("current_ofset", "--effects")
    assert all(known in str(error.value) for known in LIBRARY)


def test_a_file_from_before_the_reference_was_kept_takes_it_from_its_own_range() -> None:
    old = {"share": 0.5, "activation_k": 2500.0, "delayed": 1.0}
    ((_, values),) = parse_effects([{"id": "resistance_temperature", "parameters": old}], PACK)
    assert values == old | {"reference_c": 23.0, "lag_s": 0.0}
    with pytest.raises(InputError, match="has the parameters share"):
        parse_effects([{"id": "resistance_temperature", "parameters": {"reference_c": 23.0}}], PACK)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_what_an_effect_does_stays_when_the_models_temperatures_are_widened(
    effect: Effect,
) -> None:
    """The diagnosis widens them to those of its logs: learnt effects must not move with them."""
    values = middle(effect)
    signals = irregular_signals(400)
    model = replace(MODEL, temperature_range_c=(0.0, 30.0))
    wider = replace(MODEL, temperature_range_c=(-30.0, 30.0))
    assert Pack.of(wider, CAPACITY_AH).temperature_c == 0.0
    rows = np.arange(400)
    found = [
        ExtendedModel(each, CAPACITY_AH).with_effect(effect, values).predict(signals, 80.0, rows)
        for each in (model, wider)
    ]
    assert np.array_equal(found[0].residual_v, found[1].residual_v)
