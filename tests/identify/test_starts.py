"""The SoC at the start of a log: stated, found, or refused; never assumed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_fit import CELLS

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.identify.fit import fit
from cangauge.identify.starts import find_starts, given_starts, start_by_model
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import (
    capacity_from_full_discharge,
    counted_soc_pct,
    difference_from_reference,
    discharged_ah,
)
from cangauge.model.prior import CHEMISTRIES, PackPrior
from cangauge.model.published import CAPACITY_AH
from synthetic import synthetic_log


def without_soc(log: Log) -> Log:
    return replace(log, soc_pct=None)


def trip(start_pct: float, end_pct: float, seed: int, hours: float = 0.5) -> Log:
    return synthetic_log(
        hours=hours,
        start_pct=start_pct,
        end_pct=end_pct,
        noise_v=0.3,
        seed=seed,
        model=CELLS,
        name=f"t{seed}",
    )


def joined(first: Log, later: Log) -> Log:
    """Return the rows of two logs as one, of the name of the first."""
    names = ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct")
    columns = {n: np.concatenate([getattr(first, n), getattr(later, n)]) for n in names}
    return replace(first, **columns)


def test_unknown_start_is_refused_with_the_cure() -> None:
    log = without_soc(trip(80.0, 40.0, 1))
    with pytest.raises(InputError, match=r"the log does not state its SoC .*--initial-soc P"):
        fit([log], capacity_ah=CAPACITY_AH)
    with pytest.raises(InputError, match="the SoC at the start is unknown"):
        counted_soc_pct(log, CAPACITY_AH)


def test_unknown_start_is_estimated_with_the_curve() -> None:
    known, other = trip(90.0, 30.0, 1, hours=1.0), trip(75.0, 45.0, 2)
    found = fit([known, without_soc(other)], capacity_ah=CAPACITY_AH)
    start = found.starts[1]
    assert start.origin == "estimated"
    assert start.std_pct is not None
    assert abs(start.soc_pct - 75.0) < 3.0 * start.std_pct
    assert start.std_pct < 3.0
    exact = fit([known, other], capacity_ah=CAPACITY_AH)
    assert found.voltage_mae_pct == pytest.approx(exact.voltage_mae_pct, rel=0.05)
    assert sum(found.voltage_model.loads.resistance_ohm) == pytest.approx(
        sum(exact.voltage_model.loads.resistance_ohm), rel=0.05
    )
    assert any("start estimated together with the curve: t2 starts" in r for r in found.remarks)
    of_logs = found.to_dict()["logs"]
    assert isinstance(of_logs, list)
    assert [item["initial_soc_from"] for item in of_logs] == ["log", "estimated"]


def test_start_outside_the_pinned_curve_is_refused() -> None:
    pinned, apart = trip(90.0, 80.0, 1), without_soc(trip(30.0, 20.0, 2))
    with pytest.raises(InputError, match=r"determines it to ±\d+ % only.*overlaps"):
        fit([pinned, apart], capacity_ah=CAPACITY_AH)


def test_one_stated_start_pins_the_others() -> None:
    logs = [without_soc(trip(90.0, 30.0, 1, hours=1.0)), without_soc(trip(75.0, 45.0, 2))]
    found = fit(logs, capacity_ah=CAPACITY_AH, initial_soc_pct=[90.0, None])
    assert [start.origin for start in found.starts] == ["given", "estimated"]
    assert found.starts[1].soc_pct == pytest.approx(75.0, abs=1.0)


def test_a_stated_start_is_that_of_the_first_piece_alone() -> None:
    first, later = trip(90.0, 60.0, 1), trip(80.0, 50.0, 2)
    charged_s = first.time_s[-1] - later.time_s[0] + 7200.0
    log = joined(first, replace(later, time_s=later.time_s + charged_s))
    found = find_starts([log], [88.0], PackPrior(CHEMISTRIES["oxide"], CAPACITY_AH))
    assert [start.log.name for start in found] == ["t1 part 1", "t1 part 2"]
    assert [start.origin for start in found] == ["given", "log"]
    assert [start.soc_pct for start in found] == pytest.approx([88.0, 80.0], abs=0.1)


def test_partial_trip_is_no_full_discharge() -> None:
    part = trip(87.0, 76.0, 1)
    for log, initial in ((part, None), (without_soc(part), None), (without_soc(part), 100.0)):
        with pytest.raises(InputError, match=r"unknown capacity.*--capacity-ah A"):
            capacity_from_full_discharge([log], [initial])
    with pytest.raises(InputError, match=r"nearest is .*: 7\d\.\d … 8\d\.\d %, .* Ah per 100 %"):
        capacity_from_full_discharge([part], [None])


def test_full_discharge_is_proven_by_soc_or_by_knee() -> None:
    full = synthetic_log(hours=1.2, noise_v=0.5)
    assert capacity_from_full_discharge([full], [None]) == pytest.approx(CAPACITY_AH, rel=0.01)
    bare = without_soc(full)
    assert capacity_from_full_discharge([bare], [100.0]) == pytest.approx(CAPACITY_AH, rel=0.02)
    with pytest.raises(InputError, match="unknown capacity"):
        capacity_from_full_discharge([bare], [None])


def test_counted_soc_that_differs_tells_the_capacity() -> None:
    log = trip(80.0, 40.0, 1)
    assert difference_from_reference(log, CAPACITY_AH) is None
    told = difference_from_reference(log, 0.9 * CAPACITY_AH)
    assert told == (
        "t1: the counted charge and the log's own SoC imply a capacity of"
        f" {CAPACITY_AH:.1f} Ah; {0.9 * CAPACITY_AH:.1f} Ah is used."
        " Check the capacity and the current sensor"
    )
    assert told in fit([log], capacity_ah=0.9 * CAPACITY_AH).remarks


def test_same_log_twice_is_refused() -> None:
    log = trip(80.0, 40.0, 1)
    with pytest.raises(InputError, match=r"same rows as .*give each log once"):
        fit([log, trip(90.0, 30.0, 2), replace(log, name="copy")], capacity_ah=CAPACITY_AH)


def test_a_model_finds_the_start_of_a_log_from_its_voltage() -> None:
    references = [trip(90.0, 40.0, seed, hours=1.0) for seed in (1, 2, 3)]
    model = fit(references, capacity_ah=CAPACITY_AH).model
    start = start_by_model(without_soc(trip(70.0, 45.0, 4, hours=0.7)), model)
    assert start.std_pct is not None
    assert abs(start.soc_pct - 70.0) < 2.0 * start.std_pct < 6.0


@pytest.mark.real
def test_trips_without_soc_attach_to_one_that_has_it(shared_data: Path) -> None:
    names = ("A05", "A06", "A07", "A08", "A09", "A11", "A12")
    trips = [read_log(shared_data / "bmw_i3" / f"Trip{name}.csv.gz") for name in names]
    logs = [*trips[:5], *(without_soc(log) for log in trips[5:])]
    found = fit(logs, capacity_ah=61.75, effects="none")
    for log, start in zip(trips[5:], found.starts[5:], strict=True):
        assert log.soc_pct is not None
        assert start.std_pct is not None
        error = start.soc_pct - float(log.soc_pct[np.isfinite(log.soc_pct)][0])
        assert abs(error) < 2.0 * start.std_pct < 6.0
    exact = fit(trips, capacity_ah=61.75, effects="none")
    assert found.voltage_mae_pct == pytest.approx(exact.voltage_mae_pct, rel=0.1)


@pytest.mark.real
def test_real_partial_trip_gives_no_capacity(shared_data: Path) -> None:
    # From 87 to 81 %, whose last volts fall as steeply as an empty pack's.
    log = read_log(shared_data / "bmw_i3" / "TripA01.csv.gz")
    assert discharged_ah(log.time_s, log.current_a)[-1] < 7.5
    for initial in (None, 100.0):
        with pytest.raises(InputError, match="unknown capacity"):
            fit([without_soc(log)], initial_soc_pct=initial)


@pytest.mark.parametrize("given", ["auto", ["auto"], [None], None])
def test_auto_is_a_start_that_is_not_given(given: str | list[str | None] | None) -> None:
    """As in `estimate`, and as the error for a wrong number of starts says."""
    assert given_starts(given, 1) == [None]
    for wrong in ("half", ["half"]):
        with pytest.raises(InputError, match="not a number"):
            given_starts(wrong, 1)
