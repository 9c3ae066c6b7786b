"""Logs with rows seconds apart and gaps of hours: what `inspect` says is what `fit` does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cangauge.identify.fit import fit
from cangauge.inspect.log import LogInspection, inspect_log
from cangauge.logs.gaps import discharged_ah, split_where_moved
from cangauge.logs.log import Log
from cangauge.model.coulomb_counting import capacity_from_reference
from cangauge.model.delay_line import delayed_currents
from cangauge.model.published import CAPACITY_AH, leaf_2012_model
from synthetic import voltage_of


def slow_drive(start_pct: float, seed: int, *, step_s: float = 30.0, hours: float = 3.0) -> Log:
    """A drive logged every `step_s`, whose current changes with the rows."""
    rng = np.random.default_rng(seed)
    model = leaf_2012_model()
    time_s = np.arange(0.0, hours * 3600.0, step_s)
    current_a = np.maximum(rng.normal(6.0, 10.0, time_s.size), -20.0)
    soc_pct = start_pct - 100.0 * discharged_ah(time_s, current_a) / CAPACITY_AH
    temperature_c = 20.0 + 3.0 * np.sin(time_s / 900.0)
    delayed = delayed_currents(time_s, current_a, model.loads.delays_s, time_s)
    voltage_v = voltage_of(model, soc_pct, temperature_c, delayed) + rng.normal(
        0.0, 0.3, time_s.size
    )
    return Log(time_s, current_a, voltage_v, temperature_c, soc_pct, name="slow",
               temperature_source="pack")  # fmt: skip


def two_days(gap_s: float = 4.0 * 3600.0) -> Log:
    """Two drives in one log, with a charge between them that nobody logged."""
    one, two = slow_drive(90.0, 1), slow_drive(95.0, 2)
    assert one.soc_pct is not None
    assert two.soc_pct is not None
    later = one.time_s[-1] + gap_s
    return Log(
        np.concatenate([one.time_s, later + two.time_s]),
        np.concatenate([one.current_a, two.current_a]),
        np.concatenate([one.voltage_v, two.voltage_v]),
        np.concatenate([one.temperature_c, two.temperature_c]),
        np.concatenate([one.soc_pct, two.soc_pct]),
        name="leafspy",
        temperature_source="pack",
    )


def ability(found: LogInspection, topic: str) -> tuple[str, str]:
    return found.abilities[topic]


def test_steps_of_a_slow_log_have_its_own_seconds() -> None:
    _, text = ability(inspect_log(slow_drive(90.0, 1)), "ohmic resistance")
    assert text.endswith("steps of current over 30 s")


def test_charge_is_not_integrated_through_a_gap_of_hours() -> None:
    log = two_days()
    found = inspect_log(log)
    assert found.charge.uncounted_gaps == 1
    assert found.charge.uncounted_s == pytest.approx(4.0 * 3600.0)
    assert found.charge.in_gaps_ah == 0.0
    assert any("no charge is counted over 1 of them, 4.00 h in all" in w for w in found.warnings)
    assert found.soc is not None
    assert found.soc.implied_capacity_ah == pytest.approx(CAPACITY_AH, rel=1e-6)
    assert capacity_from_reference([log]) == pytest.approx(CAPACITY_AH, rel=1e-6)


def test_a_log_charged_in_a_gap_is_fitted_in_parts() -> None:
    found = fit([two_days()], capacity_ah=CAPACITY_AH)
    assert [log.name for log in found.logs] == ["leafspy part 1", "leafspy part 2"]
    assert found.starts[1].soc_pct == pytest.approx(95.0)
    assert found.voltage_mae_pct < 0.1
    assert any("split where the pack was used in a gap" in text for text in found.remarks)


def test_a_log_that_rested_in_a_gap_stays_whole() -> None:
    log = two_days()
    assert log.soc_pct is not None
    row = int(np.argmax(np.diff(log.time_s)))
    rested = log.soc_pct.copy()
    rested[row + 1 :] -= rested[row + 1] - rested[row]
    assert len(split_where_moved(replace(log, soc_pct=rested))) == 1
    assert len(split_where_moved(replace(log, soc_pct=None))) == 1
    assert len(split_where_moved(log)) == 2


@pytest.mark.parametrize(
    ("step_s", "kept"), [(5.0, [0, 10, 30, 70]), (30.0, [0, 30, 70]), (65.0, [0, 70])]
)
def test_fit_leaves_out_the_delays_that_inspect_calls_too_short(
    step_s: float, kept: list[int]
) -> None:
    log = slow_drive(95.0, 1, step_s=step_s, hours=3.0 if step_s < 30.0 else 6.0)
    found = fit([log], capacity_ah=CAPACITY_AH, equation="published")
    assert list(found.model.voltage_model().loads.delays_s) == kept
    verdict, text = ability(inspect_log(log), "delayed current terms")
    shown = ", ".join(str(delay) for delay in kept)
    assert (verdict == "yes") == (len(kept) == 4)
    assert verdict == "yes" or f"identify delays of {shown} s only" in text
    told = any("do not resolve a delay of" in remark for remark in found.remarks)
    assert told == (len(kept) < 4)
    verdict, text = ability(inspect_log(log), "rows for a fit")
    assert verdict == "yes"
    assert text.startswith(f"{sum(len(item.rows) for item in found.fits)} of ")


def test_rows_two_minutes_apart_identify_no_delay() -> None:
    verdict, text = ability(
        inspect_log(slow_drive(95.0, 1, step_s=120.0, hours=12.0)), "delayed current terms"
    )
    assert (verdict, text) == ("no", "rows every 120 s are too slow for any delay")


def test_rows_a_minute_apart_count_their_charge() -> None:
    time_s = np.arange(0.0, 36_000.0, 60.01)  # a cycler at C/20
    log = Log(time_s, np.full(time_s.size, 3.0), np.full(time_s.size, 3.7),
              np.full(time_s.size, 20.0))  # fmt: skip
    assert discharged_ah(log.time_s, log.current_a)[-1] == pytest.approx(3.0 * time_s[-1] / 3600.0)
    assert inspect_log(log).charge.net_ah == pytest.approx(3.0 * time_s[-1] / 3600.0)
