"""A mapping of signals, bound to the DBC files that define them, once."""

from __future__ import annotations

import math
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
from cantools.database.can import Database, Message, Signal

from cangauge.bus.bound import EXTENDED, BoundSignal, MessageRule, Role, Vehicle
from cangauge.bus.database import find_message, find_signal, load_dbc
from cangauge.bus.mapping import CheckMap, RuleMap, SignalMap, VehicleMap
from cangauge.bus.overrides import NO_OVERRIDES, Overrides
from cangauge.bus.rule_choice import choose_rule
from cangauge.bus.signal_checks import SignalChecks, checks_of
from cangauge.bus.signal_codec import SignalCodec, signal_codec
from cangauge.errors import InputError
from cangauge.logs.units import convert

_LOG_FIELD: Final = {
    "current": "current_a",
    "voltage": "voltage_v",
    "temperature": "temperature_c",
    "soc_reference": "soc_pct",
}
LONGEST_CYCLE_MS: Final = 1e9


def bind_vehicle(
    mapping: VehicleMap,
    dbc_files: list[Path],
    *,
    source: str | PathLike[str],
    temperature_c: float | None = None,
    pair_within_s: float | None = None,
    overrides: Overrides = NO_OVERRIDES,
) -> Vehicle:
    """Find the mapping's signals in the DBC files.

    Parameters
    ----------
    mapping : VehicleMap
    dbc_files : list of Path
        A signal is taken from the first file that has it.
    source : path-like
        Where the mapping comes from, for messages.
    temperature_c, pair_within_s : float, optional
        Instead of the mapping's.
    overrides : Overrides, optional
        Protection and checks that go before the mapping's.

    Raises
    ------
    InputError
        As `load_vehicle`.
    """
    databases = [load_dbc(path) for path in dbc_files]
    binder = _Binder(mapping, databases, dbc_files, str(source), overrides)
    temperature = mapping.temperature
    fixed = temperature_c if temperature_c is not None else None
    if fixed is None and temperature is not None:
        fixed = temperature.fixed_c
    current = binder.signal("current", mapping.current)
    voltage = binder.signal("voltage", mapping.voltage)
    bound = None if fixed is not None or temperature is None else temperature
    within = mapping.pair_within_s if pair_within_s is None else pair_within_s
    if not 0.0 <= within <= 1.0:
        raise InputError("must be within 0–1 s", field="pair_within_s", value=within)
    return Vehicle(
        name=mapping.name,
        current=current,
        voltage=voltage,
        temperature=None if bound is None else binder.signal("temperature", bound),
        soc_reference=None
        if mapping.soc_reference is None
        else binder.signal("soc_reference", mapping.soc_reference),
        fixed_temperature_c=math.nan if fixed is None else float(fixed),
        temperature_source=mapping.temperature_source if temperature_c is None else "unknown",
        pair_within_s=within,
        messages=binder.messages(),
        dbc_files=tuple(str(path) for path in dbc_files),
    )


def _cycle_s(message: Message) -> float | None:
    """Return the period that the DBC states [s]; None where that is no time."""
    stated: object = message.cycle_time
    if not isinstance(stated, int | float) or not 0.0 < stated <= LONGEST_CYCLE_MS:
        return None
    return stated / 1000.0


class _Binder:
    """Finds the signals of one mapping and remembers the messages that they are in."""

    def __init__(
        self,
        mapping: VehicleMap,
        databases: list[Database],
        files: list[Path],
        source: str,
        overrides: Overrides,
    ) -> None:
        self._mapping = mapping
        self._databases = databases
        self._files = files
        self._source = source
        self._overrides = overrides
        self._found: dict[int, Message] = {}

    def signal(self, role: Role, wanted: SignalMap) -> BoundSignal:
        message, signal, file = self._find(role, wanted)
        codec = signal_codec(
            message,
            signal,
            source=file,
            field=role,
            not_available=wanted.not_available,
            when=wanted.when,
        )
        key = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        self._found[key] = message
        factor, offset = self._unit(role, wanted, codec)
        return BoundSignal(
            role=role,
            key=key,
            message=message.name,
            length=message.length,
            codec=codec,
            gain=wanted.sign * wanted.scale * factor,
            # A stated offset is in the canonical unit; the sign does not turn it.
            offset=wanted.offset + wanted.sign * offset,
            checks=self._checks(role, wanted),
        )

    def messages(self) -> dict[int, MessageRule]:
        """Return protection and period of the messages found so far."""
        stated = self._overrides.stated_messages(self._mapping, self._source, self._key)
        own: dict[str, RuleMap] = {**self._mapping.rules, **self._overrides.rules}
        rules: dict[int, MessageRule] = {}
        for key, message in self._found.items():
            each, source = stated.get(key, (None, self._source))
            period = None if each is None else each.period_s
            if period is None:
                period = _cycle_s(message)
            rule = None if each is None else choose_rule(message, each, own, source=source)
            rules[key] = MessageRule(rule, period)
        return rules

    def _checks(self, role: Role, wanted: SignalMap) -> SignalChecks:
        first = self._overrides.checks.get(role, CheckMap())
        checks = checks_of(role, wanted, first)
        if checks.lowest >= checks.highest:
            raise InputError(
                "nothing lies between lowest and highest",
                source=self._source,
                field=role,
                value=f"{checks.lowest:g} … {checks.highest:g}",
            )
        return checks

    def _find(self, role: Role, wanted: SignalMap) -> tuple[Message, Signal, Path]:
        first: InputError | None = None
        for database, file in zip(self._databases, self._files, strict=True):
            try:
                message, signal = find_signal(
                    database, wanted.message, wanted.signal, source=file, field=role
                )
            except InputError as error:
                first = first or error
            else:
                return message, signal, file
        raise first or InputError("no DBC is given", field=role)

    def _key(self, name: str) -> int:
        """Return the key of the message that a key of [messages] means."""
        first: InputError | None = None
        for database, file in zip(self._databases, self._files, strict=True):
            try:
                message = find_message(database, name, source=file, field=f"messages.{name}")
            except InputError as error:
                first = first or error
            else:
                return message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        raise first or InputError("no DBC is given", field=f"messages.{name}")

    def _unit(self, role: Role, wanted: SignalMap, codec: SignalCodec) -> tuple[float, float]:
        """Return factor and offset from the DBC's unit to the canonical one."""
        if wanted.states_unit:
            return 1.0, 0.0
        ends = np.array([0.0, 1.0])
        try:
            ends, _ = convert(
                ends, _LOG_FIELD[role], codec.unit, source=self._source, label=codec.name
            )
        except InputError as error:
            raise InputError(
                f"the DBC's unit of {codec.name} is not known for {_LOG_FIELD[role]}",
                source=self._source,
                field=f"{role}.signal",
                value=codec.unit,
                cure="name another signal, or state scale and offset in the map file"
                " (scale = 1 takes it as it is)",
            ) from error
        return float(ends[1] - ends[0]), float(ends[0])
