"""Comments of soc_estimate.dbc agree with the code."""

from __future__ import annotations

from cangauge._resources import shared_file
from cangauge.settings import VALID_STD_PCT


def test_the_limit_of_a_valid_soc_is_the_default() -> None:
    text = shared_file("dbc", "soc_estimate.dbc").read_text()
    assert f"a setting: {VALID_STD_PCT:g} % by default" in text
