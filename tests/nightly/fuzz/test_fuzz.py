"""A small part of `benchmarks/fuzz.py`, drawn and shrunk by hypothesis."""

from __future__ import annotations

import warnings
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzzing import corpus
from fuzzing.target import Target, attempt
from fuzzing.targets import targets

TARGETS = {target.name: target for target in targets()}
EXAMPLES = {"frames": 12, "captures": 120, "logs": 100, "model": 80, "dbc": 80}


@pytest.mark.parametrize("name", list(TARGETS))
def test_anything_is_read_or_refused_in_one_line(name: str) -> None:
    target = TARGETS[name]

    @settings(
        max_examples=EXAMPLES.get(name, 80),
        derandomize=True,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(rng=st.randoms(use_true_random=False))
    def check(rng: Random) -> None:
        attempt(target, target.make(rng))

    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # numpy's: a user would see it on stderr
        check()


@pytest.mark.parametrize("name", ["logs", "captures", "dbc"])
def test_the_seeds_themselves_are_read(name: str) -> None:
    """Otherwise all mutants would be junk."""
    target: Target = TARGETS[name]
    assert target.seeds is not None
    for file, data in target.seeds().items():
        assert attempt(target, data) or file.startswith(("A123", "Cell-HPPC")), file


def test_the_other_seeds_are_read() -> None:
    for name, text in (
        ("config", corpus.CONFIG),
        ("config", corpus.OWN_CAR),
        ("map", corpus.MAP),
    ):
        assert attempt(TARGETS[name], text.encode()), name
