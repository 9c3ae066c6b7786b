"""`inspect_log`: what a log holds, which way its current counts, what it can identify."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from cangauge.inspect.abilities import Ability, judge_abilities
from cangauge.inspect.channels import Channel, describe_channel, find_stuck
from cangauge.inspect.charge import (
    Charge,
    Resistance,
    Soc,
    describe_charge,
    describe_resistance,
    describe_soc,
)
from cangauge.inspect.sign import SignFinding, sign_of_current
from cangauge.inspect.timing import Timing, describe_timing
from cangauge.logs.log import Log

CURRENT_JUMP_SHARE: Final = 0.05
"""A jump of current is at least this part of its range [-]."""
VOLTAGE_QUANTA: Final = 4.0
"""A jump of voltage, or what a jump of current must be worth, is at least so many quanta."""
VOLTAGE_SHARE: Final = 0.002
"""… and at least this part of the median voltage [-]."""
LISTED_STRETCHES: Final = 5
"""More stuck stretches of a channel are only counted in the warnings."""


@dataclass(frozen=True, slots=True)
class LogInspection:
    """What `inspect_log` finds.

    Parameters
    ----------
    name, source, temperature_source : str
    rows : int
    timing : Timing
    channels : dict of str to Channel
        `current_a`, `voltage_v`, `temperature_c`, and `soc_pct` where there is one.
    charge : Charge
    soc : Soc or None
        None without any finite reference.
    resistance : Resistance or None
        None without clear steps.
    sign : SignFinding
    abilities : tuple of Ability
    remarks : tuple of str
        What the reader changed or noticed.
    warnings : tuple of str
        What the user should look at.
    """

    name: str
    source: str
    temperature_source: str
    rows: int
    timing: Timing
    channels: dict[str, Channel]
    charge: Charge
    soc: Soc | None
    resistance: Resistance | None
    sign: SignFinding
    abilities: tuple[Ability, ...]
    remarks: tuple[str, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        parts: dict[str, Any] = {
            "kind": "log",
            "name": self.name,
            "source": self.source,
            "temperature_source": self.temperature_source,
            "rows": self.rows,
            "timing": asdict(self.timing),
            "channels": {name: asdict(channel) for name, channel in self.channels.items()},
            "charge": asdict(self.charge),
            "soc": None if self.soc is None else asdict(self.soc),
            "resistance": None if self.resistance is None else asdict(self.resistance),
            "sign_of_current": self.sign.to_dict(),
            "abilities": [asdict(ability) for ability in self.abilities],
            "remarks": list(self.remarks),
            "warnings": list(self.warnings),
        }
        return parts


def inspect_log(log: Log) -> LogInspection:
    """Inspect a log; pure.

    Parameters
    ----------
    log : Log
        Its current may count either way: that is one of the findings.
    """
    timing = describe_timing(log.time_s)
    resistance = describe_resistance(log)
    channels = _channels(log, resistance)
    charge = describe_charge(log, timing.gap_limit_s)
    soc = describe_soc(log)
    sign = sign_of_current(log)
    return LogInspection(
        name=log.name,
        source=log.source,
        temperature_source=log.temperature_source,
        rows=len(log),
        timing=timing,
        channels=channels,
        charge=charge,
        soc=soc,
        resistance=resistance,
        sign=sign,
        abilities=judge_abilities(
            log, timing=timing, charge=charge, soc=soc, resistance=resistance, sign=sign
        ),
        remarks=log.remarks,
        warnings=tuple(_warnings(log, timing, channels, charge, sign)),
    )


def _channels(log: Log, resistance: Resistance | None) -> dict[str, Channel]:
    current = describe_channel(log.current_a, "A")
    voltage = describe_channel(log.voltage_v, "V")
    if resistance is not None and resistance.median_ohm != 0.0:
        noticeable = max(
            VOLTAGE_QUANTA * (voltage.quantum or 0.0), VOLTAGE_SHARE * abs(voltage.median)
        )
        jump_a = max(
            noticeable / abs(resistance.median_ohm),
            CURRENT_JUMP_SHARE * (current.maximum - current.minimum),
        )
        jump_v = max(noticeable, jump_a * abs(resistance.median_ohm))
        stuck_v = find_stuck(log, log.voltage_v, log.current_a, jump_a, "A")
        stuck_a = find_stuck(log, log.current_a, log.voltage_v, jump_v, "V")
        voltage = describe_channel(log.voltage_v, "V", stuck_v)
        current = describe_channel(log.current_a, "A", stuck_a)
    channels = {
        "current_a": current,
        "voltage_v": voltage,
        "temperature_c": describe_channel(log.temperature_c, "°C"),
    }
    if log.soc_pct is not None and np.isfinite(log.soc_pct).any():
        channels["soc_pct"] = describe_channel(log.soc_pct, "%")
    return channels


def _warnings(
    log: Log,
    timing: Timing,
    channels: dict[str, Channel],
    charge: Charge,
    sign: SignFinding,
) -> list[str]:
    found = [*_sign_warnings(sign), *_gap_warnings(timing, charge)]
    for name, channel in channels.items():
        found.extend(_stuck_warnings(name, channel))
    found.extend(
        f"{name} never changes" for name in ("current_a", "voltage_v") if channels[name].levels == 1
    )
    if log.temperature_source == "room":
        found.append("the temperature is the room's: a cold or hot battery is not seen")
    return found


def _sign_warnings(sign: SignFinding) -> list[str]:
    if sign.sign < 0:
        return ["the sign of current is turned: multiply current_a by -1"]
    if sign.sign == 0:
        return ["the sign of current could not be confirmed: make sure that discharge is > 0"]
    return []


def _gap_warnings(timing: Timing, charge: Charge) -> list[str]:
    limit = f"{timing.gap_limit_s:g} s"
    if (timing.interval_median_s or 0.0) > timing.gap_limit_s:
        slow = f"{timing.interval_median_s:.3g} s"
        return [f"rows are {slow} apart: too slow for the delay line, which bridges {limit}"]
    if not timing.gap_count:
        return []
    longest = timing.longest_gaps[0]
    return [
        f"{timing.gap_count} gaps of more than {limit}, the longest {longest.length_s:.4g} s at"
        f" {longest.start_s:.1f} s; {charge.in_gaps_ah:.3g} Ah lie in gaps"
    ]


def _stuck_warnings(name: str, channel: Channel) -> list[str]:
    found = [
        f"{name} stuck at {stretch.value:g} {channel.unit} for {stretch.duration_s:.0f} s"
        f" from {stretch.start_s:.1f} s: {stretch.why}"
        for stretch in channel.stuck[:LISTED_STRETCHES]
    ]
    more = len(channel.stuck) - LISTED_STRETCHES
    return [*found, f"{name}: {more} more stuck stretches"] if more > 0 else found
