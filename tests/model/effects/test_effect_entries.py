"""Effects in a model file: round trip, and errors that name the field."""

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
from cangauge.model.effects.base import BOUND_MARGIN, Effect, Pack
from cangauge.model.effects.library import LIBRARY, effect_entries, effect_of, parse_effects
from cangauge.model.extended import ExtendedModel
from cangauge.model.published import CAPACITY_AH
from synthetic import within_c

OFFSET = {"id": "current_offset", "parameters": {"offset_a": 1.5}}


def test_all_effects_round_trip_through_json() -> None:
    effects = [(effect, middle(effect)) for effect in EFFECTS]
    text = json.dumps(effect_entries(effects), allow_nan=False)
    assert parse_effects(json.loads(text), PACK) == effects


@given(st.sampled_from(EFFECTS), st.floats(0.0, 1.0))
def test_values_within_bounds_are_accepted(effect: Effect, part: float) -> None:
    values = {item.name: within(item, part) for item in effect.parameters}
    assert parse_effects(effect_entries([(effect, values)]), PACK) == [(effect, values)]


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_a_value_far_out_of_bounds_names_the_parameter(effect: Effect) -> None:
    for parameter in effect.parameters:
        low, high = parameter.bounds(PACK)
        widths = 1.2 * BOUND_MARGIN if parameter.is_relative else 2.5
        for wrong in (high + widths * (high - low), low - widths * (high - low)):
            values = middle(effect) | {parameter.name: wrong}
            with pytest.raises(InputError, match="must lie within") as error:
                parse_effects([OFFSET | {}, *effect_entries([(effect, values)])][-1:], PACK)
            assert error.value.field == f"effects.0.parameters.{parameter.name}"


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
@pytest.mark.parametrize("part", [0.0, 1.0])
def test_bounds_allow_for_resistance_taken_by_other_effects(effect: Effect, part: float) -> None:
    """RC elements of clean logs leave a model of the same pack little resistance."""
    values = {item.name: within(item, part) for item in effect.parameters}
    little = replace(PACK, resistance_ohm=0.2 * PACK.resistance_ohm)
    assert effect.clipped(values, little) == values
    assert parse_effects(effect_entries([(effect, values)]), little) == [(effect, values)]


def test_the_margin_keeps_a_bound_of_zero() -> None:
    """The margin of bounds relative to the pack must not allow a negative resistance."""
    entry = {
        "id": "slow_diffusion",
        "parameters": middle(LIBRARY["slow_diffusion"]) | {"ohm": -0.001},
    }
    with pytest.raises(InputError, match="must lie within 0 "):
        parse_effects([entry], PACK)


@pytest.mark.parametrize(
    ("entries", "field", "words"),
    [
        ([7], "effects.0", "fields id, parameters only"),
        ([OFFSET, {"id": "capacity"}], "effects.1", "fields id, parameters only"),
        ([OFFSET | {"note": ""}], "effects.0", "parameters only"),
        ([{"id": "gremlin", "parameters": {}}], "effects.0.id", "known are current_offset"),
        ([{"id": ["x"], "parameters": {}}], "effects.0.id", "unknown effect"),
        ([OFFSET, OFFSET], "effects.1.id", "twice"),
        ([OFFSET | {"parameters": {}}], "effects.0.parameters", "offset_a"),
        ([OFFSET | {"parameters": [1]}], "effects.0.parameters", "offset_a"),
        ([OFFSET | {"parameters": {"offset": 1.0}}], "effects.0.parameters", "offset_a"),
        ([OFFSET | {"parameters": {"offset_a": "1"}}], "effects.0.parameters.offset_a", "number"),
        ([OFFSET | {"parameters": {"offset_a": True}}], "effects.0.parameters.offset_a", "number"),
        ([OFFSET | {"parameters": {"offset_a": math.nan}}], "effects.0.parameters.offset_a",
         "must lie within"),
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


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_an_effect_does_not_depend_on_the_temperature_range(
    effect: Effect,
) -> None:
    """The diagnosis widens the range to its logs; learned effects must not change with it."""
    values = middle(effect)
    signals = irregular_signals(400)
    model = within_c(MODEL, 0.0, 30.0)
    wider = within_c(MODEL, -30.0, 30.0)
    assert Pack.of(wider, CAPACITY_AH).temperature_c == 0.0
    rows = np.arange(400)
    found = [
        ExtendedModel(each, CAPACITY_AH).with_effect(effect, values).predict(signals, 80.0, rows)
        for each in (model, wider)
    ]
    assert np.array_equal(found[0].residual_v, found[1].residual_v)
