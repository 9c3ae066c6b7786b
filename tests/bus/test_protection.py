"""CRC, alive counter and the check of successive frames."""

from __future__ import annotations

import crccheck.crc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.protection import (
    CRC_ONLY_RULE,
    GENERIC_RULE,
    LEAF_RULE,
    FrameChecker,
    ProtectionRule,
    Verdict,
)
from cangauge.errors import InputError

RULES = (
    LEAF_RULE,
    GENERIC_RULE,
    ProtectionRule("first byte", polynomial=0x2F, initial=0xFF, crc_byte=0, counter_byte=1),
    ProtectionRule("middle", polynomial=0x07, crc_byte=3, counter_byte=-1, counter_shift=4),
)
payloads = st.binary(min_size=5, max_size=8)
rules = st.sampled_from(RULES)


class LeafCrc(crccheck.crc.Crc8Base):
    _poly, _initvalue, _xor_output = 0x85, 0x00, 0x00


def test_the_crc_has_the_published_check_value() -> None:
    text = b"123456789"
    assert GENERIC_RULE.crc(text + b"?") == 0x4B == crccheck.crc.Crc8SaeJ1850.calc(text)


@given(payload=st.binary(min_size=2, max_size=64))
def test_crc_agrees_with_crccheck(payload: bytes) -> None:
    assert LEAF_RULE.crc(payload) == LeafCrc.calc(payload[:-1])
    assert GENERIC_RULE.crc(payload) == crccheck.crc.Crc8SaeJ1850.calc(payload[:-1])


@given(rule=rules, payload=payloads, counter=st.integers(0, 1000))
def test_a_protected_frame_is_good_and_keeps_its_other_bits(
    rule: ProtectionRule, payload: bytes, counter: int
) -> None:
    data = rule.protect(payload, counter)
    assert FrameChecker(rule).check(data, 0.0) is Verdict.GOOD
    assert rule.counter(data) == counter % rule.modulus
    assert rule.protect(data, counter) == data
    mask = (rule.modulus - 1) << rule.counter_shift
    for place, (old, new) in enumerate(zip(payload, data, strict=True)):
        if place == rule.counter_byte % len(payload):
            assert (old ^ new) & ~mask == 0
        elif place != rule.crc_byte % len(payload):
            assert old == new


@given(rule=rules, payload=payloads, data=st.data())
def test_any_flipped_bit_is_refused(
    rule: ProtectionRule, payload: bytes, data: st.DataObject
) -> None:
    frame = bytearray(rule.protect(payload, 1))
    bit = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[bit // 8] ^= 1 << bit % 8
    assert FrameChecker(rule).check(frame, 0.0) is Verdict.CRC_WRONG


@given(rule=rules, lost=st.integers(0, 14), start=st.integers(0, 15))
def test_a_jump_counts_the_missing_frames(rule: ProtectionRule, lost: int, start: int) -> None:
    lost %= rule.modulus - 1
    checker = FrameChecker(rule)
    checker.check(rule.protect(bytes(8), start), 0.0)
    verdict = checker.check(rule.protect(bytes(8), start + 1 + lost), 0.01)
    assert verdict is (Verdict.AFTER_LOSS if lost else Verdict.GOOD)
    if lost:
        assert checker.lost == lost


def test_a_repeated_counter_is_refused() -> None:
    checker = FrameChecker(LEAF_RULE, period_s=0.01)
    frame = LEAF_RULE.protect(bytes(8), 2)
    verdicts = [checker.check(frame, 0.01 * n) for n in range(50)]
    assert verdicts == [Verdict.GOOD] + [Verdict.REPEATED] * 49
    assert checker.check(LEAF_RULE.protect(bytes(8), 3), 0.5) is Verdict.GOOD


def test_a_counter_that_may_have_wrapped_is_a_loss() -> None:
    checker = FrameChecker(LEAF_RULE, period_s=0.01)
    frame = LEAF_RULE.protect(bytes(8), 2)
    assert checker.check(frame, 0.0) is Verdict.GOOD
    assert checker.check(frame, 0.0399) is Verdict.AFTER_LOSS  # three frames are missing
    assert checker.lost == 3


def test_without_a_period_a_silence_ends_repetition() -> None:
    checker = FrameChecker(GENERIC_RULE)
    frame = GENERIC_RULE.protect(bytes(6), 2)
    checker.check(frame, 0.0)
    assert checker.check(frame, 1.5) is Verdict.REPEATED
    assert checker.check(frame, 3.0) is Verdict.REPEATED
    # The sender restarted: any counter is good after a silence.
    assert checker.check(frame, 103.0) is Verdict.AFTER_LOSS


def test_a_damaged_frame_is_not_counted_as_lost_too() -> None:
    checker = FrameChecker(GENERIC_RULE)
    good = [GENERIC_RULE.protect(bytes(6), n) for n in range(4)]
    assert checker.check(good[0], 0.0) is Verdict.GOOD
    assert checker.check(bytes([*good[1][:-1], good[1][-1] ^ 1]), 0.1) is Verdict.CRC_WRONG
    assert checker.check(good[2], 0.2) is Verdict.GOOD
    assert checker.lost == 0


def test_without_a_counter_only_the_crc_counts() -> None:
    checker = FrameChecker(CRC_ONLY_RULE)
    frame = CRC_ONLY_RULE.protect(b"abcdefgh", 5)
    assert frame[:-1] == b"abcdefg"
    assert [checker.check(frame, 0.0) for _ in range(3)] == [Verdict.GOOD] * 3


@pytest.mark.parametrize(
    ("field", "value"),
    [("polynomial", 256), ("initial", -1), ("counter_bits", 9), ("counter_shift", 8)],
)
def test_impossible_rules_are_refused(field: str, value: int) -> None:
    with pytest.raises(InputError, match=field) as caught:
        ProtectionRule("x", **{"polynomial": 0x1D, field: value})
    assert caught.value.value == value


def test_counter_and_crc_in_one_byte_are_refused() -> None:
    with pytest.raises(InputError, match="share"):
        ProtectionRule("x", polynomial=0x1D, counter_byte=-1)
    assert not ProtectionRule("x", polynomial=0x1D, crc_byte=1, counter_byte=-1).fits(2)
    assert not GENERIC_RULE.fits(1)
    assert GENERIC_RULE.fits(2)
