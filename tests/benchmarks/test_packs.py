"""The packs bench: the same draws, sums of errors, and targets."""

from __future__ import annotations

import numpy as np
import pytest

from cangauge.logs.log import Log
from packs.recorded import Pack, counted_ah
from packs.scores import pool, score

TIME_S = np.arange(0.0, 1200.0)


def log(name: str, soc_pct: float = 50.0) -> Log:
    one = np.ones(TIME_S.size)
    return Log(TIME_S, 36.0 * one, 380.0 * one, 20.0 * one, soc_pct=soc_pct * one, name=name)


def test_draws_are_those_of_the_seed_and_judge_other_logs() -> None:
    logs = [log(str(k)) for k in range(6)]
    pack = Pack("i3", "bmw_i3", "judged", "oxide", 96, logs, logs, 60.0)
    first = [[one.name for one in training] for _, training, _ in pack.draws(2, 4, 1)]
    assert first == [[one.name for one in training] for _, training, _ in pack.draws(2, 4, 1)]
    assert first != [[one.name for one in training] for _, training, _ in pack.draws(2, 4, 2)]
    for _, training, judged in pack.draws(2, 4, 1):
        assert len(judged) == 4
        assert not {one.name for one in training} & {one.name for one in judged}


def test_charge_is_counted_by_trapezoids() -> None:
    assert counted_ah(log("a"))[-1] == pytest.approx(36.0 * 1199.0 / 3600.0)


def test_a_row_pools_samples() -> None:
    one = np.ones(TIME_S.size)
    names = {"estimator": "x", "pack": "i3", "size": 3, "case": "withheld"}
    good = score(
        log("a"), 51.0 * one, 1.0 * one, 52.0 * one, 54.0 * one, after_s=300.0, mismatch=False
    )
    lost = score(
        log("b"), 60.0 * one, 1.0 * one, 52.0 * one, 54.0 * one, after_s=300.0, mismatch=True
    )
    row = pool([good, lost], **names)
    assert (row.logs, row.astray, row.mismatches) == (2, 1, 1)
    assert (row.mae, row.cover, row.newton) == pytest.approx((5.5, 0.5, 2.0))
