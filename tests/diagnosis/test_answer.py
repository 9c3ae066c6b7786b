"""The posterior: sums, groups, names, and agreement of everything that follows from it."""

from __future__ import annotations

import numpy as np
import pytest
from days import FAULTS, day

from cangauge.diagnosis import GROUP_OF, GROUPS, NONE, UNKNOWN, Posterior, References
from cangauge.diagnosis.answer import CHECKS, LIKELY, TITLES, answer
from cangauge.diagnosis.evidence import Evidence, analyse, columns
from cangauge.diagnosis.pack_fit import trace
from cangauge.model.effects.library import LIBRARY

CAPACITY_AH = 51.5


def posterior(stated: dict[str, float]) -> Posterior:
    """A posterior with these probabilities; the other effects share what is left."""
    left = [name for name in GROUP_OF if name not in stated]
    rest = (1.0 - sum(stated.values())) / len(left)
    return Posterior({NONE: 0.0, UNKNOWN: 0.0} | dict.fromkeys(left, rest) | stated, 1.0, {})


@pytest.fixture(scope="module")
def evidence(known: References) -> Evidence:
    fault, size = FAULTS["current_offset"]
    return analyse(known, [columns(known, trace(fault(day(20), size), CAPACITY_AH))])


def test_every_cause_of_the_library_has_one_group() -> None:
    assert GROUPS == {
        "sensors_and_count": (
            "current_offset", "current_gain", "voltage_offset", "voltage_gain", "capacity",
            "initial_soc", "coulombic_efficiency",
        ),
        "overpotential": (
            "resistance_temperature", "resistance_soc", "resistance_asymmetry", "resistance_step",
            "charge_transfer", "fast_polarization", "slow_diffusion", "hysteresis",
        ),
        "clock": ("time_skew",),
        "thermal": ("temperature_lag", "core_temperature", "entropic_coefficient"),
        "weak_cell": ("weak_cell",),
    }  # fmt: skip
    assert set(GROUP_OF) == set(LIBRARY)
    assert set(TITLES) == set(CHECKS) == {*GROUPS, NONE, UNKNOWN}


def test_probabilities_sum_to_one(known: References, evidence: Evidence) -> None:
    for without in ((), ("current_offset",), ("weak_cell", "time_skew")):
        stated = answer(known, evidence, without=without).probabilities
        assert sum(stated.values()) == pytest.approx(1.0)
        assert not set(without) & set(stated)


def test_groups_are_sums(known: References, evidence: Evidence) -> None:
    found = answer(known, evidence)
    for group, effects in GROUPS.items():
        together = sum(found.probabilities[name] for name in effects)
        assert found.groups[group] == pytest.approx(together)
    assert sum(found.groups.values()) == pytest.approx(1.0)
    assert list(found.groups.values()) == sorted(found.groups.values(), reverse=True)


def test_the_credible_set_holds_ninety_per_cent() -> None:
    found = posterior({NONE: 0.3, "time_skew": 0.5, "capacity": 0.15})
    assert found.credible_set == ("time_skew", NONE, "capacity")
    assert found.ambiguous_with == ("capacity",)


def test_one_group_is_stated_from_four_fifths_of_the_library() -> None:
    clear = posterior({NONE: 0.01, UNKNOWN: 0.1, "time_skew": 0.85})
    assert clear.stated_groups == ("clock",)
    open_ = posterior({NONE: 0.01, "time_skew": 0.5, "capacity": 0.45})
    assert open_.stated_groups == ("clock", "sensors_and_count")


def test_an_effect_is_named_where_it_stands_out_in_its_group() -> None:
    two = posterior({NONE: 0.01, "capacity": 0.45, "current_offset": 0.5})
    assert two.name is None
    assert not two.named
    one = posterior({NONE: 0.01, "capacity": 0.2, "current_offset": 0.75})
    assert one.name == one.verdict == "current_offset"
    assert one.named


def test_nothing_is_named_without_an_alarm() -> None:
    likely = posterior({NONE: 0.06, "time_skew": 0.9})
    assert not likely.detected
    assert not likely.named
    assert likely.check_first == CHECKS["clock"]
    assert likely.verdict == "time_skew"
    assert posterior({NONE: 0.4, "time_skew": 0.5}).check_first == CHECKS[NONE]


def test_unknown_leads_where_it_outweighs_the_library() -> None:
    found = posterior({NONE: 0.01, UNKNOWN: 0.6, "time_skew": 0.3})
    assert found.leading_group == UNKNOWN
    assert found.check_first == CHECKS[UNKNOWN]


def test_more_evidence_is_more_probable(known: References) -> None:
    fault, size = FAULTS["voltage_offset"]
    stated = []
    for part in (0.0, 0.1, 0.3, 1.0):
        log = trace(fault(day(20), part * size), CAPACITY_AH)
        stated.append(answer(known, analyse(known, [columns(known, log)])))
    group = [each.groups["sensors_and_count"] for each in stated]
    assert group == sorted(group)
    none = [each.probabilities[NONE] for each in stated]
    assert none == sorted(none, reverse=True)
    assert none[0] > LIKELY
    assert none[-1] < 0.05


def test_a_visible_size_is_seen(known: References, evidence: Evidence) -> None:
    visible = answer(known, evidence).visible_from
    assert visible["current_offset"] is not None
    assert 0.0 < visible["current_offset"] < FAULTS["current_offset"][1]
    assert np.isfinite([size for size in visible.values() if size is not None]).all()
