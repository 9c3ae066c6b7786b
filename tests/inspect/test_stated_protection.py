"""The frames' table of `inspect` counts by the protection that the vehicle states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import can
import pytest

from cangauge.bus.protection import E2eRule, Protection, ProtectionRule
from cangauge.bus.vehicle import Vehicle
from cangauge.inspect.capture import inspect_capture
from live import frames_of, short_log


@pytest.mark.parametrize(
    ("rule", "name"),
    [(ProtectionRule(polynomial=0x2F, counter_modulus=15, counter_byte=-2), "mine"),
     (E2eRule("e2e_05", data_id=0x1234), "e2e_05")],
)  # fmt: skip
def test_a_broken_frame_counts_by_the_stated_rule(
    tmp_path: Path, rule: Protection, name: str
) -> None:
    vehicle = Vehicle.load("generic")
    messages = dict(vehicle.messages)
    messages[0x400] = messages[0x400]._replace(rule=rule, name=name)
    frames = [each for each in frames_of(short_log(10.0)) if each.arbitration_id in {0x400, 0x401}]
    count = 0
    with can.CanutilsLogWriter(tmp_path / "x.log") as writer:
        for frame in frames:
            if frame.arbitration_id == 0x400:
                frame.data, count = bytearray(rule.protect(frame.data, count)), count + 1
                if count in {30, 31}:
                    frame.data[0] ^= 1
            writer.on_message_received(frame)
    own = replace(vehicle, messages=messages, temperature=None, fixed_temperature_c=20.0)
    found = {each.id: each for each in inspect_capture(tmp_path / "x.log", own).ids}
    assert (found["400"].protection, found["400"].crc_errors) == (name, 2)
    assert found["400"].frames_lost == 0
    assert found["401"].protection == "generic"
