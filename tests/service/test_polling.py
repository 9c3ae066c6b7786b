"""Requests over ISO-TP: one at a time, no faster than stated, less often without an answer."""

from __future__ import annotations

from itertools import pairwise

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cangauge.bus.isotp import LONGEST_GAP_S, PollTarget
from cangauge.service.polling import (
    EXCHANGE_WITHIN_S,
    OTHER_TESTER_S,
    SLOWEST_S,
    Poller,
)
from polled_battery import CELLS, PROBES

PROBES_OF_LEAF = PollTarget(0x79B, 0x7BB, b"\x61\x04")
CELLS_OF_LEAF = PollTarget(0x79B, 0x7BB, b"\x61\x02")


def reply(data: bytes) -> can.Message:
    return can.Message(arbitration_id=0x7BB, is_extended_id=False, data=data)


def answer(poller: Poller, payload: bytes, now_s: float) -> can.Message | None:
    """Give a reply of several frames; return the flow control."""
    first = bytes([0x10 | len(payload) >> 8, len(payload) & 0xFF]) + payload[:6]
    control = poller.take(reply(first), now_s)
    for n, at in enumerate(range(6, len(payload), 7), 1):
        assert poller.take(reply(bytes([0x20 | n & 15]) + payload[at : at + 7]), now_s) is None
    return control


def test_a_reply_is_asked_for_and_continued() -> None:
    poller = Poller([PROBES_OF_LEAF], every_s=5.0)
    request = poller.due(0.0)
    assert request is not None
    assert (request.arbitration_id, bytes(request.data[:3])) == (0x79B, b"\x02\x21\x04")
    control = answer(poller, PROBES, 0.1)
    assert control is not None
    assert (control.arbitration_id, bytes(control.data[:3])) == (0x79B, b"\x30\x00\x00")
    assert poller.due(5.0) is None
    assert poller.due(5.2) is not None
    assert (poller.counts["requests"], poller.counts["answers"]) == (2, 1)


def test_a_reply_to_somebody_else_gets_no_flow_control() -> None:
    poller = Poller([PROBES_OF_LEAF], every_s=5.0)
    assert answer(poller, CELLS, 0.0) is None  # nothing asked yet
    assert poller.due(0.1) is not None
    assert answer(poller, CELLS, 0.2) is None
    assert poller.counts["answers"] == 0


@given(
    st.lists(
        st.tuples(st.floats(0.0, 3.0), st.sampled_from(["wait", "answer", "negative", "other"])),
        max_size=60,
    )
)
def test_one_request_at_a_time_and_never_too_often(steps: list[tuple[float, str]]) -> None:
    poller = Poller([PROBES_OF_LEAF, CELLS_OF_LEAF], every_s=2.0)
    now_s, asked_s, ended, quiet_s = 0.0, {}, True, -1.0
    for step_s, act in steps:
        now_s += step_s
        request = poller.due(now_s)
        if request is not None:
            group = request.data[2]
            assert now_s >= quiet_s
            assert ended or now_s - max(asked_s.values()) >= LONGEST_GAP_S
            assert now_s - asked_s.get(group, -9.0) >= 2.0
            asked_s[group], ended = now_s, False
        if act == "other":
            poller.note_other_tester(now_s)
            quiet_s, ended = now_s + OTHER_TESTER_S, True
        elif act != "wait" and not ended:
            last = max(asked_s, key=lambda group: asked_s[group])
            if act == "answer":
                answer(poller, PROBES if last == 4 else CELLS, now_s)
            else:
                poller.take(reply(b"\x03\x7f\x21\x11"), now_s)
            ended = True


def test_silence_doubles_the_interval_until_an_answer() -> None:
    poller = Poller([PROBES_OF_LEAF], every_s=2.0)
    asked = [tenth / 10.0 for tenth in range(4000) if poller.due(tenth / 10.0) is not None]
    waits = [later - before for before, later in pairwise(asked)]
    assert waits[0] < waits[1] < waits[2]
    assert SLOWEST_S <= max(waits) <= SLOWEST_S + LONGEST_GAP_S + 0.2
    assert poller.counts["unanswered"] >= len(asked) - 1
    again_s = next(at / 10.0 for at in range(4000, 5000) if poller.due(at / 10.0))
    answer(poller, PROBES, again_s + 0.1)
    assert poller.due(again_s + 2.2) is not None


