"""A rule's counter may leave values out; then its turn is no loss."""

from __future__ import annotations

import pytest

from cangauge.bus.protection import FrameChecker, ProtectionRule


def test_a_counter_from_0_to_14_turns_without_a_loss() -> None:
    rule = ProtectionRule(polynomial=0x1D, counter_modulus=15)
    checker = FrameChecker(rule, 0.01)
    sent = [rule.protect(bytearray(8), n) for n in range(45)]
    verdicts = [checker.check(data, 0.01 * n) for n, data in enumerate(sent)]
    assert set(verdicts) == {None}
    del sent[20]  # this one is a loss
    checker = FrameChecker(rule, 0.01)
    found = [checker.check(data, 0.01 * n) for n, data in enumerate(sent)]
    assert found.count("counter_jumps") == 1
    impossible = ProtectionRule(polynomial=0x1D).protect(bytearray(8), 15)
    assert not rule.is_whole(impossible)


def test_more_values_than_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 16"):
        ProtectionRule(polynomial=0x1D, counter_modulus=17)