def test_a_pending_response_is_waited_for() -> None:
    poller = Poller([PROBES_OF_LEAF], every_s=2.0)
    assert poller.due(0.0) is not None
    assert poller.take(reply(b"\x03\x7f\x21\x78"), 0.5) is None
    assert poller.due(EXCHANGE_WITHIN_S - 0.1) is None
    answer(poller, PROBES, EXCHANGE_WITHIN_S - 0.05)
    assert (poller.counts["answers"], poller.counts["negative"], poller.counts["unanswered"]) == (
        1,
        0,
        0,
    )


@pytest.mark.parametrize(
    "data", [b"\x10\x10\x61\x04\0\0\0\0", b"\x03\x7f\x21\x78"], ids=["first frame", "pending"]
)
def test_a_node_that_repeats_itself_for_ever_loses_its_turn(data: bytes) -> None:
    poller = Poller([PROBES_OF_LEAF, CELLS_OF_LEAF], every_s=1.0)
    asked, controls = [], 0
    for step in range(2000):
        now_s = 0.01 * step
        if (request := poller.due(now_s)) is not None:
            asked.append((now_s, request.data[2]))
        controls += poller.take(reply(data), now_s) is not None
    assert [each for _, each in asked] == [4, 2, 4, 2]
    assert asked[1][0] == pytest.approx(EXCHANGE_WITHIN_S, abs=1.2)
    assert controls <= len(asked)
    assert poller.counts["unanswered"] == len(asked) - 1
    assert poller.counts["answers"] == 0


def test_requests_stop_while_another_tester_asks() -> None:
    poller = Poller([PROBES_OF_LEAF], every_s=2.0)
    assert poller.due(0.0) is not None
    poller.note_other_tester(0.2)
    assert all(poller.due(0.2 + 0.1 * k) is None for k in range(int(10 * OTHER_TESTER_S)))
    assert poller.due(0.3 + OTHER_TESTER_S) is not None


def test_each_of_many_replies_is_asked_for() -> None:
    targets = [PollTarget(0x79B, 0x7BB, bytes([0x61, place])) for place in range(12)]
    poller, asked = Poller(targets, every_s=5.0), set()
    for step in range(200):
        if (request := poller.due(0.1 * step)) is not None:
            asked.add(request.data[2])
            poller.take(reply(bytes([2, 0x61, request.data[2]])), 0.1 * step)
    assert asked == set(range(12))


@pytest.mark.parametrize(
    "reply_bytes",
    [b"\x02\x61\x04", b"\x02\x61\x02", b"\x03\x7f\x21\x11", b"\x03\x7f\x21\x78", b"\x01\x7f"],
)
def test_a_node_is_asked_once_a_second_whatever_it_answers(reply_bytes: bytes) -> None:
    poller = Poller([PROBES_OF_LEAF, CELLS_OF_LEAF], every_s=1.0)
    other = PollTarget(0x7E4, 0x7EC, b"\x62\x01\x01")
    asked = list[float]()
    for step in range(2000):
        now_s = 0.01 * step
        if step == 1000:  # the configuration is read again
            poller = Poller([PROBES_OF_LEAF, CELLS_OF_LEAF, other], 1.0, poller.asked_s)
        if (request := poller.due(now_s)) is not None and request.arbitration_id == 0x79B:
            asked.append(now_s)
        poller.take(reply(reply_bytes), now_s)
    assert len(asked) > 3
    assert min(later - before for before, later in pairwise(asked)) > 0.99


@given(st.lists(st.tuples(st.binary(max_size=8), st.floats(0.0, 2.0)), max_size=40))
def test_any_frames_are_survived(frames: list[tuple[bytes, float]]) -> None:
    poller, now_s = Poller([PROBES_OF_LEAF], every_s=1.0), 0.0
    for data, step_s in frames:
        now_s += step_s
        poller.due(now_s)
        control = poller.take(reply(data), now_s)
        assert control is None or control.data[0] == 0x30
    asks = [poller.due(now_s + wait_s) for wait_s in (EXCHANGE_WITHIN_S, 2.0 * SLOWEST_S)]
    assert any(ask is not None for ask in asks)
